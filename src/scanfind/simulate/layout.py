"""A place being filled: what stands where, without standing in anything else."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from scanfind.errors import UsageError
from scanfind.mesh import Mesh
from scanfind.pose import Pose
from scanfind.simulate import furniture
from scanfind.simulate.parts import blocks
from scanfind.simulate.placement import Occupancy, surface_points
from scanfind.simulate.scene import SceneObject

Floats = NDArray[np.float64]
Choice = TypeVar("Choice")

WALL_GAP_M = 0.1
# Lower than this, a thing may lie on something high; a taller one would be a hazard up there.
LOW_M = 1.2
TIMBER_M, SAW_HORSE_M = 0.1, 0.75
TRIES = 400


class Floor(NamedTuple):
    """What things may stand on: its height, and the corners (x, y) it lies between, metres."""

    height: float
    low: tuple[float, float]
    high: tuple[float, float]


class Layout:
    """Objects placed so far, the room they take, and a stream of chance for each purpose.

    Streams apart: a target with another number of facets, or one decoy more, leaves the rest's dice as they were.

    size : the room things may stand in, from (0, 0, 0) on, metres
    background : object 0, of which nothing takes room
    decks : floors above the ground that things may stand on as well
    high : heights of supports for what is low enough to lie there
    """

    def __init__(
        self,
        seed: Sequence[int],
        size: tuple[float, float, float],
        background: Mesh,
        decks: Sequence[Floor] = (),
        high: Sequence[float] = (SAW_HORSE_M,),
    ) -> None:
        purposes = ("target", "furniture", "spools", "stations", "paint")
        self.rngs = {purpose: np.random.default_rng([*seed, k]) for k, purpose in enumerate(purposes)}
        self.floors = [Floor(0.0, (0.0, 0.0), size[:2]), *decks]
        self.high = high
        self.room = Occupancy(size)
        self._spread: dict[Mesh, Floats] = {}
        self.objects = [SceneObject(background.name, background, Pose.identity(), 0.6)]

    def on_surface(self, thing: SceneObject) -> Floats:
        """Points (N, 3) spread over an object where it stands."""
        if thing.mesh not in self._spread:
            self._spread[thing.mesh] = surface_points(thing.mesh, np.random.default_rng(0))
        return thing.pose.move(self._spread[thing.mesh])

    def painted(self, name: str, mesh: Mesh, pose: Pose, target: bool = False) -> SceneObject:
        """An object of a chance reflectance."""
        return SceneObject(name, mesh, pose, float(self.rngs["paint"].uniform(0.25, 0.8)), target)

    def put(self, things: Sequence[SceneObject]) -> bool:
        """Put things where they are meant to be, all or none: not where anything is already."""
        points = np.concatenate([self.on_surface(thing) for thing in things])
        if not self.room.fits(points):
            return False
        self.room.take(points)
        self.objects.extend(things)
        return True

    def fix(self, things: Sequence[SceneObject], sunk: float = 0.0) -> None:
        """Put things that fit by construction, touching each other; `sunk`: metres they take room lower than they are.

        Sunk by half a voxel, a deck leaves free the room that begins at its surface.
        """
        for thing in things:
            self.room.take(self.on_surface(thing) - [0.0, 0.0, sunk])
        self.objects.extend(things)

    def add_target(self, mesh: Mesh) -> bool:
        """Put what is looked for: flat things on any side, others upright; False where it fits nowhere."""
        size = np.ptp(mesh.vertices, axis=0)
        lying = bool(size.min() < size.max() / 3)
        return any(self.rest(mesh, self.rngs["target"], lying, target=True) for _ in range(TRIES))

    def rest(self, mesh: Mesh, rng: np.random.Generator, lying: bool, target: bool = False) -> bool:
        """Try once to stand a mesh somewhere, or to lay it on some side on supports."""
        turn = yaw(rng.uniform(0.0, 2 * np.pi)) @ (_any_side(rng) if lying else Pose.identity())
        turned = turn.move(mesh.vertices)
        low, size = turned.min(axis=0), np.ptp(turned, axis=0)
        height = 0.0
        if lying:
            height = _one_of(self.high, rng) if size[2] < LOW_M and rng.random() < 0.5 else TIMBER_M
        floor = _one_of(self.floors, rng)
        first, last = _corners(floor, size)
        corner = np.array([*rng.uniform(first, last), floor.height + height])
        thing = self.painted(mesh.name, mesh, at(*(corner - low)) @ turn, target)
        things = [thing, *(self._supports(turned + (corner - low), floor.height, height) if lying else [])]
        return bool((corner[:2] + size[:2] <= floor.high).all()) and self.put(things)

    def stand(self, mesh: Mesh, rng: np.random.Generator, at_wall: bool = False) -> None:
        """Stand a mesh anywhere on the floor, or with its long side along a wall, if there is room."""
        for _ in range(TRIES):
            turn = yaw(float(rng.integers(4)) * np.pi / 2 if at_wall else rng.uniform(0, 2 * np.pi))
            turned = turn.move(mesh.vertices)
            low, size = turned.min(axis=0), np.ptp(turned, axis=0)
            floor = _one_of(self.floors, rng)
            first, last = _corners(floor, size)
            corner = rng.uniform(first, last)
            if at_wall:
                short = int(np.argmin(size[:2]))
                corner[short] = (first[short], last[short])[int(rng.integers(2))]
            x, y = corner - low[:2]
            thing = self.painted(mesh.name, mesh, at(x, y, floor.height) @ turn)
            if (corner + size[:2] <= floor.high).all() and self.put([thing]):
                return

    def _supports(self, vertices: Floats, floor: float, tall: float) -> list[SceneObject]:
        """Timber, saw horses or goalposts under the lowest parts of vertices (V, 3) that begin `tall` above a floor."""
        bottom = vertices[vertices[:, 2] < floor + tall + 0.02][:, :2]
        way = np.linalg.svd(bottom - bottom.mean(axis=0), full_matrices=False)[2][0]
        along = bottom @ way
        supports = []
        # One under the middle where there is no length to speak of: a spool on its end.
        for share in (0.12, 0.88) if np.ptp(along) > 0.6 else (0.5,):
            x, y = bottom[np.argmin(np.abs(along - np.quantile(along, share)))]
            pose = at(x, y, floor) @ yaw(np.arctan2(way[1], way[0]))
            if tall > SAW_HORSE_M:
                supports.append(self.painted("goalpost", furniture.goalpost(1.0, tall), pose))
            elif tall > TIMBER_M:
                supports.append(self.painted("saw_horse", furniture.saw_horse(0.8, tall), pose))
            else:
                timber = blocks("timber", [((-0.05, -0.3, 0.0), (0.05, 0.3, tall))])
                supports.append(self.painted("timber", timber, pose))
        return supports


def targets_of(
    target: Mesh | Sequence[Mesh], copies: int, stations: int, place: str, size: tuple[float, float, float]
) -> list[Mesh]:
    """The door of every generated scene: what is looked for, as a list; `place` is what it is to stand in, `size` m.

    Raises UsageError where a count is not positive, or a target is larger than the place.
    """
    targets = [target] if isinstance(target, Mesh) else list(target)
    if not targets or copies < 1 or stations < 1:
        msg = f"a {place} needs targets, copies and stations, got {len(targets)}, {copies} and {stations}"
        raise UsageError(msg)
    for mesh in targets:
        extent = np.ptp(mesh.vertices, axis=0)
        across = np.sort(extent)
        if across[2] > np.hypot(*size[:2]) or across[1] > max(size):
            wide, room = (" x ".join(f"{length:.1f}" for length in lengths) for lengths in (extent, size))
            msg = f"{mesh.name} is {wide} m, too large for the {place} of {room} m: check its units"
            raise UsageError(msg)
    return targets


def at(x: float, y: float, z: float = 0.0) -> Pose:
    """There, not turned."""
    return Pose(np.eye(3), np.array([x, y, z]))


def yaw(angle: float) -> Pose:
    """Turned about z."""
    return Pose.from_rotation_vector([0.0, 0.0, angle])


def _corners(floor: Floor, size: Floats) -> tuple[Floats, Floats]:
    """Between which (2,) the low corner of something of this size (3,) may lie."""
    first = np.array(floor.low) + WALL_GAP_M
    return first, np.maximum(np.array(floor.high) - WALL_GAP_M - size[:2], first)


def _one_of(choices: Sequence[Choice], rng: np.random.Generator) -> Choice:
    """Any of them; where there is one only, without a throw."""
    return choices[0] if len(choices) == 1 else choices[int(rng.integers(len(choices)))]


def _any_side(rng: np.random.Generator) -> Pose:
    """A turn that lays a thing on one of its six sides, a degree or two off, as things lie."""
    quarter = np.pi / 2
    sides = ((0, 0), (2, 0), (1, 0), (-1, 0), (0, 1), (0, -1))
    x, y = sides[int(rng.integers(len(sides)))]
    lean = Pose.from_rotation_vector([*rng.normal(0.0, 0.02, 2), 0.0])
    return lean @ Pose.from_rotation_vector([quarter * x, quarter * y, 0.0])
