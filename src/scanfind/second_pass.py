"""The second pass over the raw points: what belongs to each detection, its parts, its dimensions, and what is left."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.assembly import REACH_M
from scanfind.dimensions import Plan, dimensioned, plan_of
from scanfind.isolation.deviation import deviation_of
from scanfind.isolation.isolate import IsolateParameters, Placed, left_over, nearer
from scanfind.isolation.isolate import isolate as isolate_raw
from scanfind.library.near_surface import near_model, near_triangles
from scanfind.pose import Pose

if TYPE_CHECKING:
    from scanfind.cloud import PointChunk
    from scanfind.detection import Detection, IsolatedPoints
    from scanfind.kernels.distance import NearSurface
    from scanfind.library.model import Model
    from scanfind.parameters import IsolationParameters
    from scanfind.scans import CloudWriter

Floats = NDArray[np.float64]


# Twice what the grid takes for noise: it is a fifth too small where points are many, and cut off there their own spread
# looks smaller still. Where they are few, cells are large, and what bends within them looks like noise: 15 times it.
GATE = 2.0
LEAST_CELLS = 0.1  # of the finest cell: points without noise are rounded, and their pose is off by some of that


def isolation_gate(parameters: IsolationParameters, noise: float, cell: float) -> float:
    """Within how many metres of a placed surface a raw point may belong to it, by the noise that the grid tells."""
    if parameters.tolerance_m is not None:
        return parameters.tolerance_m
    return min(max(GATE * parameters.noises * noise, LEAST_CELLS * cell), 0.5 * cell)


def with_own_points(found: Detection, parameters: IsolationParameters, gate: float, finest_cell: float) -> Detection:
    """Of the points within the gate of a detection those that are its own: what spreads about it as most of them do.

    found : fitted to these points; gate, finest_cell : metres
    """
    points = found.isolated
    if points is None or not len(points) or parameters.tolerance_m is not None:
        return replace(found, tolerance_m=None if points is None else gate)
    # The median: up to half of the points may be those of a floor or a neighbour.
    spread = 1.4826 * float(np.median(np.abs(points.deviation)))
    tolerance = min(max(parameters.noises * spread, LEAST_CELLS * finest_cell), gate)
    return within(found, points, tolerance)


def within(found: Detection, points: IsolatedPoints, tolerance: float) -> Detection:
    """A detection with those of some points that are no farther from it than a tolerance, metres."""
    own = nearer(points, tolerance)
    return replace(
        found, isolated=own, deviation=deviation_of(own.deviation) if len(own) else None, tolerance_m=tolerance
    )


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
    chunks: Iterable[PointChunk], tolerance: float, jobs: int, reach: float,
) -> tuple[list[Detection], dict[int, IsolatedPoints]]:  # fmt: skip
    """Each detection with the raw points within `tolerance` and how far they are; by id, all points within `reach`.

    built : by id, the faces (F, 3, 3), scan frame, of those fitted in parts: what their points are cut and measured by
    """
    placed = [
        as_built(found.id, built[found.id], reach)
        if found.id in built
        else Placed(found.id, surfaces[found.model]._replace(reach=reach), found.scene_from_model)
        for found in findings
    ]
    points = isolate_raw(chunks, placed, IsolateParameters(reach), jobs=jobs)
    return [within(found, points[found.id], tolerance) for found in findings], points


def with_dimensions(
    findings: Sequence[Detection], plans: Mapping[str, Plan], surfaces: Mapping[str, NearSurface],
    around: Mapping[int, IsolatedPoints], stations: Sequence[tuple[float, float, float] | None], reach: float,
    built: Mapping[int, Floats],
) -> list[Detection]:  # fmt: skip
    """Each detection with what a drawing would dimension, where there is a plan for its model.

    around : by id, all points within `reach` of it, metres; stations : where scanners stood, by the points' scan_id
    built : see `with_points`
    """
    return [
        dimensioned(one, plan, surfaces[one.model], around[one.id], stations, reach, built.get(one.id))
        if (plan := plans.get(one.model))
        else one
        for one in findings
    ]


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


def write_left_over(writer: CloudWriter, chunks: Iterable[PointChunk], findings: Iterable[Detection]) -> None:
    """The points of no detection, with where they came from: a pass of its own, when all others are known."""
    for rest in left_over(chunks, [one.isolated for one in findings if one.isolated is not None]):
        scan_id = np.full(len(rest), rest.scan, np.int32)
        writer.write(rest.xyz, {**rest.attributes, "scan_id": scan_id, "source_index": rest.source_index})
