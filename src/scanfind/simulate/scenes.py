"""Scenes: a fabrication shop with the objects one looks for, decoys, furniture, and stations to scan it from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanfind.errors import UsageError
from scanfind.mesh import Mesh
from scanfind.pose import Pose
from scanfind.simulate import furniture
from scanfind.simulate.objects import other_spool
from scanfind.simulate.parts import blocks
from scanfind.simulate.placement import Occupancy, surface_points
from scanfind.simulate.rays import RayCaster

Floats = NDArray[np.float64]

SHOP_M = (12.0, 10.0, 4.2)
SCANNER_HEIGHT_M = 1.6
BACKGROUND = 0
# The least share of a target's surface that the stations together must see, or the seed's scene is laid out anew.
LEAST_VISIBLE = 0.3
TRIES = 400
LAYOUTS = 50


@dataclass(frozen=True, eq=False)
class SceneObject:
    """A mesh where it stands: name, scene_from_mesh, diffuse reflectance 0 … 1, and whether it is looked for."""

    name: str
    mesh: Mesh
    pose: Pose
    reflectance: float = 0.5
    target: bool = False


@dataclass(frozen=True, eq=False)
class Scene:
    """What there is to scan, metres, z up.

    objects : by object id; 0 is the background (the room)
    stations : (S, 3) where scanners stand
    """

    objects: tuple[SceneObject, ...]
    stations: Floats

    def truth(self) -> dict[str, list[Pose]]:
        """Target name → scene_from_model of each copy."""
        found: dict[str, list[Pose]] = {}
        for thing in self.objects:
            if thing.target:
                found.setdefault(thing.name, []).append(thing.pose)
        return found

    def target_ids(self) -> list[int]:
        """The object ids of what is looked for."""
        return [k for k, thing in enumerate(self.objects) if thing.target]

    def visible_share(self, object_id: int, stations: Floats | None = None) -> float:
        """Which share of an object's surface the stations (S, 3) see, occlusion by everything counted."""
        thing = self.objects[object_id]
        caster = RayCaster([(o.mesh, o.pose) for o in self.objects])
        points = thing.pose.move(surface_points(thing.mesh, np.random.default_rng(object_id)))
        where = self.stations if stations is None else stations
        return float(np.mean(np.any([caster.sees(station, points) for station in where], axis=0)))


def shop(seed: int, target: Mesh | Sequence[Mesh], copies: int = 1, stations: int = 3, spools: int = 6) -> Scene:
    """A shop of 12 x 10 x 4.2 m: rooms, columns, racks, tables, drums, other spools, and `copies` of each target.

    Spools (anything lower than it is long by a third) rest on any side, on timber or on saw horses; other targets
    stand on the floor. Everything follows from `seed`. Raises UsageError when the targets do not fit.
    """
    targets = [target] if isinstance(target, Mesh) else list(target)
    if not targets or copies < 1 or stations < 1:
        msg = f"a shop needs targets, copies and stations, got {len(targets)}, {copies} and {stations}"
        raise UsageError(msg)
    for attempt in range(LAYOUTS):
        shop_floor = _Layout(seed, attempt)
        if not all(shop_floor.add_target(mesh) for mesh in targets for _ in range(copies)):
            continue
        shop_floor.furnish(spools)
        scene = shop_floor.scene(stations)
        if scene is not None:
            return scene
    msg = f"the targets do not fit into the shop of {SHOP_M} m in sight of the stations; give fewer copies"
    raise UsageError(msg)


