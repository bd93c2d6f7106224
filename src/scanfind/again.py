"""Isolate again: the points of instances found before, cut out of the scans anew. No search, and no library needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from scanfind.clock import Clock, say_if_compiling, watched
from scanfind.detection import Findings
from scanfind.errors import UsageError
from scanfind.isolation.own import within
from scanfind.library import ModelLibrary
from scanfind.results import MODELS, fill_folder, open_remainder, read_results, result_folder, schema
from scanfind.results.document import findings_of
from scanfind.scans.sources import Sources
from scanfind.second_pass import plans_of, surfaces_of, with_dimensions, with_points, write_left_over
from scanfind.threads import available_cores
from scanfind.tolerances import judge_findings, profile_in

if TYPE_CHECKING:
    from scanfind.progress import Progress


def isolate_again(
    result_dir: str | Path,
    scans: Sequence[str | Path],
    *,
    tolerance: float | None = None,
    out: str | Path | None = None,
    format: str = "ply",
    overwrite: bool = False,
    progress: Progress | None = None,
) -> schema.Results:
    """Cut the points of a result's detections out of `scans` and write the result anew; returns its results.json.

    result_dir : a folder that `write_results` (or `scanfind find --out`) wrote
    scans : the files that were searched, or others in the same frame
    tolerance : points this near to a placed model are its own, metres; None as before
    out : a new folder; None replaces `result_dir`, which stays as it is until the new one stands
    overwrite : replace an older result in `out`; never anything else

    Raises UnreadableFileError for no result or a scan that cannot be read, UsageError for no tolerance, OutputError.
    """
    before = read_results(result_dir)
    widest = before.tolerance_m if tolerance is None else tolerance
    if widest is None:
        msg = f"{result_dir}: its points were never isolated: give a tolerance, such as --tolerance 0.01 (metres)"
        raise UsageError(msg)
    found, sources, clock = findings_of(before), Sources(list(scans)), Clock()
    if found.scan_scale:
        sources.in_metres(found.scan_scale.metres)
    tell = progress or (lambda stage, done, total: None)
    with (
        result_folder(result_dir if out is None else out, overwrite=overwrite or out is None) as folder,
        ModelLibrary.open(Path(result_dir) / MODELS) if found or found.elements else ModelLibrary.in_memory() as models,
    ):
        with clock("isolate"):
            say_if_compiling(tell)
            chunks = watched(sources.chunks(), clock, tell, "isolate", sources.expected())
            # Of the whole model as designed, also where the search fitted its parts one by one.
            surfaces = surfaces_of(found, models.models(), widest)
            plans = plans_of(found, models.models()) if before.measured() else {}
            reach = max([widest, *(plan.reach for plan in plans.values())])
            _, around = with_points(found, surfaces, {}, chunks, widest, available_cores(), reach)
            cut = [within(one, around[one.id], tolerance or one.tolerance_m or widest) for one in found]
        if before.remainder:
            with clock("isolate"), open_remainder(folder / before.remainder, scans) as rest:
                chunks = watched(sources.chunks(), clock, tell, "remainder", sources.expected())
                write_left_over(rest, chunks, cut)
        # Where the scanner stood may have been told to the search by hand.
        stood = {scan.path: scan.stations for scan in found.scans}
        scanned = [source.told() for source in sources.all]
        seen = [replace(scan, stations=stood.get(scan.path, scan.stations)) for scan in scanned]
        stations = [place for scan in seen for place in scan.stations]
        with clock("measure"):
            # Where the parts were fitted one by one, the search measured them where they were built.
            whole = with_dimensions([one for one in cut if not one.parts], plans, surfaces, around, stations, reach, {})
            measured = {one.id: one for one in whole}
        findings = Findings([measured.get(one.id, one) for one in cut])
        findings.refused, findings.notes = found.refused, found.notes
        findings.elements, findings.alignment = found.elements, found.alignment
        findings.scan_scale = found.scan_scale
        findings.shift, findings.crs, findings.tolerance_m = found.shift, found.crs, widest
        findings.scans = seen
        if profile := profile_in(before):
            judge_findings(findings, profile, models)
        findings.timings_s = clock.timings()
        return fill_folder(
            folder, findings, models=models, sought=before.models, parameters=before.parameters, seed=before.seed,
            format=format, remainder=before.remainder, progress=progress,
        )  # fmt: skip
