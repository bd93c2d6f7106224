"""THE PAGE: the whole method, one step a line (Sharif, Nahangi, Haas & West 2017; section numbers are theirs)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanfind.assembly import REACH_M
from scanfind.clock import Clock, say_if_compiling, watched
from scanfind.cloud import CloudModel, PointChunk
from scanfind.detection import Findings
from scanfind.dimensions import Plan, dimensioned, plan_of
from scanfind.errors import UsageError, require
from scanfind.fit.polish import polished
from scanfind.grid.moments import MomentGrid
from scanfind.grid.scene import build_scene
from scanfind.isolation.deviation import deviation_of
from scanfind.isolation.isolate import IsolateParameters, Placed, nearer
from scanfind.isolation.isolate import isolate as isolate_raw
from scanfind.library import ModelLibrary, joint_table
from scanfind.library.model import Model, ModelParameters
from scanfind.library.near_surface import near_model, near_triangles
from scanfind.mesh import Mesh
from scanfind.parameters import PRESETS, IsolationParameters, Parameters
from scanfind.pose import Pose
from scanfind.priors.allowed import box_around
from scanfind.recognition.in_place import design_of
from scanfind.recognition.recognise import Recognition
from scanfind.recognition.sizes import Sizes
from scanfind.scans.sources import Scan, Sources, require_points
from scanfind.threads import available_cores

if TYPE_CHECKING:
    from scanfind.detection import Detection, IsolatedPoints
    from scanfind.evidence.free_space import Design
    from scanfind.kernels.distance import NearSurface
    from scanfind.progress import Progress
    from scanfind.recognition.candidate import Standing
    from scanfind.recognition.sizes import Size
    from scanfind.scans import CloudWriter

Floats: TypeAlias = NDArray[np.float64]
ModelInput: TypeAlias = "ModelLibrary | Mesh | CloudModel | str | PathLike[str]"


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
        remainder : takes every point that belongs to no detection
        at_design : try where the design puts each model first, and say what became of every element: see
            `Findings.elements`; the scans are in the design's frame
    Returns the detections, best first; poses in the scans' own frame, metres.

    Raises ScanfindError: UsageError, UnreadableFileError, InvalidGeometryError, LibraryError …
    """
    parameters, jobs = parameters or PRESETS["default"], jobs or available_cores()
    require(seed >= 0, "seed", seed, "0 or more")
    clock, tell = Clock(), progress or (lambda stage, done, total: None)
    findings = Findings()

    say_if_compiling(tell)

    with clock("read"):
        sources = Sources(scans, origin)
    with clock("library"):
        library = models_of(models, parameters, units, select)  # 3.2 model library: surface, pairs, hash table
        box = box_searched(library, parameters)

    with clock("grid"):  # 3.1, 3.3 scene representation: the weighted octree, in one pass
        found = Sizes(library, parameters)
        grid = MomentGrid(found.finest_cell(), jobs=jobs, box=box)
        for chunk in watched(sources.chunks(), clock, tell, "read", sources.expected()):
            grid.add(chunk)
        require_points(sources)
        grid.release()
        require_points_in(box, grid.points, grid.offset)

    design = design_of(library) if at_design else None
    for size in found.groups():  # large models first, each size at its own resolution
        found.add(
            recognise(
                size, grid, found.standing(), parameters, seed, jobs, clock, tell, at_design=at_design, design=design
            )
        )
    del grid
    tell("search", 1.0, 1.0)

    findings.extend(found.detections())
    findings.refused = found.refused()
    if isolate and (parts := found.built()):
        with clock("isolate"):  # each part by its own raw points, in a pass of its own: where they are decides 3.5
            beside = near_parts(parts, watched(sources.chunks(), clock, tell, "isolate", sources.expected()), jobs)
            findings[:] = [found.measured(one, beside.get(one.id)) for one in findings]
    if isolate and (findings or remainder is not None):
        with clock("isolate"):  # 3.5 isolation: the second pass
            chunks = watched(sources.chunks(), clock, tell, "isolate", sources.expected())
            tolerance = isolation_tolerance(parameters.isolate, found.noise(), found.cell())
            findings.tolerance_m = tolerance
            surfaces = surfaces_of(findings, library, tolerance)
            plans = plans_of(findings, library) if parameters.isolate.dimensions else {}
            built, reach = found.built(), max([tolerance, *(plan.reach for plan in plans.values())])
            findings[:], around = with_points(findings, surfaces, built, chunks, tolerance, remainder, jobs, reach)
        with clock("refine"):  # 3.4 once more, on the raw points: the exact surface, and how uncertain the pose is
            # Parts were fitted to the raw points before.
            findings[:] = [
                one if one.parts else polished(one, surfaces[one.model], parameters.refine, jobs) for one in findings
            ]
        with clock("measure"):  # what a drawing would dimension, as built
            places = [place for source in sources.all for place in source.told().stations]
            findings[:] = [
                dimensioned(one, plan, surfaces[one.model], around[one.id], places, reach, built.get(one.id))
                if (plan := plans.get(one.model))
                else one
                for one in findings
            ]
    findings.scans = [source.told() for source in sources.all]
    with clock("verify"):
        stations = findings.stations()
        if at_design:
            findings[:] = found.with_ends(findings)
        if len(stations) > 1:
            findings[:] = [found.with_stations(one, stations) for one in findings]
        if at_design:
            findings.elements = found.elements(findings, stations)
    findings.expected = parameters.priors.expected([model.name for model in library])
    findings.crs, findings.notes = sources.crs(), [*findings.as_expected(), *found.notes()]
    findings.shift = found.shift()
    findings.timings_s = clock.timings()
    return findings


