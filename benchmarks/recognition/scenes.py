"""Scenes for the lines: who is a target in a scene, boards that hide a part, a part that hangs free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.common import Floats, centre_of
from benchmarks.recognition.parts import Part
from scanfind.evidence.rays import RayCaster
from scanfind.pose import Pose, random_rotation
from scanfind.simulate.parts import blocks
from scanfind.simulate.placement import surface_points
from scanfind.simulate.scanner import shares
from scanfind.simulate.scene import Scene, SceneObject
from scanfind.simulate.scenes import PILOT

# Points elsewhere for each on a target: wide, for points are chosen by what the target needs.
CLUTTER = (2.0, 600.0)
# On what is seen of a target: one each 20 mm, as the paper's scans had on its spool.
POINTS_PER_M2, MOST_POINTS = 2500.0, 1_500_000
BOARD_M, BOARD_EDGE_M = 0.01, 4.0
# Where a board stands between a scanner and what it hides, in shares of the way: clear of both.
BOARD_AT = 0.6
BISECTIONS = 14
# From a scanner to the middle of a part that hangs free.
FREE_STATIONS_M = 5.0


def meant(scene: Scene, names: Sequence[str], left_out: Sequence[str] = ()) -> Scene:
    """The same scene with the targets of other names as decoys, and those of `left_out` taken away."""
    kept = [thing for thing in scene.objects if not (thing.target and thing.name in left_out)]
    return Scene(tuple(replace(thing, target=thing.target and thing.name in names) for thing in kept), scene.stations)


def points_for(scene: Scene) -> int:
    """How many points a scan needs for its targets to have POINTS_PER_M2 on average, at most MOST_POINTS."""
    ids = scene.target_ids()
    share = float(shares(scene.caster(), scene.stations, PILOT)[ids].sum())
    visible = zip(ids, visible_shares(scene, ids), strict=True)
    wanted = sum(POINTS_PER_M2 * scene.objects[k].mesh.area() * seen for k, seen in visible)
    return round(min(wanted / max(share, 1e-9), MOST_POINTS))


def in_sight(scene: Scene, object_id: int, caster: RayCaster) -> NDArray[np.bool_]:
    """Which points spread over an object (N) each station (S) sees, (S, N)."""
    points = spread_over(scene, object_id)
    return np.array([caster.sees(station, points) for station in scene.stations])


def spread_over(scene: Scene, object_id: int) -> Floats:
    """Points (N, 3) spread evenly over an object where it stands."""
    thing = scene.objects[object_id]
    return thing.pose.move(surface_points(thing.mesh, np.random.default_rng(object_id)))


def visible_shares(scene: Scene, object_ids: Sequence[int]) -> list[float]:
    """Of each of some objects the share of its surface that the stations together see."""
    caster = scene.caster()
    return [float(in_sight(scene, k, caster).any(axis=0).mean()) for k in object_ids]


def behind_boards(scene: Scene, occlusion: float, seed: int) -> Scene | None:
    """The scene with a board before each station that hides the target up to `occlusion`; None where it is more so.

    Occlusion as Johnson & Hebert (1999) and Drost (2010) have it: one less the visible over the whole area of the
    model. Each board's edge lies at an angle of chance; all are pushed by one measure before the target, by bisection.
    """
    (target,) = scene.target_ids()
    thing, points = scene.objects[target], spread_over(scene, target)
    seen = in_sight(scene, target, scene.caster())
    if 1.0 - seen.any(axis=0).mean() > occlusion:
        return None
    angles = np.random.default_rng([seed, 3]).uniform(0.0, 2 * np.pi, len(scene.stations))
    corners = thing.pose.move(thing.mesh.vertices)

    def boards(pushed: float) -> list[SceneObject]:
        return [board(station, corners, angle, pushed) for station, angle in zip(scene.stations, angles, strict=True)]

    none, all_ = 0.0, 1.0
    for _ in range(BISECTIONS):
        middle = 0.5 * (none + all_)
        clear = [~crossed(station, points, boards(middle)) for station in scene.stations]
        hidden = 1.0 - (seen & clear).any(axis=0).mean()
        none, all_ = (middle, all_) if hidden < occlusion else (none, middle)
    return Scene((*scene.objects, *boards(none)), scene.stations)


def crossed(station: Floats, points: Floats, boards: Sequence[SceneObject]) -> NDArray[np.bool_]:
    """Which lines from a station to points (N, 3) meet a board, (N,)."""
    met = np.zeros(len(points), np.bool_)
    for one in boards:
        eye, ends = one.pose.inverse().move(station[None])[0], one.pose.inverse().move(points)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = -eye[2] / (ends[:, 2] - eye[2])
            at = eye + share[:, None] * (ends - eye)
            across = (at[:, 0] <= 0.0) & (at[:, 0] >= -BOARD_EDGE_M)
            met |= (share > 0.0) & (share < 1.0) & across & (np.abs(at[:, 1]) <= BOARD_EDGE_M)
    return met


def board(station: Floats, corners: Floats, angle: float, pushed: float) -> SceneObject:
    """A board between a station and a target with these corners (V, 3), its edge at `angle` about the line of sight.

    pushed : 0, it just leaves the target's outline in sight; 1, it just covers all of it
    """
    middle = centre_of(corners)
    away = middle - station
    distance = float(np.linalg.norm(away))
    ahead = away / distance
    side = np.cross([0.0, 0.0, 1.0], ahead)
    side /= np.linalg.norm(side)
    up = np.cross(ahead, side)
    u, v = np.cos(angle) * side + np.sin(angle) * up, -np.sin(angle) * side + np.cos(angle) * up
    at = max(min(BOARD_AT * distance, nearest_ahead(station, corners, ahead) - 0.3), 0.5)
    outline = ((corners - station) @ u) / ((corners - station) @ ahead) * at
    edge = outline.min() + pushed * float(np.ptp(outline)) * 1.02
    frame = np.stack([u, v, ahead], axis=1)
    mesh = blocks("board", [((-BOARD_EDGE_M, -BOARD_EDGE_M, 0.0), (0.0, BOARD_EDGE_M, BOARD_M))])
    return SceneObject("board", mesh, Pose(frame, station + at * ahead + edge * u), 0.6)


def nearest_ahead(station: Floats, corners: Floats, ahead: Floats) -> float:
    """How far along a line of sight the nearest of some corners (V, 3) is."""
    return float(((corners - station) @ ahead).min())


def free(part: Part, seed: int) -> Scene:
    """A part that hangs in the air with nothing else, turned anyhow, seen from the eight corners of a cube around it:
    nothing of its outside is hidden but by itself.
    """
    rng = np.random.default_rng([seed, 4])
    rotation = random_rotation(rng)
    pose = Pose(rotation, -rotation @ centre_of(part.mesh.vertices))
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    stations = FREE_STATIONS_M / np.sqrt(3.0) * corners
    return Scene((SceneObject(part.name, part.mesh, pose, 0.5, target=True),), stations)