class _Layout:
    """A shop being filled, each purpose with a stream of chance of its own."""

    def __init__(self, seed: int, attempt: int) -> None:
        self.rngs = {
            purpose: np.random.default_rng([seed, attempt, k])
            for k, purpose in enumerate(("target", "furniture", "spools", "stations", "paint"))
        }
        self.room = Occupancy(SHOP_M)
        self.objects: list[SceneObject] = []
        walls = furniture.room(*SHOP_M)
        # Only the office counts: the outer walls are the room's own bounds.
        points = surface_points(walls, self.rngs["furniture"], 400)
        self.room.take(points[((points > 0.02) & (points < np.array(SHOP_M) - 0.02)).all(axis=1)])
        self.add(walls, Pose.identity(), "room", 0.6)
        for x, y in ((0.2, 3.3), (0.2, 6.7), (11.8, 3.3), (4.0, 9.8), (8.0, 0.2)):
            self.put(furniture.column(SHOP_M[2]), Pose(np.eye(3), np.array([x, y, 0.0])), "column")

    def add(self, mesh: Mesh, pose: Pose, name: str, reflectance: float | None = None, target: bool = False) -> None:
        paint = float(self.rngs["paint"].uniform(0.25, 0.8)) if reflectance is None else reflectance
        self.objects.append(SceneObject(name, mesh, pose, paint, target))

    def put(self, mesh: Mesh, pose: Pose, name: str, target: bool = False) -> bool:
        """Put a thing where it is meant to be, unless something is there already."""
        points = pose.move(surface_points(mesh, np.random.default_rng(0)))
        if not self.room.fits(points):
            return False
        self.room.take(points)
        self.add(mesh, pose, name, target=target)
        return True

    def add_target(self, mesh: Mesh) -> bool:
        rng = self.rngs["target"]
        lying = np.ptp(mesh.vertices, axis=0).min() < np.ptp(mesh.vertices, axis=0).max() / 3
        return any(self.rest(mesh, rng, "target", lying) for _ in range(TRIES))

    def rest(self, mesh: Mesh, rng: np.random.Generator, purpose: str, lying: bool) -> bool:
        """Try to stand (or lay, on any side) a mesh somewhere on the floor."""
        up = _any_side(rng) if lying else np.eye(3)
        turned = Pose.from_rotation_vector([0.0, 0.0, rng.uniform(0.0, 2 * np.pi)]).rotation @ up
        low = (mesh.vertices @ turned.T).min(axis=0)
        high = (mesh.vertices @ turned.T).max(axis=0)
        flat = high[2] - low[2] < 1.2
        height = float(rng.choice([0.1, 0.75]) if flat else 0.1) if lying else 0.0
        where = rng.uniform([0.15, 0.15], np.maximum(np.array(SHOP_M[:2]) - 0.15 - (high - low)[:2], 0.16))
        pose = Pose(turned, np.array([*(where - low[:2]), height - low[2]]))
        if not self.put(mesh, pose, mesh.name, target=purpose == "target"):
            return False
        if height > 0.0:
            self.support(pose.move(mesh.vertices), height)
        return True

    def support(self, vertices: Floats, height: float) -> None:
        """Timber or saw horses under the lowest parts of something that lies at `height`."""
        bottom = vertices[vertices[:, 2] < height + 0.02][:, :2]
        middle = bottom.mean(axis=0)
        way = np.linalg.svd(bottom - middle, full_matrices=False)[2][0]
        along = (bottom - middle) @ way
        for share in (0.12, 0.88):
            x, y = bottom[np.argmin(np.abs(along - np.quantile(along, share)))]
            turn = Pose.from_rotation_vector([0.0, 0.0, np.arctan2(way[1], way[0])], [x, y, 0.0])
            if height > 0.3:
                mesh, name = furniture.saw_horse(0.8, height), "saw_horse"
            else:
                mesh, name = blocks("timber", [((-0.05, -0.3, 0.0), (0.05, 0.3, height))]), "timber"
            self.room.take(turn.move(surface_points(mesh, np.random.default_rng(0))))
            self.add(mesh, turn, name)

    def furnish(self, spools: int) -> None:
        """Racks and tables along the walls and about, other spools, and what else lies around; what fits."""
        rng = self.rngs["furniture"]
        for _ in range(3):
            self.somewhere(furniture.rack(rng), "rack", rng, at_wall=True)
        for _ in range(3):
            self.somewhere(furniture.table(*rng.uniform([1.6, 0.7], [2.4, 1.1])), "table", rng)
        self.somewhere(furniture.stairs(), "stairs", rng, at_wall=True)
        for _ in range(int(rng.integers(2, 5))):
            self.somewhere(furniture.drum(), "drum", rng)
        for _ in range(3):
            self.somewhere(furniture.stack(rng), "crates", rng)
        for y in (2.5, 6.0):
            tray = furniture.cable_tray(11.0)
            self.put(tray, Pose(np.eye(3), np.array([0.5, y, SHOP_M[2] - 0.6])), "cable_tray")
        rng = self.rngs["spools"]
        for _ in range(spools):
            mesh = other_spool(rng)
            any(self.rest(mesh, rng, "decoy", lying=True) for _ in range(TRIES))

    def somewhere(self, mesh: Mesh, name: str, rng: np.random.Generator, at_wall: bool = False) -> None:
        """Put a thing anywhere on the floor, or with its long side along a wall, if there is room."""
        for _ in range(TRIES):
            yaw = float(rng.integers(4)) * np.pi / 2 if at_wall else float(rng.uniform(0, 2 * np.pi))
            turn = Pose.from_rotation_vector([0.0, 0.0, yaw])
            moved = turn.move(mesh.vertices)
            low, high = moved.min(axis=0)[:2], moved.max(axis=0)[:2]
            room = np.maximum(np.array(SHOP_M[:2]) - 0.1 - (high - low), 0.11)
            where = rng.uniform([0.1, 0.1], room)
            if at_wall:
                wall = int(np.argmin(high - low))
                where[wall] = (0.1, room[wall])[int(rng.integers(2))]
            if self.put(mesh, Pose(turn.rotation, np.array([*(where - low), -moved[:, 2].min()])), name):
                return

    def scene(self, stations: int) -> Scene | None:
        """Stations spread around the targets in free space; None where they cannot see enough of them."""
        rng = self.rngs["stations"]
        targets = [thing for thing in self.objects if thing.target]
        middle = np.mean([t.pose.move(t.mesh.vertices).mean(axis=0)[:2] for t in targets], axis=0)
        caster = RayCaster([(o.mesh, o.pose) for o in self.objects])
        seen_from = [t.pose.move(surface_points(t.mesh, np.random.default_rng(0))) for t in targets]
        body = np.stack(np.meshgrid([-0.3, 0, 0.3], [-0.3, 0, 0.3], np.arange(0.05, 1.9, 0.1)), -1).reshape(-1, 3)
        turn = rng.uniform(0.0, 2 * np.pi)
        for _ in range(20):
            found = []
            for k in range(stations):
                for _ in range(TRIES):
                    angle = turn + 2 * np.pi * (k + rng.uniform(-0.35, 0.35)) / stations
                    away = rng.uniform(1.5, 7.0)
                    at = np.array([*(middle + away * np.array([np.cos(angle), np.sin(angle)])), 0.0])
                    clear = min(np.linalg.norm(points[:, :2] - at[:2], axis=1).min() for points in seen_from)
                    if clear > 0.8 and self.room.fits(at + body):
                        found.append(at + [0.0, 0.0, SCANNER_HEIGHT_M + rng.uniform(-0.1, 0.1)])
                        break
            turn += np.pi / 7
            if len(found) < stations:
                continue
            sight = [[caster.sees(station, points) for station in found] for points in seen_from]
            if all(np.any(views, axis=0).mean() >= LEAST_VISIBLE for views in sight):
                return Scene(tuple(self.objects), np.array(found))
        return None


def _any_side(rng: np.random.Generator) -> Floats:
    """A rotation that lays a thing on one of its six sides, off by a few degrees, as things lie."""
    sides = [[0, 0, 0], [np.pi, 0, 0], [np.pi / 2, 0, 0], [-np.pi / 2, 0, 0], [0, np.pi / 2, 0], [0, -np.pi / 2, 0]]
    side = Pose.from_rotation_vector(np.array(sides, dtype=np.float64)[rng.integers(6)])
    return Pose.from_rotation_vector([*rng.normal(0.0, 0.02, 2), 0.0]).rotation @ side.rotation