def recognise(
    size: Size, grid: MomentGrid, standing: Sequence[Standing], parameters: Parameters, seed: int, jobs: int,
    clock: Clock, tell: Progress, *, at_design: bool, design: Design | None = None, learnt: Sequence[float] = (),
) -> Recognition:  # fmt: skip
    """The search for models of one size: what is believed of them, and why (paper 3.3 and 3.4).

    standing : instances of larger models; at_design : try them where the design has them first; design : all of it
    learnt : of each model, how many of the right pairs found it in other parts of the site, see Search
    """
    with clock("grid"):
        smallest = min(model.diameter for model in size.models)
        scene = build_scene(grid, smallest, parameters.grid, parameters.search.test_cells_across, jobs)
    with clock("library"):
        table = joint_table(size.models, each_once=parameters.search.each_once)
    found = Recognition(scene, size.models, table, parameters, seed, jobs, standing, design, learnt)
    for hypotheses in found.at_design() if at_design else ():
        with clock("refine"):
            poses = found.refine_in_place(hypotheses)
        with clock("verify"):
            found.believe_in_place(poses)
    while found.wants_more(clock.elapsed("search", "refine", "verify") / size.patience):
        tell("search", size.progress(found.progress()), 1.0)
        with clock("search"):
            hypotheses = found.round()  # 3.3, 3.4 Algorithm 2: draw, look up, pose, count support
        with clock("refine"):
            poses = found.refine(hypotheses)  # 3.4 post-ICP
        with clock("verify"):
            found.believe(hypotheses, poses)  # support, penalty, conflicts (Papazov & Burschka 2010)
    return found


def models_of(
    models: ModelInput | Sequence[ModelInput], parameters: Parameters, units: str | None, select: Sequence[str]
) -> list[Model]:
    """The models sought, prepared: from a library as they are there, from files and meshes with these parameters."""
    listed = [models] if isinstance(models, (ModelLibrary, Mesh, CloudModel, str, PathLike)) else list(models)
    prepare = ModelParameters(parameters.surface, parameters.pairs)
    sought: list[Model] = []
    with ModelLibrary.in_memory() as fresh:
        for given in listed:
            if isinstance(given, ModelLibrary):
                sought.extend(given.models())
            elif isinstance(given, (Mesh, CloudModel)):
                fresh.add(given, prepare)
            elif is_library(given):
                with ModelLibrary.open(Path(given)) as library:
                    sought.extend(library.models())
            else:
                from scanfind.models import read_models

                for model in read_models(Path(given), units=units, select=select):
                    fresh.add(model, prepare)
        sought.extend(fresh.models())
    names = [model.name for model in sought]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        msg = f"find: two models are called {twice[0]!r}: rename one, so that detections can be told apart"
        raise UsageError(msg)
    if not sought:
        msg = "find: no model to look for: the library is empty; add one with `scanfind library add`"
        raise UsageError(msg)
    return sought


