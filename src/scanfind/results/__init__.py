"""The result folder: results.json, results.csv, a pose per instance, its points. Whole or not there at all."""

from __future__ import annotations

import csv
import os
import re
import shutil
import time
import unicodedata
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from scanfind.cloud import CHUNK_POINTS, shift_for
from scanfind.errors import OutputError, UnreadableFileError
from scanfind.results import schema
from scanfind.results.document import document, model_entries

if TYPE_CHECKING:
    from scanfind.detection import Findings, IsolatedPoints
    from scanfind.library import ModelLibrary
    from scanfind.pose import Pose
    from scanfind.progress import Progress
    from scanfind.scans import CloudWriter

RESULTS_JSON = "results.json"
RESULTS_CSV = "results.csv"
ELEMENTS_CSV = "elements.csv"
DIMENSIONS_CSV = "dimensions.csv"
MODELS = "models.scanfind"

NAME_BYTES = 120  # of a model's name in a file name; file systems stop at 255


class Kind(NamedTuple):
    """What a folder of ours is known by: its document, and which files that says are in it."""

    document: str
    files: Callable[[Path], set[str]]


@contextmanager
def result_folder(out: str | Path, *, overwrite: bool = False, kind: Kind | None = None) -> Iterator[Path]:
    """A folder to fill beside `out`, which takes the name `out` when the block ends well and goes when it does not.

        overwrite : replace an older folder of the same kind; never anything else
        kind : None for the result of a search

    Raises OutputError where `out` is a file, holds what scanfind did not write, or cannot be written.
    """
    target = Path(out).absolute()
    check_free(target, overwrite=overwrite, kind=kind)
    staged = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        staged.mkdir()
        yield staged
        check_free(target, overwrite=overwrite, kind=kind)  # a search takes long enough for somebody else to have come
        _swap(staged, target)
    except OSError as error:  # scans and models say theirs in words of their own
        msg = f"{out}: results cannot be written: {error.strerror or error}: choose another folder or make room"
        raise OutputError(msg) from error
    finally:
        shutil.rmtree(staged, ignore_errors=True)


