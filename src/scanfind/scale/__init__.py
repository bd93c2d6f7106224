"""The scale of scans whose unit is not quite a metre, told by the models sought (photogrammetry, SLAM).

All instances of a scene share one scale. So it is found once, before the search: models are looked for in several
sizes, as if each were a model of its own; what is found of them is fitted with its size, on surfels and then on raw
points. From there on the scans are in metres, and everything is rigid.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import log, nan
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.clock import watched
from scanfind.detection import ScanScale
from scanfind.fit.refine import shrinking
from scanfind.fit.similarity import Similarity, agreed, similarity
from scanfind.grid.moments import MomentGrid
from scanfind.grid.scene import build_scene
from scanfind.isolation.isolate import IsolateParameters, Placed, isolate
from scanfind.isolation.own import IsolationParameters, isolation_gate
from scanfind.library.near_surface import near_model
from scanfind.pose import Pose
from scanfind.priors.allowed import middle_of
from scanfind.recognition.fitting import Fitting
from scanfind.recognition.ground import Ground
from scanfind.recognition.recognise import Recognition
from scanfind.recognition.sizes import Sizes
from scanfind.recognition.weighing import Weighing
from scanfind.scale.steps import sized, sizes_tried
from scanfind.search.hypotheses import Hypotheses, model_arrays

if TYPE_CHECKING:
    from scanfind.clock import Clock
    from scanfind.cloud import PointChunk
    from scanfind.fit.refine import Refined
    from scanfind.library.model import Model
    from scanfind.parameters import Parameters
    from scanfind.progress import Progress
    from scanfind.scans.sources import Sources

Floats = NDArray[np.float64]

AT_ONCE = 8  # models, each in every size: of a large library one instance tells enough
FITTED = 12  # poses of a round, those that match best
# Of the fit on surfels: half a step of size moves the ends of a spool by 1.6 cells.
GATES_CELLS, GATES_STEPS = (2.0, 0.75), 6
RAW_STEPS, RAW_REACH = 3, 2.0  # of the fit on raw points: steps, and how far off points are taken in, in gates
BEYOND = 0.01  # by so much outside of what was asked for a scale is still an answer
ALIKE = 0.003  # what differs by less from the best one's scale has the same
APART = 0.1  # diameters: fits whose middles are nearer to one another are of one instance


class Seen(NamedTuple):
    """An instance that tells the scale.

    fit : on surfels, relative to the grid's offset; area : see Candidate
    gate : how far from its surface raw points of it may lie, metres
    """

    model: Model
    fit: Similarity
    area: float
    gate: float


def scan_scale(
    sources: Sources, library: Sequence[Model], parameters: Parameters, box: Floats | None, seed: int, jobs: int,
    clock: Clock, tell: Progress,
) -> ScanScale:  # fmt: skip
    """The scale of scans that are off by up to `priors.scale_free`; 1, without a sigma, where nothing tells it.

    box : (2, 3) of what may hold an instance, the scans' own frame and unit; None: anything
    """
    tried, sizes = sizes_tried(parameters.priors.scale_free), Sizes(library, parameters)
    with clock("grid"):
        grid = MomentGrid(float(tried[0]) * sizes.finest_cell(), jobs=jobs, box=box)
        for chunk in watched(sources.chunks(), clock, tell, "read", sources.expected()):
            grid.add(chunk)
        grid.release()
    for size in sizes.groups() if grid.points else ():
        for first in range(0, len(size.models), AT_ONCE):
            models = size.models[first : first + AT_ONCE]
            if seen := seen_in(grid, models, tried, parameters, seed, jobs, clock, tell):
                sources.in_metres(seen[0].fit.scale)
                chunks = watched(sources.chunks(), clock, tell, "isolate", sources.expected())
                with clock("isolate"):
                    return told_by(seen, chunks, grid.offset, parameters.refine.unobservable_below, jobs)
    return ScanScale(1.0, nan)


def in_metres(sources: Sources, parameters: Parameters, scale: float) -> Parameters:
    """From now on scans come in metres, of which they had `scale` a unit; returns what is known, in metres as well."""
    sources.in_metres(scale)
    return replace(parameters, priors=parameters.priors.in_metres(scale))


def seen_in(
    grid: MomentGrid, models: Sequence[Model], tried: Floats, parameters: Parameters, seed: int, jobs: int,
    clock: Clock, tell: Progress,
) -> list[Seen]:  # fmt: skip
    """Instances of one scale, what explains most first; empty where none is believed at any.

    tried : sizes of the models, units of the scan a metre (K,)
    """
    each = [(model, float(units)) for model in models for units in tried]
    sizes = [sized(model, units) for model, units in each]
    with clock("grid"):
        smallest = min(model.diameter for model in sizes)
        scene = build_scene(grid, smallest, parameters.grid, parameters.search.test_cells_across, jobs)
    search, began = Recognition(scene, sizes, parameters, seed, jobs), clock.elapsed("search", "refine")
    while search.wants_more(clock.elapsed("search", "refine") - began):
        tell("search", search.progress(), 1.0)
        with clock("search"):
            hypotheses = search.round()
        with clock("refine"):
            if seen := of_one_scale(weighed(search, fits_of(search, search.refine(hypotheses), each, tried))):
                return seen
    return []


def fits_of(
    search: Recognition, refined: Refined, each: Sequence[tuple[Model, float]], tried: Floats
) -> list[tuple[Model, Similarity]]:
    """The best of a round's poses fitted to surfels with their size, those of a scale that was asked for.

    each : what the sizes sought are of: a model, and the units it has a metre
    """
    ground, fits = search.ground, []
    parameters, fine = ground.parameters, ground.scene.fine
    best = refined.take(np.arange(min(FITTED, len(refined.matched))))
    ground.fit_near(best.hypotheses, round(GATES_CELLS[0]) + 1)
    near = {model.name: near_model(model, GATES_CELLS[0] * fine.cell / tried[0]) for model, _ in each}
    nobody = np.zeros(len(fine), np.int32)
    for number, rotation, translation in zip(*best.hypotheses[:3], strict=True):
        model, units = each[number]
        middle = rotation @ ground.arrays.centres[number] + translation
        around = np.linalg.norm(fine.means - middle, axis=1) < ground.models[number].diameter
        start = Similarity(1.0 / units, nan, Pose(rotation, translation / units))
        gates = shrinking(GATES_CELLS, GATES_STEPS, fine.cell / units).tolist()
        fit = similarity(
            near[model.name], start, fine.means[around], nobody[around], gates,
            parameters.refine.unobservable_below, ground.jobs,
        )  # fmt: skip
        if fit and fit.scale * tried[-1] > 1.0 - BEYOND and fit.scale * tried[0] < 1.0 + BEYOND:
            fits.append((model, fit))
    return fits


def weighed(search: Recognition, fits: Sequence[tuple[Model, Similarity]]) -> list[Seen]:
    """Those of the fits that are believed as any pose is, each of a model of the size it was fitted with."""
    if not fits:
        return []
    scene, parameters = search.ground.scene, search.ground.parameters
    models = [sized(model, 1.0 / fit.scale) for model, fit in fits]
    ground = Ground(scene, models, model_arrays(models), parameters, search.ground.jobs)
    weighing = Weighing(ground, search.search.pool.telling(), None)
    poses = Hypotheses(
        np.arange(len(fits)), np.array([fit.pose.rotation for _, fit in fits]),
        np.array([fit.pose.translation / fit.scale for _, fit in fits]), np.ones(len(fits)),
    )  # fmt: skip
    found = weighing.candidates(Fitting(ground, weighing).fine(poses))
    gate = isolation_gate(IsolationParameters(), scene.noise, scene.fine.cell) / RAW_REACH
    return [
        Seen(*fits[one.model], one.area, gate * fits[one.model][1].scale)
        for one in found
        if not ground.why_not_believed(one)
    ]


def of_one_scale(found: Sequence[Seen]) -> list[Seen]:
    """The one that explains most, and others elsewhere that agree with it, each instance once."""
    kept: list[Seen] = []
    for one in sorted(found, key=lambda seen: -seen.area):
        place = place_of(one)
        if all(np.linalg.norm(place - place_of(other)) > APART * other.model.diameter for other in kept) and (
            not kept or abs(log(one.fit.scale / kept[0].fit.scale)) < ALIKE
        ):
            kept.append(one)
    return kept


def place_of(seen: Seen) -> Floats:
    """Where the middle of an instance is, (3,), relative to the grid's offset, metres."""
    return np.asarray(seen.fit.pose.move(middle_of(seen.model)[None])[0])


