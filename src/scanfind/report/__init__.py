"""Reports of a result: one HTML file with a viewer, a PDF, CSV and XLSX, judged by any tolerance, without a new search.

`write_report` is the whole of it: read the result, judge it, gather what is to be seen, write each file wanted.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from datetime import date
from math import isfinite
from pathlib import Path

from scanfind.errors import OutputError, UnreadableFileError, UnsupportedFormatError, UsageError
from scanfind.report.content import Content
from scanfind.report.items import items_of
from scanfind.report.material import gather, models_of
from scanfind.report.page import page_of
from scanfind.report.pdf import pdf_of
from scanfind.report.tables import csv_of, xlsx_of
from scanfind.results import read_results
from scanfind.tolerances import load_profile, profile_in
from scanfind.tolerances.discs import discs_of

__all__ = ["MOST_POINTS", "WRITERS", "write_report"]

MOST_POINTS = 1_000_000  # in the page: 9.3 MB of it

# Suffix of the file → what is in it.
WRITERS: Mapping[str, Callable[[Content], bytes]] = {
    ".html": page_of,
    ".pdf": pdf_of,
    ".csv": csv_of,
    ".xlsx": xlsx_of,
}


def write_report(
    result_dir: str | Path,
    out: Sequence[str | Path],
    *,
    tolerance: str | Path | None = None,
    scans: Sequence[str | Path] = (),
    title: str | None = None,
    points: int = MOST_POINTS,
    overwrite: bool = False,
    made: date | None = None,
) -> Content:
    """Write a report of a result folder; the result itself stays as it is. Returns what the report says.

    out : files to write, each of a suffix in WRITERS
    tolerance : a profile's TOML file or the name of a preset; None: what the result was inspected with, if anything
    scans : scan files to show around what was found; none: those searched, where they are there and unchanged
    points : to show in all
    overwrite : replace files that are there
    made : the day to print; None: today

    Either all files are written or none. Raises UnreadableFileError for no result or a damaged one, LibraryError for
    damaged models, UsageError for a bad profile, UnsupportedFormatError for another suffix, MissingExtraError where a
    library is not installed, OutputError where a file is there or the disk refuses.
    """
    paths = [Path(path) for path in out]
    _check(paths, points, overwrite=overwrite)
    folder = Path(result_dir)
    folder = folder if folder.is_dir() else folder.parent
    results = read_results(result_dir)
    if not _is_finite(results.model_dump()):
        msg = f"{result_dir}: its results.json holds a number that is none (NaN or infinite): search again"
        raise UnreadableFileError(msg)
    profile = profile_in(results) if tolerance is None else load_profile(tolerance)
    models = models_of(folder)
    discs = {key: disc for model in models for key, disc in discs_of(model).items()}
    content = Content(
        results=results,
        items=tuple(items_of(results, profile, discs)),
        profile=profile,
        material=gather(folder, results, models, [Path(scan) for scan in scans], points),
        title=title or _title([Path(scan.path).name for scan in results.scans]),
        made=made or date.today(),
    )
    _write(paths, content)
    return content


def _is_finite(node: object) -> bool:
    """Are all numbers of nested lists and tables finite? JSON as Python reads it may say NaN."""
    if isinstance(node, dict):
        return all(map(_is_finite, node.values()))
    if isinstance(node, (list, tuple)):
        return all(map(_is_finite, node))
    return not isinstance(node, float) or isfinite(node)


def _check(paths: Sequence[Path], points: int, *, overwrite: bool) -> None:
    """Raise unless a report can go to these files."""
    if points < 0:
        msg = f"report: --points is how many points to show, 0 or more, got {points}"
        raise UsageError(msg)
    for path in paths:
        if path.suffix.lower() not in WRITERS:
            msg = f"{path}: a report is one of {', '.join(WRITERS)}: name such a file"
            raise UnsupportedFormatError(msg)
        if path.is_dir() or (path.exists() and not overwrite):
            msg = f"{path}: is there already: choose another name{'' if path.is_dir() else ' or pass --overwrite'}"
            raise OutputError(msg)


def _write(paths: Sequence[Path], content: Content) -> None:
    """Each file beside its place first, then all at once to their places."""
    made = [(path, WRITERS[path.suffix.lower()](content)) for path in paths]
    with ExitStack() as stack:
        try:
            parts = []
            for path, data in made:
                part = path.with_name(f".{path.name}.{os.getpid()}.part")
                path.parent.mkdir(parents=True, exist_ok=True)
                stack.callback(part.unlink, missing_ok=True)
                part.write_bytes(data)
                parts.append((part, path))
            for part, path in parts:
                part.replace(path)
        except OSError as error:
            msg = f"cannot write {error.filename or paths[0]}: {error.strerror or error}"
            raise OutputError(msg) from error


def _title(scans: Sequence[str]) -> str:
    return f"{scans[0]} and {len(scans) - 1} more scans" if len(scans) > 1 else scans[0] if scans else "Result"
