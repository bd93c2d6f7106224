"""The dimensions of a detection as built: its features fitted to its raw points, and held against the design."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import cos, nan, radians, sqrt
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.detection import Dimension
from scanfind.dimensions.drawing import Wanted, wanted_of
from scanfind.dimensions.features import BAR, PIPE, SIDE, Feature, Surface, features_of
from scanfind.dimensions.fits import Fitted, Seen, State, designed, fit
from scanfind.dimensions.members import features_and_wanted, members_of
from scanfind.dimensions.skin import across
from scanfind.fit.patches import measured as distances_of
from scanfind.library.near_surface import near_triangles
from scanfind.pose import Pose, rotation_from_vector

if TYPE_CHECKING:
    from scanfind.detection import Detection, IsolatedPoints
    from scanfind.kernels.distance import NearSurface
    from scanfind.mesh import Mesh

Floats = NDArray[np.float64]

REACH_M = 0.02  # a flange 6 mm off and 1° askew still has all its points within it
REACH_SHARE = 0.01  # of a model's diameter: what lies farther from a small one is something else
MARGIN_M = 0.005  # from the edges of a feature: a beam is as wide, and points of it are of neither side
MARGIN_SHARE = 0.25  # of its width, at most
# Beams that graze a surface hit what is behind it with part of their width: the silhouette of a pipe looks thicker.
GRAZING = cos(radians(72.0))
LEAST_POINTS = 40
MOST_LOOKED_AT = 100_000  # of all points, 2 µs each
MOST_POINTS = 2_000  # of a surface: more tell nothing new against what patches disagree by
LEAST_ARC = 6  # of 36 sectors: the radius of less than 60° of a pipe is anybody's guess
SECTORS = 36
STEP = 1e-6  # metres or radians, of a derivative


@dataclass(frozen=True, eq=False)
class Plan:
    """What is measured of a model: its features, the dimensions of them, and the faces (F, 3, 3) it was made of.

    reach : how far from its surface points are wanted, metres, to see what was built off
    """

    features: tuple[Feature, ...]
    wanted: tuple[Wanted, ...]
    corners: Floats
    reach: float


def plan_of(mesh: Mesh) -> Plan:
    """Find a model's features, and what is to be measured of them; nothing of one that is free-form."""
    features = features_of(mesh)
    wanted = wanted_of(features)
    if all(feature.kind == SIDE for feature in features):
        bars, more = features_and_wanted(members_of(mesh), len(features))
        features, wanted = (*features, *bars), [*wanted, *more]
    diameter = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    return Plan(features, tuple(wanted), mesh.triangles(), min(REACH_M, REACH_SHARE * diameter))