def told_by(
    seen: Sequence[Seen], chunks: Iterable[PointChunk], offset: Floats | None, below: float, jobs: int
) -> ScanScale:
    """The scale by the raw points of instances, or by surfels where these do not tell it.

    chunks : of the scans times the first one's scale; offset : (3,) of the grid, the scans' own unit
    below : see `similarity`
    """
    scale, gate = seen[0].fit.scale, seen[0].gate
    placed = []
    for number, one in enumerate(seen, start=1):
        there = scale * (place_of(one) / one.fit.scale + np.asarray(offset))
        rotation = one.fit.pose.rotation
        pose = Pose(rotation, there - rotation @ middle_of(one.model))
        placed.append(Placed(number, near_model(one.model, RAW_REACH * gate), pose))
    points = isolate(chunks, placed, IsolateParameters(RAW_REACH * gate), jobs=jobs)
    fitted = [
        similarity(
            one.near, Similarity(1.0, nan, one.scene_from_model), points[one.id].xyz, points[one.id].scan_id,
            [gate] * RAW_STEPS, below, jobs,
        )
        for one in placed
    ]  # fmt: skip
    fits = [fit for fit in fitted if fit]
    factor, sigma = agreed(fits) if fits else (1.0, seen[0].fit.sigma / scale)
    return ScanScale(scale * factor, scale * sigma)
