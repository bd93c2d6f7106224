"""Sites of any size: `find` in tiles, on any number of workers, with what is done kept.

    sum up    each scan, once: its moments and beams, by bins, on disk      one task a scan
    cut       the site into tiles that fit the memory, from what bins hold
    search    each tile with its margin, larger models first; again where
              other tiles tell that it was not enough                       one task a tile
    own       each instance once: by the tile that has its middle
    isolate   each scan, once more: the points of every instance            one task a scan
    tell      what beams say of each instance and each element of a design  one task a tile

Peak memory depends on the surface in a tile and on the library, never on the number of points. What a task gives
depends on nothing but the scans and the parameters, so results are the same on any workers
(decisions/0018-moments-by-bins.md).
"""

from __future__ import annotations

import pickle
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from tempfile import mkdtemp
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from pydantic_core import to_jsonable_python

from scanfind.clock import Clock, say_if_compiling
from scanfind.cloud import shift_for
from scanfind.design.elements import placements_of
from scanfind.detection import Findings
from scanfind.errors import Interrupted, UnreadableFileError, UnsupportedFormatError, UsageError, require
from scanfind.grid.moments import MomentGrid
from scanfind.isolation.own import isolation_gate
from scanfind.parameters import PRESETS, Parameters
from scanfind.priors.allowed import box_searched, require_points_in
from scanfind.recognition.sizes import Sizes
from scanfind.results.document import fingerprint
from scanfind.scans.sources import Scan
from scanfind.sought import ModelInput, models_of
from scanfind.threads import available_cores
from scanfind.tiles.listed import Listed, listed_of
from scanfind.tiles.plan import (
    Held,
    bin_blocks,
    estimate,
    margin_of,
    words,
)
from scanfind.tiles.points import isolate_all, write_remainder
from scanfind.tiles.search import Searched, cell_of, own
from scanfind.tiles.stored import parts_of, reached_from, stored_bins
from scanfind.tiles.sweep import search_all
from scanfind.tiles.tasks import Job, Summed, count, sum_up
from scanfind.tiles.told import all_told
from scanfind.tiles.work import Crew, Here, Workers, all_done, no_room, opened

if TYPE_CHECKING:
    from scanfind.detection import Detection, Refused
    from scanfind.library.model import Model
    from scanfind.progress import Progress
    from scanfind.scans import CloudWriter
    from scanfind.tiles.plan import Tile

__all__ = ["find_in_tiles"]

MEMORY = 2_000_000_000  # a worker, where nobody says
ROWS_AT_ONCE = 10_000_000  # counted by one worker, 80 MB and as much to sort them
REFUSED_SHOWN = 3  # of each model


def find_in_tiles(
    scans: Scan | Sequence[Scan],
    models: ModelInput | Sequence[ModelInput],
    *,
    executor: Workers | None = None,
    memory: int = MEMORY,
    work: str | Path | None = None,
    resume: bool = False,
    parameters: Parameters | None = None,
    seed: int = 0,
    jobs: int | None = None,
    origin: ArrayLike | None = None,
    units: str | None = None,
    select: Sequence[str] = (),
    progress: Progress | None = None,
    isolate: bool = True,
    remainder: CloudWriter | None = None,
    at_design: bool = False,
    say: Callable[[str], None] | None = None,
) -> Findings:
    """As `find`, for sites of any size: the same detections and elements, to what a pose is sure by.

        executor : any of concurrent.futures, or what makes one: then a pool whose worker was killed is made anew.
            Workers see the same files under the same names. None: this process
        memory : bytes a worker may take; the site is cut into tiles that fit. The result depends on it, as tiles have
            edges, but not on the executor
        work : a folder for what is done, kept when the run ends early, and by its caller afterwards: points of
            detections are mapped from it. With `at_design` in a folder of its own there. None: a temporary one
        resume : go on with what `work` holds
        jobs : threads of a worker
        remainder : takes every point that belongs to no detection; this process reads all scans once more for it
        say : is told, in a line, what the run will take, and what became of each scan
        the rest as for `find`; `search.time_limit_s` is of each tile. Models are not fitted in parts.
    Returns the findings; scans that could not be read are named in its notes and have no points.

    Raises as `find` does; UsageError before anything is read where the memory cannot be kept; OutputError where the
    disk is full or workers keep dying; Interrupted. After these `resume` goes on.
    """
    parameters, say = parameters or PRESETS["default"], say or (lambda line: None)
    if parameters.assembly.parts:
        msg = "find: parts are not fitted in tiles: leave out --parts, or --memory, --workers and --scheduler"
        raise UsageError(msg)
    if parameters.priors.scale_free:
        msg = "find: a free scale is not found in tiles: leave out --scale-free, or --memory, --workers and --scheduler"
        raise UsageError(msg)
    require(isolate or remainder is None, "isolate", isolate, "True where a remainder is asked for")
    tell = progress or (lambda stage, done, total: None)
    say_if_compiling(tell)
    clock = Clock()
    with clock("library"):
        library = models_of(models, parameters, units, select, jobs, tell)
    listed = listed_of(scans, origin)
    with ExitStack() as stack:
        folder = Path(work).absolute() if work is not None else Path(mkdtemp(prefix="scanfind-"))
        if work is None:
            stack.callback(shutil.rmtree, folder, ignore_errors=True)
        if at_design:  # an inspection may find where the design lies, and put it there: that is another run
            folder /= digest_of_places(library)
        try:
            crew = stack.enter_context(Crew(executor or Here()))
            return _find(
                folder, listed, library, crew, memory, parameters, seed, jobs or available_cores(), clock, tell, say,
                remainder, resume=resume or work is None, isolate=isolate, at_design=at_design,
            )  # fmt: skip
        except KeyboardInterrupt as error:
            if work is None:
                raise
            msg = f"interrupted: what is done lies in {folder}: give --resume to go on with it"
            raise Interrupted(msg) from error


