"""`scanfind find`: models and scans in, every instance's pose and points out."""

from __future__ import annotations

from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from scanfind.cli.options import (
    Box,
    Count,
    Counts,
    Degrees,
    Direction,
    Flag,
    Format,
    Metres,
    Names,
    Paths,
    Position,
    Seconds,
    Share,
    Units,
    note,
    say,
)
from scanfind.cli.outputs import NOT_AS_WANTED, SCANS_MISSING, results_of
from scanfind.errors import UsageError

if TYPE_CHECKING:
    from scanfind.results.schema import Results


def find(
    scans: Annotated[list[Path], Parameter(name="SCAN", negative=())],
    /,
    *,
    model: Paths | None = None,
    library: Path | None = None,
    select: Names | None = None,
    units: Units | None = None,
    origin: Position | None = None,
    out: Path | None = None,
    format: Format | None = None,
    remainder: Flag = False,
    overwrite: Flag = False,
    json: Flag = False,
    preset: str | None = None,
    config: Path | None = None,
    seed: Count | None = None,
    jobs: Count | None = None,
    max_instances: Count | None = None,
    min_score: float | None = None,
    tolerance: Metres | None = None,
    parts: Flag = False,
    dimensions: Flag = False,
    time_limit: Seconds | None = None,
    region: Box | None = None,
    up: Direction | None = None,
    model_up: Direction | None = None,
    tilt: Degrees | None = None,
    near_design: Metres | None = None,
    turned: Degrees | None = None,
    expect: Counts | None = None,
    scale_free: Share | None = None,
    fail_on: Literal["not-found"] | None = None,
    memory: str | None = None,
    workers: Count | None = None,
    scheduler: str | None = None,
    resume: Flag = False,
) -> int:
    """Find every instance of every model in the scans; the files of several scans are one scene.

    For example:

        scanfind find shop.e57 --model spool.stl --units mm --out found

        scanfind find station1.laz station2.laz --library parts.scanfind --json

        scanfind find station*.laz --library parts.scanfind --memory 3GB --out site

        scanfind find shop.e57 --model spool.stl --region 0,0,0,8,5,3 --up z --expect 2

    Parameters
    ----------
    scans
        Scan files: E57, LAS, LAZ, PLY, PCD, PTX, PTS, XYZ, CSV, folders of them, or patterns. They come before --model.
    model
        Model files: STL, OBJ, PLY, GLB, OFF, 3MF, STEP, IFC, or a point cloud cut from a scan.
    library
        A model library made with `scanfind library add`, instead of --model.
    select
        Of an IFC file only these: class, name or GlobalId.
    units
        Of model files whose format does not say; metres unless given.
    origin
        X,Y,Z where the scanner stood, in the scan's coordinates, metres, for scans that do not say.
    out
        A new folder for poses and points; nothing is written without it.
    format
        Of the isolated point clouds; ply unless given.
    remainder
        Also write what is left of the scene without the found objects (needs --out).
    overwrite
        Replace an older result in --out.
    json
        Print results.json on stdout instead of a table.
    preset
        Settings to start from: default, structured-light or sharif2017.
    config
        A TOML file of settings; flags and SCANFIND_... variables win over it.
    seed
        Of the random draws: the same seed gives the same answer; 0 unless given.
    jobs
        Threads; one a core unless given.
    max_instances
        At most so many instances in all.
    min_score
        Refuse what scores less, 0 to 1.
    tolerance
        Points this near to a found model are its own, metres; unless given, within four times what its own spread.
    parts
        Fit the parts of each model one by one: find what was not built to the drawing, and tell which part is off.
    dimensions
        Measure what a drawing would dimension as well: flange faces, pipes, lengths, squareness.
    time_limit
        Search no longer than this, seconds.
    region
        Only instances whose middle lies in this box of the scan, low corner then high, metres.
    up
        Instances stand upright as they were drawn: this way is up in the scans.
    model_up
        The way that is up in the models as drawn; z unless given.
    tilt
        By how much they may lean then; 10 degrees unless given.
    near_design
        Only instances whose middle is this near to where the design puts it (or the model is drawn), metres.
    turned
        By how much they may be turned from the design then.
    expect
        How many there are of each model: with so many found its search ends, with fewer it goes on until --time-limit.
    scale_free
        The scans' unit may be off from a metre by this share, such as 0.1: find the scale by the models as well.
    fail_on
        Exit with 3 if some model was not found, or fewer of it than expected.
    memory
        Search in tiles that fit a memory such as 3GB, of all workers together; a scan that cannot be read is left out.
    workers
        Search in tiles, with so many processes.
    scheduler
        Search in tiles, on the dask cluster of this address (tcp://...); --memory is then that of each worker.
    resume
        Go on with a search in tiles that ended early; what it had done lies beside --out.

    """
    if (model is None) == (library is None):
        msg = "find: no model to look for: give --model FILE... after the scans, or --library LIB"
        raise UsageError(msg if model is None else "find: --model and --library exclude each other: give one of them")
    if remainder and out is None:
        msg = "find: --remainder has nowhere to go: give --out DIR"
        raise UsageError(msg)

    from scanfind.cli.inputs import expected, open_models
    from scanfind.cli.tiled import Tiled, ending_workers
    from scanfind.config import load_settings
    from scanfind.find import find as find_models
    from scanfind.parameters import PRESETS
    from scanfind.progress import progress_on
    from scanfind.results import open_remainder, result_folder
    from scanfind.scans.sources import files_of

    flags = {
        "preset": preset, "seed": seed, "jobs": jobs, "units": units, "origin": origin, "format": format,
        "select": select, "search.max_instances": max_instances, "search.time_limit_s": time_limit,
        "verify.min_score": min_score, "isolate.tolerance_m": tolerance,
        "isolate.dimensions": dimensions or None, "assembly.parts": parts or None,
        "priors.region": region, "priors.up": up, "priors.model_up": model_up, "priors.tilt_deg": tilt,
        "priors.near_design_m": near_design, "priors.turned_deg": turned, "priors.expect": expected(expect),
        "priors.scale_free": scale_free,
    }  # fmt: skip
    run, parameters = load_settings(PRESETS, flags, config)
    files = [Path(file) for scan in scans for file in files_of(scan)]
    tiled = Tiled.asked(memory, workers, scheduler, out, resume=resume)
    with ExitStack() as stack:
        folder = None if out is None else stack.enter_context(result_folder(out, overwrite=overwrite))
        models = stack.enter_context(open_models(model or [], library, run, parameters))
        progress = stack.enter_context(progress_on())
        rest = folder / f"remainder.{run.format}" if folder is not None and remainder else None
        readable = files if tiled is None else tiled.readable(files)
        sink = None if rest is None else stack.enter_context(open_remainder(rest, readable))
        stack.enter_context(ending_workers())
        search = find_models if tiled is None else tiled.search()
        findings = search(
            files, models, parameters=parameters, seed=run.seed, jobs=tiled.threads(run.jobs) if tiled else run.jobs,
            origin=run.origin, progress=progress, remainder=sink,
        )  # fmt: skip
        results = results_of(findings, folder, models, run, parameters, progress, remainder=rest.name if rest else None)
    if tiled is not None:
        tiled.finished()
    report(results, out, json=json)
    found = Counter(one.model for one in results.detections)
    missing = [entry.name for entry in results.models if found[entry.name] < (entry.expected or 1)]
    if fail_on == "not-found" and missing:
        return NOT_AS_WANTED
    return SCANS_MISSING if findings.missing else 0


def report(results: Results, out: Path | None, *, json: bool) -> None:
    """The table (or results.json) on stdout; on stderr where it lies and what was not found."""
    from scanfind.cli.tables import closest, found_table, parts_table

    if json:
        say(results.to_json())
    elif results.detections:
        say(found_table(results))
        if off := parts_table(results):
            say("\n" + off)
    for remark in [*results.notes, *closest(results)]:
        note(remark)
    points = sum(scan.points for scan in results.scans)
    where = "nothing written, give --out DIR to keep poses and points" if out is None else f"results in {out}"
    note(f"{len(results.detections)} found in {points:,} points, {results.timings_s['total']:.1f} s; {where}")
