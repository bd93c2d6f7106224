"""How much of a model lies on itself after a motion."""

from __future__ import annotations

from numba import njit

from scanfind.kernels.placed import placed


@njit(cache=True, nogil=True)
def self_overlap(points, normals, some, rotation, translation, reach):
    """Share of the first `some` samples that a motion brings within `reach` metres of a sample with a like normal."""
    hits = 0
    for i in range(some):
        x, y, z, nx, ny, nz = placed(points, normals, i, rotation, translation)
        for j in range(points.shape[0]):
            dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
            along = nx * normals[j, 0] + ny * normals[j, 1] + nz * normals[j, 2]
            if dx * dx + dy * dy + dz * dz <= reach * reach and along > 0.7:
                hits += 1
                break
    return hits / max(some, 1)
