"""A shop being filled: what stands where, without standing in anything else."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scanfind.mesh import Mesh
from scanfind.pose import Pose
from scanfind.simulate import furniture
from scanfind.simulate.objects import other_spool
from scanfind.simulate.parts import assemble, blocks
from scanfind.simulate.placement import Occupancy, surface_points
from scanfind.simulate.scene import SceneObject

Floats = NDArray[np.float64]

SHOP_M = (12.0, 10.0, 4.2)
OFFICE_M = (3.0, 2.6)
COLUMNS_M = ((0.2, 3.3), (0.2, 6.7), (11.8, 3.3), (4.0, 9.8), (8.0, 0.2))
TRAYS_M = (2.5, 6.0)
WALL_GAP_M = 0.1
# Lower than this, a thing may lie on saw horses; a taller one would be a hazard up there.
LOW_M = 1.2
TIMBER_M, SAW_HORSE_M = 0.1, 0.75
TRIES = 400


class Layout:
    """Objects placed so far, the room they take, and a stream of chance for each purpose.

    Streams apart: a target with another number of facets, or one decoy more, leaves the rest's dice as they were.
    """

    def __init__(self, seed: Sequence[int]) -> None:
        purposes = ("target", "furniture", "spools", "stations", "paint")
        self.rngs = {purpose: np.random.default_rng([*seed, k]) for k, purpose in enumerate(purposes)}
        self.room = Occupancy(SHOP_M)
        self._spread: dict[Mesh, Floats] = {}
        office = (furniture.office(*OFFICE_M, SHOP_M[2]), _at(*SHOP_M[:2]))
        # Of the background only the office takes room: hall and occupancy end at the same planes.
        self.room.take(self.on_surface(SceneObject("office", *office)))
        background = assemble("room", [(furniture.hall(*SHOP_M), Pose.identity()), office])
        self.objects = [SceneObject("room", background, Pose.identity(), 0.6)]
        for x, y in COLUMNS_M:
            self.put([self._object("column", furniture.column(SHOP_M[2]), _at(x, y))])

    def on_surface(self, thing: SceneObject) -> Floats:
        """Points (N, 3) spread over an object where it stands."""
        if thing.mesh not in self._spread:
            self._spread[thing.mesh] = surface_points(thing.mesh, np.random.default_rng(0))
        return thing.pose.move(self._spread[thing.mesh])

    def put(self, things: Sequence[SceneObject]) -> bool:
        """Put things where they are meant to be, all or none: not where anything is already."""
        points = np.concatenate([self.on_surface(thing) for thing in things])
        if not self.room.fits(points):
            return False
        self.room.take(points)
        self.objects.extend(things)
        return True

    def add_target(self, mesh: Mesh) -> bool:
        """Put what is looked for: flat things on any side, others upright; False where it fits nowhere."""
        size = np.ptp(mesh.vertices, axis=0)
        lying = bool(size.min() < size.max() / 3)
        return any(self._rest(mesh, self.rngs["target"], lying, target=True) for _ in range(TRIES))

    def furnish(self, spools: int) -> None:
        """Put racks, tables, stairs, drums, crates, cable trays and other spools: as many as fit."""
        rng = self.rngs["furniture"]
        for _ in range(3):
            self._stand(furniture.rack(rng), rng, at_wall=True)
        self._stand(furniture.stairs(), rng, at_wall=True)
        for _ in range(3):
            self._stand(furniture.table(*rng.uniform([1.6, 0.7], [2.4, 1.1])), rng)
        for _ in range(int(rng.integers(2, 5))):
            self._stand(furniture.drum(), rng)
        for _ in range(3):
            self._stand(furniture.crates(rng), rng)
        for y in TRAYS_M:
            self.put([self._object("cable_tray", furniture.cable_tray(11.0), _at(0.5, y, SHOP_M[2] - 0.6))])
        rng = self.rngs["spools"]
        for _ in range(spools):
            decoy = other_spool(rng)
            any(self._rest(decoy, rng, lying=True) for _ in range(TRIES))

    def _object(self, name: str, mesh: Mesh, pose: Pose, target: bool = False) -> SceneObject:
        return SceneObject(name, mesh, pose, float(self.rngs["paint"].uniform(0.25, 0.8)), target)

    def _rest(self, mesh: Mesh, rng: np.random.Generator, lying: bool, target: bool = False) -> bool:
        """Try once to stand a mesh somewhere, or to lay it on some side on supports."""
        turn = _yaw(rng.uniform(0.0, 2 * np.pi)) @ (_any_side(rng) if lying else Pose.identity())
        turned = turn.move(mesh.vertices)
        low, size = turned.min(axis=0), np.ptp(turned, axis=0)
        height = 0.0
        if lying:
            height = SAW_HORSE_M if size[2] < LOW_M and rng.random() < 0.5 else TIMBER_M
        room = np.maximum(np.array(SHOP_M[:2]) - WALL_GAP_M - size[:2], WALL_GAP_M)
        corner = np.array([*rng.uniform([WALL_GAP_M, WALL_GAP_M], room), height])
        thing = self._object(mesh.name, mesh, _at(*(corner - low)) @ turn, target)
        return self.put([thing, *(self._supports(turned + (corner - low), height) if lying else [])])

    def _supports(self, vertices: Floats, height: float) -> list[SceneObject]:
        """Timber or saw horses under the lowest parts of something whose vertices (V, 3) begin at `height`."""
        bottom = vertices[vertices[:, 2] < height + 0.02][:, :2]
        way = np.linalg.svd(bottom - bottom.mean(axis=0), full_matrices=False)[2][0]
        along = bottom @ way
        supports = []
        # One under the middle where there is no length to speak of: a spool on its end.
        for share in (0.12, 0.88) if np.ptp(along) > 0.6 else (0.5,):
            x, y = bottom[np.argmin(np.abs(along - np.quantile(along, share)))]
            pose = _at(x, y) @ _yaw(np.arctan2(way[1], way[0]))
            if height > TIMBER_M:
                supports.append(self._object("saw_horse", furniture.saw_horse(0.8, height), pose))
            else:
                timber = blocks("timber", [((-0.05, -0.3, 0.0), (0.05, 0.3, height))])
                supports.append(self._object("timber", timber, pose))
        return supports

    def _stand(self, mesh: Mesh, rng: np.random.Generator, at_wall: bool = False) -> None:
        """Stand a mesh anywhere on the floor, or with its long side along a wall, if there is room."""
        for _ in range(TRIES):
            turn = _yaw(float(rng.integers(4)) * np.pi / 2 if at_wall else rng.uniform(0, 2 * np.pi))
            turned = turn.move(mesh.vertices)
            low, size = turned.min(axis=0), np.ptp(turned, axis=0)
            room = np.maximum(np.array(SHOP_M[:2]) - WALL_GAP_M - size[:2], WALL_GAP_M)
            corner = rng.uniform([WALL_GAP_M, WALL_GAP_M], room)
            if at_wall:
                short = int(np.argmin(size[:2]))
                corner[short] = (WALL_GAP_M, room[short])[int(rng.integers(2))]
            if self.put([self._object(mesh.name, mesh, _at(*(corner - low[:2])) @ turn)]):
                return


def _at(x: float, y: float, z: float = 0.0) -> Pose:
    return Pose(np.eye(3), np.array([x, y, z]))


def _yaw(angle: float) -> Pose:
    return Pose.from_rotation_vector([0.0, 0.0, angle])


def _any_side(rng: np.random.Generator) -> Pose:
    """A turn that lays a thing on one of its six sides, a degree or two off, as things lie."""
    quarter = np.pi / 2
    sides = ((0, 0), (2, 0), (1, 0), (-1, 0), (0, 1), (0, -1))
    x, y = sides[int(rng.integers(len(sides)))]
    lean = Pose.from_rotation_vector([*rng.normal(0.0, 0.02, 2), 0.0])
    return lean @ Pose.from_rotation_vector([quarter * x, quarter * y, 0.0])
