"""Which room is taken: voxels that tell whether a thing can stand somewhere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanfind.mesh import Mesh, doubled_areas

Floats = NDArray[np.float64]

VOXEL_M = 0.1
# Nine points or so on each voxel a surface crosses: one in eight thousand is missed.
POINTS_PER_M2 = 900.0


class Occupancy:
    """A room's voxels, `size` metres from `corner` on; nothing is in it at first."""

    def __init__(self, size: tuple[float, float, float], corner: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        self.size, self.corner = np.array(size), np.array(corner)
        self._taken = np.zeros(np.ceil(self.size / VOXEL_M).astype(int), dtype=bool)

    def fits(self, points: Floats) -> bool:
        """Whether a thing with these surface points (N, 3) stands inside the room and meets nothing."""
        inside = points - self.corner
        if (inside < -1e-6).any() or (inside > self.size + 1e-6).any():
            return False
        return not self._taken[self._cells(points)].any()

    def take(self, points: Floats) -> None:
        """Mark the room of a thing with these surface points (N, 3)."""
        self._taken[self._cells(points)] = True

    def _cells(self, points: Floats) -> tuple[NDArray[np.int64], ...]:
        cells = np.clip(((points - self.corner) / VOXEL_M).astype(np.int64), 0, np.array(self._taken.shape) - 1)
        return tuple(cells.T)


def surface_points(mesh: Mesh, rng: np.random.Generator, per_m2: float = POINTS_PER_M2) -> Floats:
    """Points (N, 3) drawn evenly on a mesh's surface, mesh frame."""
    return sample_points(mesh, rng, max(1, int(mesh.area() * per_m2)))


def sample_points(mesh: Mesh, rng: np.random.Generator, count: int) -> Floats:
    """So many points (count, 3) drawn evenly on a mesh's surface, mesh frame."""
    return sample_oriented(mesh, rng, count)[0]


def sample_oriented(mesh: Mesh, rng: np.random.Generator, count: int) -> tuple[Floats, Floats]:
    """Points and their unit normals, (count, 3) each, drawn evenly on a mesh's surface, mesh frame."""
    areas = doubled_areas(mesh.vertices, mesh.faces) / 2
    face = rng.choice(len(areas), size=count, p=areas / areas.sum())
    u, v = rng.random((2, len(face)))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    a, b, c = np.moveaxis(mesh.triangles()[face], 1, 0)
    normals = np.cross(b - a, c - a)
    points: Floats = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)