def _find(
    folder: Path, listed: Listed, library: list[Model], crew: Crew, memory: int, parameters: Parameters,
    seed: int, jobs: int, clock: Clock, tell: Progress, say: Callable[[str], None], remainder: CloudWriter | None, *,
    resume: bool, isolate: bool, at_design: bool,
) -> Findings:  # fmt: skip
    sizes = Sizes(library, parameters)
    cell = sizes.finest_cell()
    blocks = bin_blocks(cell, min(model.diameter for model in library))
    box = box_searched(library, parameters.priors, parameters.search.max_instances)
    job = Job(folder, cell, (0.0, 0.0, 0.0), blocks, memory, jobs, parameters, seed, listed.origin, box, at_design)
    keep_memory(job, sizes, listed, say)

    begin(job, listed, library, resume=resume)
    with clock("read"):
        job = replace(job, offset=offset_of(listed, cell))
    with clock("grid"):
        summed = sum_all_up(job, listed, crew, tell, say)
        folders = [folder / scan_name(k) for k, one in enumerate(summed) if not one.missing]
        parts = parts_of(folders)
        held = held_by(job, parts, crew)
        require_points_in(box, int(held.rows.sum()), job.offset)

    findings, searched, largest = Findings(), list[Searched](), None
    swept: list[dict[Tile, Searched]] = []  # of each size
    for group, size in enumerate(sizes.groups()):
        with clock("search"):
            found = search_all(job, group, size.models, held, summed, folders, findings, searched, crew, tell)
            findings.extend(own(found, job))
            swept.append(found)
            searched += found.values()
            largest = largest or next((one for one in typical(found) if one.detections), None)
    findings[:] = numbered(findings, parameters.search.max_instances)
    findings.refused = closest(searched)

    with clock("isolate"):
        one = largest or searched[-1]
        tolerance = isolation_gate(parameters.isolate, one.noise, one.cell)
        if isolate and findings:
            findings.tolerance_m = tolerance
            findings[:] = isolate_all(job, listed, findings, tolerance, summed, crew, clock, tell)
        if remainder is not None:
            write_remainder(listed, findings, summed, remainder, tell)
    findings.scans, findings.crs = [one.told for one in summed], listed.crs()
    with clock("verify"):
        if at_design or len(findings.stations()) > 1:
            findings[:], findings.elements = all_told(job, findings, swept, findings.stations(), folders, crew)
    findings.expected = parameters.priors.expected([model.name for model in library])
    findings.missing = [f"{one.told.path} was left out: {one.missing}" for one in summed if one.missing]
    left_out = sum(one.unaddressable for one in summed)
    findings.notes = [
        *findings.missing,
        *findings.as_known(),
        *dict.fromkeys(note for each in searched for note in each.notes),
    ]
    findings.notes += [f"{left_out} points lie too far from the rest and were left out"] if left_out else []
    x, y, z = shift_for(job.offset).tolist()
    findings.shift, findings.timings_s = (x, y, z), clock.timings()
    return findings


def keep_memory(job: Job, sizes: Sizes, listed: Listed, say: Callable[[str], None]) -> None:
    """Say what the run will take; raise UsageError where the memory given is not enough for its smallest tile."""
    groups = [(cell_of(job, size.models)[0], margin_of(size.models)) for size in sizes.groups()]
    needs = estimate(listed.infos(), groups, job.cell, job.bin_m())
    say(f"{needs.words()}; {words(job.memory)} a worker")
    if needs.least_memory > job.memory:
        msg = (
            f"--memory {words(job.memory)} cannot be kept: the smallest tile around a model needs about "
            f"{words(needs.least_memory)}: give more, or larger cells (grid.cell_m, now {1e3 * job.cell:.1f} mm)"
        )
        raise UsageError(msg)


def begin(job: Job, listed: Listed, library: list[Model], *, resume: bool) -> None:
    """Open the working folder, with the models in it."""
    told = {
        "scans": [[source.path, fingerprint(Path(source.path))] for source in listed.all],
        "models": [[model.name, model.sha256] for model in library],
        "parameters": to_jsonable_python(job.parameters),
        "seed": job.seed,
        "origin": job.origin,
    }
    opened(job.folder, told, resume=resume)
    try:
        if not (job.folder / "models").is_file():
            with (job.folder / "models.part").open("wb") as file:
                pickle.dump(library, file)
            (job.folder / "models.part").replace(job.folder / "models")
    except OSError as error:
        raise no_room(job.folder, error) from error


