"""How much of a model lies on itself after a motion."""

from __future__ import annotations

import numpy as np

from scanfind.kernels.jit import kernel
from scanfind.kernels.placed import placed


@kernel
def self_overlap(points, normals, some, onto, onto_normals, along_axis, axis, signed, rotation, translation, reach):
    """Share of the first `some` samples that a motion brings within `reach` metres of a sample with a like normal.

    onto, onto_normals : the samples sorted along a coordinate axis, where they are at along_axis (N,)
    signed : False where nobody knows which way the normals face
    """
    hits = 0
    for i in range(some):
        x, y, z, nx, ny, nz = placed(points, normals, i, rotation, translation)
        here = x if axis == 0 else y if axis == 1 else z
        for j in range(np.searchsorted(along_axis, here - reach), onto.shape[0]):
            if along_axis[j] > here + reach:
                break
            dx, dy, dz = onto[j, 0] - x, onto[j, 1] - y, onto[j, 2] - z
            along = nx * onto_normals[j, 0] + ny * onto_normals[j, 1] + nz * onto_normals[j, 2]
            if dx * dx + dy * dy + dz * dz <= reach * reach and (along if signed else abs(along)) > 0.7:
                hits += 1
                break
    return hits / max(some, 1)


@kernel
def count_shifts(points, normals, onto, onto_normals, signed, per_metre, reach, table):
    """Count, in cells of a table (2 a + 1, 2 b + 1, 2 c + 1), the shifts from a point to another of like normal.

    per_metre : cells a metre; reach : (a, b, c), the cell of no shift
    """
    for i in range(points.shape[0]):
        for j in range(onto.shape[0]):
            along = (
                normals[i, 0] * onto_normals[j, 0]
                + normals[i, 1] * onto_normals[j, 1]
                + normals[i, 2] * onto_normals[j, 2]
            )
            if (along if signed else abs(along)) > 0.9:
                u = int(round((onto[j, 0] - points[i, 0]) * per_metre))
                v = int(round((onto[j, 1] - points[i, 1]) * per_metre))
                w = int(round((onto[j, 2] - points[i, 2]) * per_metre))
                table[reach[0] + u, reach[1] + v, reach[2] + w] += 1
