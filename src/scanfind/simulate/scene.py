"""What there is to scan: objects where they stand, and where the scanner does."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanfind.evidence.rays import RayCaster
from scanfind.mesh import Mesh
from scanfind.pose import Pose
from scanfind.simulate.placement import surface_points

Floats = NDArray[np.float64]

# The object id of the room, and of points that lie on nothing.
BACKGROUND = 0


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
    """Metres, z up.

    objects : by object id; 0 is the background (the room)
    stations : (S, 3) where scanners stand
    look_at : (S, 3) what each is turned to, for instruments with a narrow view; None: to the nearest target
    """

    objects: tuple[SceneObject, ...]
    stations: Floats
    look_at: Floats | None = None

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

    def looked_at(self, stations: Floats) -> Floats:
        """(S, 3): what the instruments at `stations` (S, 3) are turned to."""
        if self.look_at is not None and len(self.look_at) == len(stations):
            return self.look_at
        shown = [thing for thing in self.objects if thing.target] or list(self.objects)
        corners = [thing.pose.move(thing.mesh.vertices) for thing in shown]
        middles = np.array([(c.min(axis=0) + c.max(axis=0)) / 2 for c in corners])
        nearest: Floats = middles[[int(np.argmin(np.linalg.norm(middles - at, axis=1))) for at in stations]]
        return nearest

    def reflectances(self) -> Floats:
        """By object id, (objects,)."""
        return np.array([thing.reflectance for thing in self.objects])

    def caster(self) -> RayCaster:
        """The scene ready to be shot at; owners of hits are object ids."""
        return RayCaster([(thing.mesh, thing.pose) for thing in self.objects])

    def visible_share(self, object_id: int) -> float:
        """Which share of an object's surface the stations together see, occlusion by everything counted."""
        thing, caster = self.objects[object_id], self.caster()
        points = thing.pose.move(surface_points(thing.mesh, np.random.default_rng(object_id)))
        return float(np.mean(np.any([caster.sees(station, points) for station in self.stations], axis=0)))