@contextmanager
def result_file(out: str | Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A file to write beside `out`, which takes the name `out` when the block ends well and goes when it does not.

    Raises OutputError where something is there already, unless `overwrite` (of a file), or it cannot be written.
    """
    target = Path(out).absolute()
    if target.is_dir() or (target.exists() and not overwrite):
        what = "is a folder: name a file" if target.is_dir() else "is there already: name another or pass --overwrite"
        msg = f"{out}: {what}"
        raise OutputError(msg)
    staged = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield staged
        staged.replace(target)
    except OSError as error:
        msg = f"{out}: cannot be written: {error.strerror or error}: choose another place or make room"
        raise OutputError(msg) from error
    finally:
        staged.unlink(missing_ok=True)


def check_free(target: Path, *, overwrite: bool, kind: Kind | None = None) -> None:
    """Raise OutputError unless a folder of this kind (None: a result) may take this place."""
    kind = kind or Kind(RESULTS_JSON, lambda folder: _files_of(read_results(folder)))
    if not target.exists() or (target.is_dir() and not any(target.iterdir())):
        return
    if not target.is_dir():
        msg = f"{target}: is a file: results need a folder, choose another"
        raise OutputError(msg)
    if not (target / kind.document).is_file():
        msg = f"{target}: holds files that are not scanfind's: choose another folder"
        raise OutputError(msg)
    if not overwrite:
        msg = f"{target}: holds an earlier result: choose another folder or pass --overwrite"
        raise OutputError(msg)
    foreign = sorted(_files_under(target) - kind.files(target))
    if foreign:
        msg = f"{target}: holds {foreign[0]}, which scanfind did not write: move it away or choose another folder"
        raise OutputError(msg)


def write_results(
    findings: Findings,
    out: str | Path,
    *,
    models: ModelLibrary,
    parameters: object,
    seed: int = 0,
    format: str = "ply",
    overwrite: bool = False,
) -> schema.Results:
    """Write everything found into a new folder `out`; returns what its results.json holds.

    Arguments and errors as for `fill_folder` and `result_folder`.
    """
    with result_folder(out, overwrite=overwrite) as folder:
        return fill_folder(folder, findings, models=models, parameters=parameters, seed=seed, format=format)


def fill_folder(
    folder: Path,
    findings: Findings,
    *,
    models: ModelLibrary,
    parameters: object,
    seed: int = 0,
    format: str = "ply",
    remainder: str | None = None,
    sought: Sequence[schema.ModelEntry] = (),
    progress: Progress | None = None,
) -> schema.Results:
    """Fill a staged result folder with everything found; returns what its results.json holds.

    folder : exists and is empty but for `remainder`, see `result_folder`
    models : the library that was searched
    parameters : of the search, a nested dataclass (or what results.json says of one)
    format : of the isolated clouds: ply, laz, las, e57 or pcd
    remainder : the file in `folder` that holds the rest of the scene, where one was written
    sought : what was sought, where that is more than `models` has

    Raises UnsupportedFormatError for another format, OutputError where the disk says no.
    """
    began = time.perf_counter()
    files: dict[int, tuple[str, str | None]] = {}
    total, written = sum(len(found.isolated or ()) for found in findings), 0
    for found in findings:
        stem = f"{found.id:03d}_{safe_name(found.model)}"
        pose = f"poses/{stem}.txt"
        points = f"points/{stem}.{format}" if found.isolated is not None else None
        files[found.id] = pose, points
        _write_pose(folder / pose, found.scene_from_model)
        if found.isolated is not None:
            _write_points(folder / f"points/{stem}.{format}", found.id, found.isolated, findings)
            written += len(found.isolated)
            if progress is not None:
                progress("write", written, total)
    if kept := {found.model for found in findings} | {each.model for each in findings.elements}:
        _write_models(folder / MODELS, models, kept)
    results = document(
        findings, models=sought or model_entries(models), parameters=parameters, seed=seed, files=files,
        remainder=remainder,
    )  # fmt: skip
    _write_csv(folder / RESULTS_CSV, results)
    if results.elements:
        _write_elements(folder / ELEMENTS_CSV, results)
    if any(found.dimensions for found in results.detections):
        _write_dimensions(folder / DIMENSIONS_CSV, results)
    took = time.perf_counter() - began
    timings = results.timings_s | {"write": took, "total": results.timings_s["total"] + took}
    results = results.model_copy(update={"timings_s": timings})
    (folder / RESULTS_JSON).write_text(results.to_json() + "\n", encoding="utf-8")
    return results


def open_remainder(path: Path, scans: Sequence[str | Path]) -> CloudWriter:
    """A cloud file with room for every field of the scans, and for scan_id and source_index.

    Raises as `scan_info` and `open_writer` do.
    """
    import numpy as np

    from scanfind.scans import open_writer, scan_info

    infos = [scan_info(scan) for scan in scans]
    fields: dict[str, np.dtype[Any]] = {}
    for name, kind in (field for info in infos for field in info.attributes.items()):
        fields[name] = np.promote_types(fields.get(name, kind), kind)
    fields |= {"scan_id": np.dtype(np.int32), "source_index": np.dtype(np.int64)}
    corner = next((info.bounds[0] for info in infos if info.bounds), (0.0, 0.0, 0.0))
    return open_writer(path, fields, shift=shift_for(corner), crs=next((info.crs for info in infos if info.crs), None))


def read_results(folder: str | Path) -> schema.Results:
    """results.json of a result folder (or the file itself).

    Raises UnreadableFileError where it is missing, damaged, or of a version this scanfind does not know.
    """
    path = Path(folder)
    path = path / RESULTS_JSON if path.is_dir() else path
    try:
        return schema.Results.model_validate_json(path.read_bytes())
    except OSError as error:
        msg = f"{path}: no result to read: {error.strerror}: name the folder that `scanfind find --out` wrote"
        raise UnreadableFileError(msg) from error
    except ValueError as error:  # pydantic's ValidationError is one
        first = str(error).splitlines()
        msg = f"{path}: not a results.json of this version of scanfind: {' '.join(first[1:3])}: search again"
        raise UnreadableFileError(msg) from error


def safe_name(name: str) -> str:
    """A model's name as part of a file name on any system: letters and digits of any script, `-`, `_`, inner dots."""
    plain = re.sub(r"[^\w.-]+", "_", unicodedata.normalize("NFC", name)).strip("._")
    return plain.encode()[:NAME_BYTES].decode(errors="ignore") or "model"


def _write_models(path: Path, models: ModelLibrary, names: set[str]) -> None:
    """The models found, so that their points can be cut again without the library that was searched, and the design's.

    What an older result did not keep cannot be kept again.
    """
    from scanfind.library import ModelLibrary

    with ModelLibrary.open(path, create=True) as kept:
        for name in sorted(names.intersection(models.names())):
            kept.put(models.get(name))


def _write_pose(path: Path, pose: Pose) -> None:
    """Four rows of four numbers, scene_from_model, as CloudCompare's Edit > Apply transformation takes them."""
    path.parent.mkdir(exist_ok=True)
    rows = (" ".join(repr(value) for value in row) for row in pose.matrix().tolist())
    path.write_text("\n".join(rows) + "\n", encoding="ascii")


def _write_points(path: Path, instance: int, points: IsolatedPoints, findings: Findings) -> None:
    """The isolated points with every field of the scan, and instance, scan_id, source_index, deviation."""
    import numpy as np

    from scanfind.scans import open_writer

    path.parent.mkdir(exist_ok=True)
    # Ours win over fields of the same name: a scan that was a result before has them too, and they are stale.
    columns = dict(points.attributes) | {
        "instance": np.full(len(points), instance, np.int32),
        "scan_id": points.scan_id,
        "source_index": points.source_index,
        "deviation": points.deviation,
    }
    fields = {name: column.dtype for name, column in columns.items()}
    with open_writer(path, fields, shift=findings.shift, crs=findings.crs) as writer:
        # In pieces: the points of a tiled search are mapped from disk, and may be more than memory holds.
        for start in range(0, max(len(points), 1), CHUNK_POINTS):
            some = slice(start, start + CHUNK_POINTS)
            writer.write(points.xyz[some], {name: column[some] for name, column in columns.items()})


CSV_COLUMNS = (
    "id", "model", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw", "score", "support", "visible_support", "penalty",
    "coverage", "rms_m", "sigma_m", "sigma_deg", "points", "deviation_mean_m", "deviation_rms_m", "deviation_p95_m",
    "deviation_worst_m", "unobservable", "isolated", "probability",
)  # fmt: skip


def _write_csv(path: Path, results: schema.Results) -> None:
    """One line a detection, for spreadsheets."""
    with path.open("w", newline="", encoding="utf-8") as file:
        out = csv.writer(file)
        out.writerow(CSV_COLUMNS)
        for found in results.detections:
            q, deviation = found.quaternion, found.deviation
            sigma_deg = None if found.sigma_rad is None else degrees(found.sigma_rad)
            out.writerow(
                [found.id, found.model, *found.translation_m, q.x, q.y, q.z, q.w, found.score, found.support]
                + [
                    found.visible_support,
                    found.penalty,
                    found.coverage,
                    found.rms_m,
                    found.sigma_m,
                    sigma_deg,
                    found.points,
                ]
                + ([""] * 4 if deviation is None else list(deviation.model_dump().values()))
                + [" ".join(motion.kind for motion in found.unobservable), found.isolated or "", found.probability]
            )


ELEMENT_COLUMNS = (
    "global_id", "ifc_class", "name", "model", "status", "verdict", "detection", "shift_x_m", "shift_y_m", "shift_z_m",
    "turn_deg", "off_m", "on", "beside", "through", "hidden", "why", "verdict_why",
)  # fmt: skip


def _write_elements(path: Path, results: schema.Results) -> None:
    """One line an element of the design, for spreadsheets."""
    with path.open("w", newline="", encoding="utf-8") as file:
        out = csv.writer(file)
        out.writerow(ELEMENT_COLUMNS)
        for each in results.elements:
            turn_deg = None if each.turn_rad is None else degrees(each.turn_rad)
            out.writerow([
                each.global_id, each.ifc_class, each.name, each.model, each.status, each.verdict, each.detection,
                *(each.shift_m or (None, None, None)), turn_deg, each.off_m, each.on, each.beside, each.through,
                each.hidden, each.why, each.verdict_why,
            ])  # fmt: skip


DIMENSION_COLUMNS = ("id", "model", "dimension", "kind", "unit", "design", "built", "difference", "sigma", "why")


def _write_dimensions(path: Path, results: schema.Results) -> None:
    """One line a key dimension of a detection, metres or degrees."""
    with path.open("w", newline="", encoding="utf-8") as file:
        out = csv.writer(file)
        out.writerow(DIMENSION_COLUMNS)
        for found in results.detections:
            for each in found.dimensions:
                unit, factor = ("deg", degrees(1.0)) if each.kind == "angle" else ("m", 1.0)
                difference = None if each.built is None else each.built - each.design
                values = (each.design, each.built, difference, each.sigma)
                numbers = [None if value is None else factor * value for value in values]
                out.writerow([found.id, found.model, each.name, each.kind, unit, *numbers, each.why])


def _files_under(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir()}


def _files_of(results: schema.Results) -> set[str]:
    """What a result folder with this results.json holds."""
    parts = [name for found in results.detections for name in (found.pose, found.isolated)]
    elements = [ELEMENTS_CSV] if results.elements else []
    elements += [DIMENSIONS_CSV] if any(found.dimensions for found in results.detections) else []
    return {RESULTS_JSON, RESULTS_CSV, MODELS, *elements, *(name for name in [*parts, results.remainder] if name)}


def _swap(staged: Path, target: Path) -> None:
    """Give the finished folder its name; an older result goes only when the new one stands."""
    if not target.exists():
        staged.rename(target)
        return
    older = target.with_name(f".{target.name}.{os.getpid()}.older")
    target.rename(older)
    try:
        staged.rename(target)
    except OSError:
        older.rename(target)
        raise
    shutil.rmtree(older)