def dimensioned(
    found: Detection, plan: Plan, near: NearSurface, cut: IsolatedPoints,
    stations: Sequence[tuple[float, float, float] | None], reach: float, built: Floats | None = None, jobs: int = 1,
) -> Detection:  # fmt: skip
    """A detection with its key dimensions.

    near : the surface of its model; cut : the points within `reach` of it, metres
    stations : where scanners stood, by the points' scan_id; None where nobody knows
    built : (F, 3, 3) its faces where its parts were built, scan frame, where they were fitted: then points are by these
    """
    # Without its missing parts nobody knows which face is which.
    if built is not None and len(built) != len(plan.corners):
        return found
    pose, some = found.scene_from_model, slice(None, None, -(-len(cut) // MOST_LOOKED_AT) or 1)
    xyz = np.ascontiguousarray(cut.xyz[some])
    if built is None:
        distance, face = distances_of(near._replace(reach=reach), pose, xyz, jobs)
    else:
        # About a corner: far from zero single precision would round the tree of boxes.
        corner = built[0, 0]
        distance, face = distances_of(near_triangles(built - corner, reach), Pose(np.eye(3), corner.copy()), xyz, jobs)
    met = np.flatnonzero(face >= 0)
    points, face = pose.inverse().move(xyz[met]), face[met]
    on = Touching(
        points if built is None else as_drawn(xyz[met], built[face], plan.corners[face]),
        face,
        np.abs(distance[met]).astype(np.float64),
        pose.inverse().turn(beams(xyz[met], cut.scan_id[some][met], stations)),
    )
    fits = {}
    for k, feature in enumerate(plan.features):
        seen = [Seen(surface, points[measuring(surface, len(plan.corners), on)]) for surface in feature.surfaces]
        fits[k] = fitted(feature, seen, None if built is not None else reach)
    return replace(found, dimensions=tuple(dimension(one, plan.features, fits, found) for one in plan.wanted))


class Touching(NamedTuple):
    """N points near faces of the model, all in its own frame, metres.

    points : (N, 3); face : (N,) the nearest; distance : (N,) from it
    beams : (N, 3) unit directions to the scanner, NaN where nobody knows
    """

    points: Floats
    face: NDArray[np.int32]
    distance: Floats
    beams: Floats


def beams(xyz: Floats, scan_id: NDArray[np.int32], stations: Sequence[tuple[float, float, float] | None]) -> Floats:
    """The unit direction from each of N points (N, 3) to its scanner, (N, 3), NaN where nobody knows that."""
    nowhere = (np.nan,) * 3
    known = np.array([station or nowhere for station in stations] or [nowhere])
    way = known[scan_id] - xyz if len(known) > scan_id.max(initial=0) else np.full_like(xyz, np.nan)
    unit: Floats = way / np.linalg.norm(way, axis=1)[:, None]
    return unit


def measuring(surface: Surface, faces: int, on: Touching) -> NDArray[np.int64]:
    """Which points are measurements of a surface: on it, away from its edges, hit by no grazing beam. Their numbers.

    faces : of the mesh in all
    """
    its = np.zeros(faces, np.bool_)
    its[surface.faces] = True
    rows = np.flatnonzero(its[on.face])
    # Twice: some of the first lie at edges.
    rows = rows[:: -(-len(rows) // (2 * MOST_POINTS)) or 1]
    points = on.points[rows]
    normals = np.broadcast_to(surface.direction, points.shape)
    if surface.radius is not None:
        out = points - surface.point
        out = out - np.outer(out @ surface.direction, surface.direction)
        normals = out / np.maximum(np.linalg.norm(out, axis=1), 1e-12)[:, None]
    grazing = (normals * on.beams[rows]).sum(axis=1) < GRAZING
    kept: NDArray[np.int64] = rows[inside(surface, points, on.distance[rows]) & ~grazing]
    return kept


def as_drawn(points: Floats, built: Floats, design: Floats) -> Floats:
    """Points (N, 3) moved with their nearest face from where it was built to where it is drawn, both (N, 3, 3)."""

    def frames(corners: Floats) -> Floats:
        along = corners[:, 1] - corners[:, 0]
        normal = np.cross(along, corners[:, 2] - corners[:, 0])
        axes = [along, np.cross(normal, along), normal]
        return np.stack([axis / np.linalg.norm(axis, axis=1)[:, None] for axis in axes], axis=1)

    local = np.einsum("nij,nj->ni", frames(built), points - built[:, 0])
    moved: Floats = design[:, 0] + np.einsum("nij,ni->nj", frames(design), local)
    return moved


def inside(surface: Surface, points: Floats, distance: Floats) -> NDArray[np.bool_]:
    """Which of N points (N, 3) are before a surface and well within its edges; `distance` (N,) from the mesh."""
    out = points - surface.point
    along = out @ surface.direction
    if surface.radius is not None:
        margin = min(MARGIN_M, MARGIN_SHARE * (surface.high - surface.low))
        within: NDArray[np.bool_] = (along > surface.low + margin) & (along < surface.high - margin)
        return within
    # Past an edge the nearest point of the mesh is on it, and farther than the plane.
    within = np.abs(np.abs(along) - distance) < 1e-5
    if surface.border is None or not len(surface.border):
        return within
    rows = np.flatnonzero(within)
    flat = points[rows] - np.outer(along[rows], surface.direction)
    gap = np.full(len(rows), np.inf)
    for start, end in surface.border:
        edge = end - start
        share = np.clip((flat - start) @ edge / (edge @ edge), 0.0, 1.0)
        np.minimum(gap, np.linalg.norm(flat - start - share[:, None] * edge, axis=1), out=gap)
    result = np.zeros(len(points), np.bool_)
    result[rows] = gap > min(MARGIN_M, MARGIN_SHARE * surface.width)
    return result


def fitted(feature: Feature, seen: Sequence[Seen], reach: float | None) -> Fitted | str:
    """A feature fitted to what is seen of it, or why it cannot be.

    reach : metres to which points were cut out about the design; None: they were cut out where it was built
    """
    if feature.kind == BAR:
        sides = [each for each in seen if len(each.points) >= LEAST_POINTS]
        square = any(abs(float(a.surface.direction @ b.surface.direction)) < 0.5 for a, b in combinations(sides, 2))
        done = fit(feature, sides) if square else None
        return done or f"of {feature.name} no two sides are seen that stand square to one another"
    first, *rest = seen
    if len(first.points) < LEAST_POINTS:
        return f"of {feature.name} only {len(first.points)} points are seen away from its edges"
    if feature.kind == PIPE and arc_of(first) < LEAST_ARC:
        return f"{feature.name} is seen from one side only, over {360 // SECTORS * arc_of(first)}°"
    kept = [first, *(each for each in rest if len(each.points) >= LEAST_POINTS and arc_of(each) >= LEAST_ARC)]
    done = fit(feature, kept)
    if done is None:
        return f"what is seen of {feature.name} does not fix it"
    if reach is not None and 3.0 * done.noise + farthest(done, kept) > reach:
        return f"{feature.name} is farther off than points were cut out to, {1e3 * reach:.0f} mm: try --parts"
    return done


def arc_of(seen: Seen) -> int:
    """In how many of SECTORS about the axis of a cylinder points are seen."""
    off = seen.points - seen.surface.point
    u, v = across(seen.surface.direction)
    turn = np.arctan2(off @ v, off @ u) / (2.0 * np.pi) + 0.5
    counts = np.bincount(np.floor(turn * SECTORS).astype(np.int64) % SECTORS, minlength=SECTORS)
    return int((counts >= max(2, 0.002 * len(off))).sum())


def farthest(done: Fitted, seen: Sequence[Seen]) -> float:
    """How far the surface, where it is seen, is from the design, metres."""
    from scanfind.dimensions.fits import residuals

    drawn, _ = residuals(done.feature, seen, Pose.identity(), 0.0)
    built, _ = residuals(done.feature, seen, done.moved, done.wider)
    return float(np.percentile(np.abs(drawn - built), 95.0))


def dimension(
    wanted: Wanted, features: Sequence[Feature], fits: Mapping[int, Fitted | str], found: Detection
) -> Dimension:
    """A dimension as designed and as built."""
    design = float(wanted.value(*(designed(features[k]) for k in wanted.of)))
    told = [fits[k] for k in wanted.of]
    gone = next((why for why in told if isinstance(why, str)), "")
    fitted = [one for one in told if isinstance(one, Fitted)]
    for k in wanted.rim:
        one = fits[k]
        if isinstance(one, Fitted) and one.directions.shape[1] < 5:
            gone = f"too little of the rim of {features[k].name} is seen"
    if gone:
        return Dimension(wanted.name, wanted.kind, design, nan, nan, gone)
    states = [one.state() for one in fitted]
    variance = 0.0
    for k, one in enumerate(fitted):
        slope = np.array(
            [
                slope_of(
                    wanted,
                    [*states[:k], one.state(step), *states[k + 1 :]],
                    [*states[:k], one.state(-step), *states[k + 1 :]],
                )
                for step in STEP * np.eye(one.directions.shape[1])
            ]
        )
        variance += float(slope @ one.covariance @ slope)
    if wanted.by_pose and found.covariance is not None and found.pivot is not None:
        slope = np.array(
            [
                slope_of(
                    wanted,
                    [moved(state, found, step) for state in states],
                    [moved(state, found, -step) for state in states],
                )
                for step in STEP * np.eye(6)
            ]
        )
        variance += float(slope @ found.covariance @ slope)
    return Dimension(wanted.name, wanted.kind, design, float(wanted.value(*states)), sqrt(max(variance, 0.0)))


def slope_of(wanted: Wanted, after: Sequence[State], before: Sequence[State]) -> float:
    """By how much a dimension changes with something that was changed by STEP both ways."""
    return (wanted.value(*after) - wanted.value(*before)) / (2.0 * STEP)


def moved(state: State, found: Detection, step: Floats) -> State:
    """Where a feature would be in the model, were the pose another by a turn and a shift (6,) as its covariance has."""
    pose, pivot = found.scene_from_model, np.array(found.pivot)
    turn = rotation_from_vector(step[:3])
    other = Pose(turn @ pose.rotation, turn @ (pose.translation - pivot) + pivot + step[3:])
    change = other.inverse() @ pose
    return State(change.move(state.centre[None])[0], change.turn(state.axis[None])[0], state.radius)
