"""`scanfind isolate`: cut the points of a result again, no search."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from scanfind.cli.options import Flag, Format, Metres


def isolate(
    result_dir: Path,
    scans: Annotated[list[Path], Parameter(name="SCAN", negative=())],
    /,
    *,
    tolerance: Metres | None = None,
    out: Path | None = None,
    format: Format = "ply",
    overwrite: Flag = False,
    json: Flag = False,
) -> None:
    """Cut the points of found instances out of the scans again, without searching.

    For example:

        scanfind isolate found shop.e57 --tolerance 0.02

    Parameters
    ----------
    result_dir
        The folder that `scanfind find --out` wrote.
    scans
        The scan files that were searched, or others of the same frame.
    tolerance
        Points this near to a found model are its own, metres; as in the search unless given.
    out
        A new folder for the result; without it the points in RESULT_DIR are replaced.
    format
        Of the isolated point clouds.
    overwrite
        Replace an older result in --out.
    json
        Print results.json on stdout instead of a table.

    """
    from scanfind.again import isolate_again
    from scanfind.cli.find import report
    from scanfind.progress import progress_on

    with progress_on() as progress:
        results = isolate_again(
            result_dir, scans, tolerance=tolerance, out=out, format=format, overwrite=overwrite, progress=progress
        )
    report(results, out or result_dir, json=json)
