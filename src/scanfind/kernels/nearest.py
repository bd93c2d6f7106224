"""The surfel a placed model point lies on: the nearest in the cells around it, with a like normal."""

from __future__ import annotations

from math import floor

import numpy as np
from numba import njit

from scanfind.kernels.blocks import find_block, pack_block


@njit(cache=True, nogil=True)
def nearest_surfel(
    x, y, z, nx, ny, nz, gate, least_cosine, signed,
    cell, hash_keys, hash_values, block_rows, first_surfel, sides, means, normals,
):  # fmt: skip
    """The nearest surfel within `gate` metres whose normal agrees, -1 where there is none.

    least_cosine : of the angle between normals; by magnitude where the scene's normals are not signed
    """
    inverse = 1.0 / cell
    reach = gate * inverse
    x0, x1 = np.int64(floor(x * inverse - reach)), np.int64(floor(x * inverse + reach))
    y0, y1 = np.int64(floor(y * inverse - reach)), np.int64(floor(y * inverse + reach))
    z0, z1 = np.int64(floor(z * inverse - reach)), np.int64(floor(z * inverse + reach))
    best, nearest = np.int64(-1), gate * gate
    key, block = np.int64(-1), np.int64(-1)
    for ix in range(x0, x1 + 1):
        for iy in range(y0, y1 + 1):
            for iz in range(z0, z1 + 1):
                here = pack_block(ix >> 3, iy >> 3, iz >> 3)
                if here != key:
                    key = here
                    block = find_block(hash_keys, hash_values, key)
                if block < 0:
                    continue
                row = block_rows[block, ((ix & 7) << 6) | ((iy & 7) << 3) | (iz & 7)]
                if row < 0:
                    continue
                for s in range(first_surfel[row], first_surfel[row] + sides[row]):
                    dx, dy, dz = means[s, 0] - x, means[s, 1] - y, means[s, 2] - z
                    squared = dx * dx + dy * dy + dz * dz
                    if squared >= nearest:
                        continue
                    cosine = nx * normals[s, 0] + ny * normals[s, 1] + nz * normals[s, 2]
                    if cosine < least_cosine and (signed or -cosine < least_cosine):
                        continue
                    best, nearest = s, squared
    return best


@njit(cache=True, nogil=True)
def mark_around(points, reach, cell, hash_keys, hash_values, block_rows, marked):
    """Mark the rows of occupied cells up to `reach` cells from those points (N, 3) lie in; marked : bool, in place."""
    inverse = 1.0 / cell
    for i in range(points.shape[0]):
        cx = np.int64(floor(points[i, 0] * inverse))
        cy = np.int64(floor(points[i, 1] * inverse))
        cz = np.int64(floor(points[i, 2] * inverse))
        key, block = np.int64(-1), np.int64(-1)
        for ix in range(cx - reach, cx + reach + 1):
            for iy in range(cy - reach, cy + reach + 1):
                for iz in range(cz - reach, cz + reach + 1):
                    here = pack_block(ix >> 3, iy >> 3, iz >> 3)
                    if here != key:
                        key = here
                        block = find_block(hash_keys, hash_values, key)
                    if block < 0:
                        continue
                    row = block_rows[block, ((ix & 7) << 6) | ((iy & 7) << 3) | (iz & 7)]
                    if row >= 0:
                        marked[row] = True
