"""How much of a model lies on itself after a motion."""

from __future__ import annotations

from numba import njit


@njit(cache=True, nogil=True)
def self_overlap(points, normals, some, rotation, translation, reach):
    """Share of the first `some` samples that a motion brings within `reach` metres of a sample with a like normal."""
    hits = 0
    for i in range(some):
        p, m = points[i], normals[i]
        x = rotation[0, 0] * p[0] + rotation[0, 1] * p[1] + rotation[0, 2] * p[2] + translation[0]
        y = rotation[1, 0] * p[0] + rotation[1, 1] * p[1] + rotation[1, 2] * p[2] + translation[1]
        z = rotation[2, 0] * p[0] + rotation[2, 1] * p[1] + rotation[2, 2] * p[2] + translation[2]
        nx = rotation[0, 0] * m[0] + rotation[0, 1] * m[1] + rotation[0, 2] * m[2]
        ny = rotation[1, 0] * m[0] + rotation[1, 1] * m[1] + rotation[1, 2] * m[2]
        nz = rotation[2, 0] * m[0] + rotation[2, 1] * m[1] + rotation[2, 2] * m[2]
        for j in range(points.shape[0]):
            dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
            along = nx * normals[j, 0] + ny * normals[j, 1] + nz * normals[j, 2]
            if dx * dx + dy * dy + dz * dz <= reach * reach and along > 0.7:
                hits += 1
                break
    return hits / max(some, 1)