def digest_of_places(library: Sequence[Model]) -> str:
    """Of where the design puts every model."""
    digest = sha256()
    for model in library:
        for place in placements_of(model):
            digest.update(f"{model.name} {place.global_id}".encode() + place.design_from_model.matrix().tobytes())
    return digest.hexdigest()[:16]


def offset_of(listed: Listed, cell: float) -> tuple[float, float, float]:
    """The grid's origin as `find` would choose it: from the first points of the first scan that can be read."""
    grid, last = MomentGrid(cell), None
    for source in listed.all:
        try:
            for chunk in source.opened(listed.origin).chunks():
                grid.add(chunk)
                if grid.offset is not None:
                    break
        except (UnreadableFileError, UnsupportedFormatError) as error:
            last = error
        if grid.offset is not None:
            break
    grid.release()
    if grid.offset is None:
        names = ", ".join(source.path for source in listed.all)
        msg = f"{names}: no valid point in it: check the export, or name another scan"
        raise last or UnreadableFileError(msg)
    x, y, z = grid.offset.tolist()
    return x, y, z


def sum_all_up(job: Job, listed: Listed, crew: Crew, tell: Progress, say: Callable[[str], None]) -> list[Summed]:
    """Every scan, summed up; those that cannot be read are told. Raises UnreadableFileError where none can."""
    began, points, done, expected = time.monotonic(), 0, 0, listed.expected()
    count = len(listed.all)

    def told(name: str, one: Summed) -> None:
        nonlocal points, done
        points, done = points + one.told.points + one.told.dropped, done + 1
        tell("read", points, expected)
        took = time.monotonic() - began
        share = points / expected if expected > 0 else done / count
        left = f", {took / share - took:.0f} s left" if 0.0 < share < 1.0 and done < count else ""
        what = one.missing or f"{one.told.points:,} points"
        rate = points / max(took, 1e-3) / 1e6
        say(f"{done} of {count}: {Path(one.told.path).name}: {what} ({rate:.1f} M points/s{left})")

    tasks = {scan_name(k): (sum_up, job, source.scan, k) for k, source in enumerate(listed.all)}
    summed: list[Summed] = all_done(job.folder, crew, tasks, told)
    if not any(one.told.points for one in summed):
        raise UnreadableFileError(next((one.missing for one in summed if one.missing), "no valid point in any scan"))
    say(f"{points:,} points in {time.monotonic() - began:.0f} s; {stored_words(job, listed)} on disk")
    return summed


def stored_words(job: Job, listed: Listed) -> str:
    """How much the moments of all scans take on disk."""
    return words(
        sum(file.stat().st_size for k in range(len(listed.all)) for file in (job.folder / scan_name(k)).rglob("*"))
    )


def held_by(job: Job, parts: list[Path], crew: Crew) -> Held:
    """What lies where in the site, once all scans are summed."""
    bins, rows, by_several = stored_bins(parts)
    doubtful = np.flatnonzero(by_several)
    lots = np.cumsum(rows[doubtful]) // ROWS_AT_ONCE
    some = [doubtful[lots == k] for k in np.unique(lots)]
    counted = all_done(job.folder, crew, {f"count-{k:05d}": (count, parts, bins[of]) for k, of in enumerate(some)})
    rows[doubtful] = np.concatenate([np.empty(0, np.int64), *counted])
    return Held(bins, rows, reached_from(parts) / job.bin_m())


def typical(found: Mapping[Tile, Searched]) -> list[Searched]:
    """Searches by how their noise ranks about its median among those that found something, nearest first."""
    with_some = [one for _, one in sorted(found.items()) if one.detections]
    middle = float(np.median([one.noise for one in with_some])) if with_some else 0.0
    return sorted(with_some, key=lambda one: abs(one.noise - middle))


def numbered(found: Sequence[Detection], most: int | None) -> list[Detection]:
    """Best first, numbered from 1; no more than so many."""
    best = sorted(found, key=lambda one: -round(one.score, 3))[:most]
    return [replace(one, id=number) for number, one in enumerate(best, start=1)]


def closest(searched: Sequence[Searched]) -> list[Refused]:
    """What came closest of each model, of all tiles."""
    kept: list[Refused] = []
    for one in sorted((one for each in searched for one in each.refused), key=lambda one: -one.score):
        same = [other for other in kept if other.model == one.model]
        at = one.scene_from_model.translation
        if len(same) < REFUSED_SHOWN and all(np.linalg.norm(o.scene_from_model.translation - at) > 1e-3 for o in same):
            kept.append(one)
    return kept


def scan_name(number: int) -> str:
    """The name of the task that sums a scan up."""
    return f"scan-{number:05d}"