def box_searched(library: Sequence[Model], parameters: Parameters) -> Floats | None:
    """The box (2, 3), scans' frame, metres, that holds every instance the priors allow for; None: anywhere.

    Raises UsageError for priors that do not fit the models.
    """
    priors = parameters.priors
    priors.check([model.name for model in library], parameters.search.max_instances)
    return box_around(library, priors)


def require_points_in(box: Floats | None, points: int, begins: ArrayLike | None) -> None:
    """Raise UsageError where of a scan that `begins` at (3,) no point lies where instances are looked for."""
    if box is not None and begins is not None and not points:
        low, high, there = (" ".join(f"{x:.1f}" for x in corner) for corner in (*box, np.asarray(begins)))
        msg = (
            f"no point lies where the region, or the design with near_design_m, allows for an instance, {low} to "
            f"{high}; the scan begins about {there}: give both in metres, in the scan's own frame"
        )
        raise UsageError(msg)


def is_library(path: str | PathLike[str]) -> bool:
    """Does a file begin as every SQLite file does?"""
    try:
        with Path(path).open("rb") as file:
            return file.read(16) == b"SQLite format 3\0"
    except OSError:
        return False


def isolation_tolerance(parameters: IsolationParameters, noise: float, cell: float) -> float:
    """Within how many metres of a placed surface a raw point belongs to it."""
    if parameters.tolerance_m is not None:
        return parameters.tolerance_m
    return min(max(parameters.noises * noise, 0.1 * cell), 0.5 * cell)


def surfaces_of(findings: Sequence[Detection], library: Sequence[Model], tolerance: float) -> dict[str, NearSurface]:
    """The surface of each model found, to be asked for distances up to `tolerance`, metres."""
    names = {found.model for found in findings}
    return {model.name: near_model(model, tolerance) for model in library if model.name in names}


def plans_of(findings: Sequence[Detection], library: Sequence[Model]) -> dict[str, Plan]:
    """What is to be measured of each model found, where it has anything a drawing would dimension."""
    names = {found.model for found in findings}
    plans = {model.name: plan_of(model.mesh) for model in library if model.name in names and model.mesh is not None}
    return {name: plan for name, plan in plans.items() if plan.wanted}


def with_points(
    findings: Sequence[Detection], surfaces: Mapping[str, NearSurface], built: Mapping[int, Floats],
    chunks: Iterable[PointChunk], tolerance: float, remainder: CloudWriter | None, jobs: int, reach: float,
) -> tuple[list[Detection], dict[int, IsolatedPoints]]:  # fmt: skip
    """Each detection with its raw points and how far they are from its model; by id, all points within `reach`.

    built : by id, the faces (F, 3, 3), scan frame, of those fitted in parts: what their points are cut and measured by
    """
    placed = [
        as_built(found.id, built[found.id], reach)
        if found.id in built
        else Placed(found.id, surfaces[found.model]._replace(reach=reach), found.scene_from_model)
        for found in findings
    ]
    rest = None if remainder is None else lambda chunk: write_rest(remainder, chunk)
    points = isolate_raw(chunks, placed, IsolateParameters(reach), remainder=rest, jobs=jobs, own=tolerance)
    told = [
        found.with_points(cut := nearer(points[found.id], tolerance), deviation_of(cut.deviation) if len(cut) else None)
        for found in findings
    ]
    return told, points


def near_parts(built: Mapping[int, Floats], chunks: Iterable[PointChunk], jobs: int) -> dict[int, Floats]:
    """The raw points (N, 3) around each detection as built, from which its parts are measured."""
    placed = [as_built(number, faces, REACH_M) for number, faces in built.items()]
    points = isolate_raw(chunks, placed, IsolateParameters(REACH_M), jobs=jobs)
    return {number: cut.xyz for number, cut in points.items()}


def as_built(number: int, faces: Floats, reach: float) -> Placed:
    """The surface of a detection as built; faces (F, 3, 3), scan frame."""
    # About a corner: far from zero single precision would round the tree of boxes.
    corner = faces[0, 0]
    return Placed(number, near_triangles(faces - corner, reach), Pose(np.eye(3), corner.copy()))


def write_rest(writer: CloudWriter, chunk: PointChunk) -> None:
    """Points of no detection, with where they came from."""
    count = len(chunk)
    scan_id = np.full(count, chunk.scan, np.int32)
    writer.write(chunk.xyz, {**chunk.attributes, "scan_id": scan_id, "source_index": chunk.source_index})
