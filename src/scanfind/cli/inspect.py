"""`scanfind inspect`: a design and scans in; what became of every element, and how far off it is."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from scanfind.cli.options import Box, Count, Flag, Format, Metres, Names, Paths, Position, Seconds, Units, note, say
from scanfind.cli.outputs import NOT_AS_WANTED, SCANS_MISSING, results_of
from scanfind.errors import UsageError

if TYPE_CHECKING:
    from scanfind.results.schema import Results


def inspect(
    scans: Annotated[list[Path], Parameter(name="SCAN", negative=())],
    /,
    *,
    design: Paths,
    select: Names | None = None,
    units: Units | None = None,
    origin: Position | None = None,
    allowed: Annotated[str, Parameter(allow_leading_hyphen=True, metavar="M|PROFILE")] | None = None,
    out: Path | None = None,
    format: Format | None = None,
    overwrite: Flag = False,
    json: Flag = False,
    config: Path | None = None,
    seed: Count | None = None,
    jobs: Count | None = None,
    tolerance: Metres | None = None,
    dimensions: Flag = False,
    time_limit: Seconds | None = None,
    region: Box | None = None,
    near_design: Metres | None = None,
    align: Literal["auto", "always", "never"] = "auto",
    upright: Flag = False,
    fail_on: Literal["not-found", "out-of-tolerance"] | None = None,
    memory: str | None = None,
    workers: Count | None = None,
    scheduler: str | None = None,
    resume: Flag = False,
) -> int:
    """Say what became of every element of a design: is it there, and how far from where it should be?

    Each element is looked for where the design puts it, then anywhere. Where nothing is in its place, scans and design
    may be in different frames: where the design lies in the scans is then found from the elements themselves.

    For example:

        scanfind inspect shop.e57 --design steel.ifc --allowed 0.01 --out inspected
        scanfind inspect shop.e57 --design steel.ifc --allowed structural-steel --upright
        scanfind inspect shop.e57 --design steel.ifc --memory 3GB --out elements

    Parameters
    ----------
    scans
        Scan files: E57, LAS, LAZ, PLY, PCD, PTX, PTS, XYZ, CSV. They come before --design.
    design
        An IFC file, or models drawn where they should stand: STL, OBJ, PLY, GLB, OFF, 3MF, STEP.
    select
        Of an IFC file only these: class, name or GlobalId.
    units
        Of model files whose format does not say; metres unless given.
    origin
        X,Y,Z where the scanner stood, metres, for scans that do not say.
    allowed
        By how much an element may be off: metres, or a tolerance profile: pipe-spools, structural-steel or a TOML file.
    out
        A new folder for statuses, poses and points; nothing is written without it.
    format
        Of the isolated point clouds; ply unless given.
    overwrite
        Replace an older result in --out.
    json
        Print results.json on stdout instead of a table.
    config
        A TOML file of settings; flags and SCANFIND_... variables win over it.
    seed
        Of the random draws: the same seed gives the same answer; 0 unless given.
    jobs
        Threads; one a core unless given.
    tolerance
        Points this near to a found element are its own, metres; unless given, within four times what its own spread.
    dimensions
        Measure what a drawing would dimension as well: flange faces, pipes, lengths, squareness.
    time_limit
        Look for elements that are not in their place no longer than this, seconds.
    region
        Only elements whose place is in this box of the scan, low corner then high, metres.
    near_design
        Look for elements that are not in their place no farther from it than this, metres.
    align
        Find where the design lies in the scans: auto, where nothing is in its place; always; never.
    upright
        Up is the same in the scans and the design: no other way to align them is thought of.
    fail_on
        Exit with 3 if some element was not found, or is not found or out of tolerance.
    memory
        Inspect in tiles that fit a memory such as 3GB, of all workers together; a scan that cannot be read is left out.
    workers
        Inspect in tiles, with so many processes.
    scheduler
        Inspect in tiles, on the dask cluster of this address (tcp://...); --memory is then that of each worker.
    resume
        Go on with an inspection in tiles that ended early; what it had done lies beside --out.

    """
    if fail_on == "out-of-tolerance" and allowed is None:
        msg = "inspect: --fail-on out-of-tolerance needs to know how much is allowed: give --allowed"
        raise UsageError(msg)

    from scanfind.cli.inputs import open_models
    from scanfind.cli.tiled import Tiled, ending_workers
    from scanfind.config import load_settings
    from scanfind.find import find
    from scanfind.inspect import inspect as inspect_scans
    from scanfind.parameters import PRESETS
    from scanfind.progress import progress_on
    from scanfind.results import result_folder
    from scanfind.tolerances import profile_allowing

    flags = {
        "seed": seed, "jobs": jobs, "units": units, "origin": origin, "format": format, "select": select,
        "search.time_limit_s": time_limit, "isolate.tolerance_m": tolerance, "isolate.dimensions": dimensions or None,
        "priors.region": region, "priors.near_design_m": near_design,
    }  # fmt: skip
    run, parameters = load_settings(PRESETS, flags, config)
    tiled = Tiled.asked(memory, workers, scheduler, out, resume=resume)
    profile = None if allowed is None else profile_allowing(allowed)  # before the search: it may be misspelt
    with ExitStack() as stack:
        folder = None if out is None else stack.enter_context(result_folder(out, overwrite=overwrite))
        models = stack.enter_context(open_models(design, None, run, parameters))
        progress = stack.enter_context(progress_on())
        stack.enter_context(ending_workers())
        findings = inspect_scans(
            scans, models, parameters=parameters, seed=run.seed, jobs=tiled.threads(run.jobs) if tiled else run.jobs,
            origin=run.origin, progress=progress, align=align, upright=upright, allowed=profile,
            search=tiled.search() if tiled else find,
        )  # fmt: skip
        results = results_of(findings, folder, models, run, parameters, progress)
    if tiled is not None:
        tiled.finished()
    report(results, out, json=json)
    if fail_on and failed(results, fail_on):
        return NOT_AS_WANTED
    return SCANS_MISSING if findings.missing else 0


def report(results: Results, out: Path | None, *, json: bool) -> None:
    """The table (or results.json) on stdout; on stderr the sum of it and where it lies."""
    from scanfind.cli.tables import alignment_in_words, elements_in_words, elements_table

    say(results.to_json() if json else elements_table(results))
    if results.alignment is not None:
        note(alignment_in_words(results.alignment))
    for remark in results.notes:
        note(remark)
    points = sum(scan.points for scan in results.scans)
    where = "nothing written, give --out DIR to keep it" if out is None else f"results in {out}"
    note(f"{elements_in_words(results)}; {points:,} points, {results.timings_s['total']:.1f} s; {where}")


def failed(results: Results, on: str) -> bool:
    """Is some element not found or, where that is asked, out of tolerance?"""
    from scanfind.design.elements import NOT_FOUND, OUT_OF_TOLERANCE

    bad = {"not-found": {NOT_FOUND}, "out-of-tolerance": {NOT_FOUND, OUT_OF_TOLERANCE}}[on]
    return any(each.status in bad or each.verdict in bad for each in results.elements)
