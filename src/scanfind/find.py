"""THE PAGE: the whole method, one step a line (Sharif, Nahangi, Haas & West 2017; section numbers are theirs)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from scanfind.clock import Clock, say_if_compiling, watched
from scanfind.detection import Findings
from scanfind.errors import require
from scanfind.fit.polish import polished
from scanfind.grid.moments import MomentGrid
from scanfind.grid.scene import build_scene, without_sparse_levels
from scanfind.isolation.own import isolation_gate, with_own_points
from scanfind.parameters import PRESETS, Parameters
from scanfind.priors.allowed import box_searched, require_points_in
from scanfind.recognition.in_place import asked_of
from scanfind.recognition.recognise import Recognition
from scanfind.recognition.sizes import Sizes
from scanfind.scale import in_metres, scan_scale
from scanfind.scans.sources import Scan, Sources, require_points
from scanfind.second_pass import (
    near_parts,
    plans_of,
    surfaces_of,
    with_dimensions,
    with_points,
    write_left_over,
)
from scanfind.sought import ModelInput, models_of
from scanfind.threads import available_cores

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from scanfind.progress import Progress
    from scanfind.recognition.candidate import Standing
    from scanfind.recognition.in_place import Asked
    from scanfind.recognition.sizes import Size
    from scanfind.scans import CloudWriter


def find(
    scans: Scan | Sequence[Scan],
    models: ModelInput | Sequence[ModelInput],
    *,
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
) -> Findings:
    """Find every instance of every model in the scans, with no initial guess.

        scans : files, (N, 3) float64 arrays in metres, or PointClouds; several are one scene
        models : a ModelLibrary or its path, meshes, pieces of scan, or files of them
        parameters : by stage, and what is known beforehand (`priors`); None: the default preset
        seed : of everything that is drawn; the same seed finds the same on any number of threads, unless time runs out
        jobs : threads; None: one a core
        origin : (3,) where the scanner stood, for scans that do not say; with none, free space says nothing
        units : of model files whose format has none; select : which models of an IFC file
        progress : called with (stage, done, total), total -1 where nobody knows
        isolate : cut each detection's raw points in a second pass
        remainder : takes every point that belongs to no detection, in a third pass
        at_design : try where the design puts each model first, and say what became of every element: see
            `Findings.elements`; the scans are in the design's frame
    Returns the detections, best first; poses in the scans' own frame, metres; where the scale was free, in the scans
    times `Findings.scan_scale`.

    Raises ScanfindError: UsageError, UnreadableFileError, InvalidGeometryError, LibraryError …
    """
    parameters, jobs = parameters or PRESETS["default"], jobs or available_cores()
    require(seed >= 0, "seed", seed, "0 or more")
    free = parameters.priors.scale_free
    require(not (free and at_design), "scale_free", free, "0 where models are tried in their places")
    require(isolate or remainder is None, "isolate", isolate, "True where a remainder is asked for")
    clock, tell = Clock(), progress or (lambda stage, done, total: None)
    findings = Findings()

    say_if_compiling(tell)

    with clock("read"):
        sources = Sources(scans, origin)
    with clock("library"):
        library = models_of(models, parameters, units, select, jobs, tell)  # 3.2 model library: its surfaces
        box = box_searched(library, parameters.priors, parameters.search.max_instances)

    if free:  # one scale for all: from here on the scans are in metres, and everything is rigid
        findings.scan_scale = scan_scale(sources, library, parameters, box, seed, jobs, clock, tell)
        parameters = in_metres(sources, parameters, findings.scan_scale.metres)
        box = box_searched(library, parameters.priors, parameters.search.max_instances)

    with clock("grid"):  # 3.1, 3.3 scene representation: the weighted octree, in one pass
        found = Sizes(library, parameters)
        grid = MomentGrid(found.finest_cell(), jobs=jobs, box=box)
        for chunk in watched(sources.chunks(), clock, tell, "read", sources.expected()):
            grid.add(chunk)
        require_points(sources)
        grid.release()
        require_points_in(box, grid.points, grid.offset)
        grid = without_sparse_levels(grid, found.smallest(), parameters.grid)

    asked = asked_of(library) if at_design else None
    for size in found.groups():  # large models first, each size at its own resolution
        found.add(recognise(size, grid, found.standing(), parameters, seed, jobs, clock, tell, asked))
    del grid
    tell("search", 1.0, 1.0)

    findings.extend(found.detections())
    findings.refused = found.refused()
    if isolate and (parts := found.built()):
        with clock("isolate"):  # each part by its own raw points, in a pass of its own: where they are decides 3.5
            beside = near_parts(parts, watched(sources.chunks(), clock, tell, "isolate", sources.expected()), jobs)
            findings[:] = [found.measured(one, beside.get(one.id)) for one in findings]
    if isolate and findings:
        with clock("isolate"):  # 3.5 isolation: the second pass
            chunks = watched(sources.chunks(), clock, tell, "isolate", sources.expected())
            tolerance = isolation_gate(parameters.isolate, found.noise(), found.cell())
            findings.tolerance_m = tolerance
            surfaces = surfaces_of(findings, library, tolerance)
            plans = plans_of(findings, library) if parameters.isolate.dimensions else {}
            built, reach = found.built(), max([tolerance, *(plan.reach for plan in plans.values())])
            findings[:], around = with_points(findings, surfaces, built, chunks, tolerance, jobs, reach)
        with clock("refine"):  # 3.4 once more, on the raw points: the exact surface, and how uncertain the pose is
            # Parts were fitted to the raw points before.
            findings[:] = [
                one if one.parts else polished(one, surfaces[one.model], parameters.refine, jobs) for one in findings
            ]
            finest = found.finest_cell()
            findings[:] = [with_own_points(one, parameters.isolate, tolerance, finest) for one in findings]
        with clock("measure"):  # what a drawing would dimension, as built
            places = [place for source in sources.all for place in source.told().stations]
            findings[:] = with_dimensions(findings, plans, surfaces, around, places, reach, built)
    if remainder is not None:
        with clock("isolate"):
            chunks = watched(sources.chunks(), clock, tell, "remainder", sources.expected())
            write_left_over(remainder, chunks, findings)
    findings.scans = [source.told() for source in sources.all]
    with clock("verify"):
        findings[:], findings.elements = found.told(findings, findings.stations(), at_design=at_design)
    findings.expected = parameters.priors.expected([model.name for model in library])
    findings.crs, findings.notes = sources.crs(), [*findings.as_known(), *found.notes()]
    findings.shift = found.shift()
    findings.timings_s = clock.timings()
    return findings


def recognise(
    size: Size, grid: MomentGrid, standing: Sequence[Standing], parameters: Parameters, seed: int, jobs: int,
    clock: Clock, tell: Progress, asked: Asked | None = None, learnt: Sequence[float] = (),
) -> Recognition:  # fmt: skip
    """The search for models of one size: what is believed of them, and why (paper 3.3 and 3.4).

    standing : instances of larger models; asked : where the design has models, to be tried there first
    learnt : of each model, how many of the right pairs found it in other parts of the site, see Search
    """
    found = begin(size, grid, standing, parameters, seed, jobs, clock, asked, learnt)
    while found.wants_more(clock.elapsed("search", "refine", "verify") / size.patience):
        tell("search", size.progress(found.progress()), 1.0)
        with clock("search"):
            hypotheses = found.round()  # 3.3, 3.4 Algorithm 2: draw, look up, pose, count support
        with clock("refine"):
            poses = found.refine(hypotheses)  # 3.4 post-ICP
        with clock("verify"):
            found.believe(hypotheses, poses)  # support, penalty, conflicts (Papazov & Burschka 2010)
    return found


def begin(
    size: Size, grid: MomentGrid, standing: Sequence[Standing], parameters: Parameters, seed: int, jobs: int,
    clock: Clock, asked: Asked | None = None, learnt: Sequence[float] = (),
) -> Recognition:  # fmt: skip
    """The same search before its first round: the scene, the pairs, and what stands where the design has it."""
    with clock("grid"):
        smallest = min(model.diameter for model in size.models)
        scene = build_scene(grid, smallest, parameters.grid, parameters.search.test_cells_across, jobs)
    found = Recognition(scene, size.models, parameters, seed, jobs, standing, asked, learnt)
    with clock("place"):  # no part of the time limit: of a building it takes longer, and all of it is asked for
        for hypotheses in found.at_design():
            found.believe_in_place(found.refine_in_place(hypotheses))
    return found
