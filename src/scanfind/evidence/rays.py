"""First hits of rays on a scene's triangles (Embree)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanfind.errors import InvalidGeometryError
from scanfind.mesh import Mesh
from scanfind.pose import Pose

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Hits:
    """What R rays met first.

    distance : (R,) metres along the ray, inf where it met nothing
    owner : (R,) int32, index of the mesh it met, -1 for none
    cosine : (R,) |cos| of the angle between ray and surface normal, 0 for none
    """

    distance: Floats
    owner: NDArray[np.int32]
    cosine: Floats


class RayCaster:
    """Placed meshes, ready to be shot at. Embree works in float32: 1 µm at ten metres from their middle."""

    def __init__(self, placed: Sequence[tuple[Mesh, Pose]]) -> None:
        """`placed`: each mesh with scene_from_mesh; raises InvalidGeometryError when there is none."""
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        if not placed:
            msg = "a scene to scan needs at least one mesh"
            raise InvalidGeometryError(msg)
        self.meshes = len(placed)
        triangles = np.concatenate([pose.move(mesh.vertices)[mesh.faces] for mesh, pose in placed])
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        self._normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
        self._owner = np.repeat(np.arange(len(placed), dtype=np.int32), [len(mesh.faces) for mesh, _ in placed])
        corners = triangles.reshape(-1, 3)
        self._middle = np.round(0.5 * (corners.min(axis=0) + corners.max(axis=0)))
        self._scene: Any = EmbreeScene()
        self._mesh: Any = TriangleMesh(self._scene, (triangles - self._middle).astype(np.float32))
        self.shoot(np.zeros(3), np.eye(3)[:1])  # Embree builds its tree at the first ray: not in two threads at once

    def shoot(self, origins: Floats, directions: Floats) -> Hits:
        """First hits of R rays: origins (R, 3) or (3,), unit directions (R, 3), scene frame, metres."""
        d = np.ascontiguousarray(directions, dtype=np.float32)
        o = np.ascontiguousarray(np.broadcast_to(origins - self._middle, d.shape), dtype=np.float32)
        found = self._scene.run(o, d, output=1)
        face = found["primID"]
        hit = face >= 0
        distance = np.where(hit, found["tfar"], np.inf).astype(np.float64)
        cosine = np.abs(np.einsum("ij,ij->i", self._normals[face], d)).astype(np.float64)
        return Hits(distance, np.where(hit, self._owner[face], np.int32(-1)), np.where(hit, cosine, 0.0))

    def sees(self, station: Floats, points: Floats, slack: float = 0.005) -> NDArray[np.bool_]:
        """Which of N points (N, 3) a scanner at `station` (3,) can see: nothing nearer than them by `slack` metres."""
        toward = points - station
        distance = np.linalg.norm(toward, axis=1)
        hits = self.shoot(station, toward / np.maximum(distance, 1e-9)[:, None])
        clear: NDArray[np.bool_] = hits.distance > distance - slack
        return clear

    def around(self, point: Floats) -> tuple[float, float]:
        """How near the nearest surface is in a thousand directions, and which share of what is seen shows its back.

        A point inside of something closed sees backs only; one in the open, fronts.
        """
        k = np.arange(1000) + 0.5
        height, turn = 1 - 2 * k / 1000, np.pi * (1 + 5**0.5) * k  # a spiral, evenly over the sphere
        level = np.sqrt(1 - height**2)
        ways = np.stack([level * np.cos(turn), level * np.sin(turn), height], axis=1)
        found = self._scene.run(
            np.tile(point - self._middle, (1000, 1)).astype(np.float32), ways.astype(np.float32), output=1
        )
        hit = found["primID"] >= 0
        if not hit.any():
            return float("inf"), 0.0
        backs = np.einsum("ij,ij->i", self._normals[found["primID"][hit]], ways[hit]) > 0
        return float(found["tfar"][hit].min()), float(backs.mean())
