"""The second pass over the raw points: what belongs to each detection, its parts, its dimensions, and what is left."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.assembly import REACH_M
from scanfind.dimensions import Plan, dimensioned, plan_of
from scanfind.isolation.isolate import IsolateParameters, Placed, left_over
from scanfind.isolation.isolate import isolate as isolate_raw
from scanfind.isolation.own import within
from scanfind.library.near_surface import near_model, near_triangles
from scanfind.pose import Pose

if TYPE_CHECKING:
    from scanfind.cloud import PointChunk
    from scanfind.detection import Detection, IsolatedPoints
    from scanfind.kernels.distance import NearSurface
    from scanfind.library.model import Model
    from scanfind.scans import CloudWriter

Floats = NDArray[np.float64]


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
