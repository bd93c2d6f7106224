"""How bent the surface around a point is, on the scale of a window: the same measure for scene and model."""

from __future__ import annotations

from math import floor, sqrt

import numpy as np
from numba import njit

from scanfind.kernels.blocks import find_block, pack_block
from scanfind.kernels.surfels import smallest_eigenvector


@njit(cache=True, nogil=True)
def bend_of_samples(points, normals, window, bends):
    """Standard deviation across the plane fitted to a model's samples in a cube of edge `window` metres, (N,), metres.

    Only samples that face the same way as the one in the middle count: a scanner sees them together.
    """
    half = 0.5 * window
    for i in range(points.shape[0]):
        n = sx = sy = sz = sxx = sxy = sxz = syy = syz = szz = 0.0
        for j in range(points.shape[0]):
            x, y, z = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
            if abs(x) > half or abs(y) > half or abs(z) > half:
                continue
            facing = normals[i, 0] * normals[j, 0] + normals[i, 1] * normals[j, 1] + normals[i, 2] * normals[j, 2]
            if facing <= -0.05:
                continue
            n += 1.0
            sx += x
            sy += y
            sz += z
            sxx += x * x
            sxy += x * y
            sxz += x * z
            syy += y * y
            syz += y * z
            szz += z * z
        sx, sy, sz = sx / n, sy / n, sz / n
        _, _, _, low, _, _ = smallest_eigenvector(
            sxx / n - sx * sx, sxy / n - sx * sy, sxz / n - sx * sz,
            syy / n - sy * sy, syz / n - sy * sz, szz / n - sz * sz,
        )  # fmt: skip
        bends[i] = sqrt(max(low, 0.0))


@njit(cache=True, nogil=True)
def look_up_flatness(means, cell, hash_keys, hash_values, block_cells, first_surfel, flatness, found):
    """The flatness of the coarse cell each of S points lies in, (S,), metres; inf where there is none."""
    inverse = 1.0 / cell
    for i in range(means.shape[0]):
        found[i] = np.inf
        cx = np.int64(floor(means[i, 0] * inverse))
        cy = np.int64(floor(means[i, 1] * inverse))
        cz = np.int64(floor(means[i, 2] * inverse))
        block = find_block(hash_keys, hash_values, pack_block(cx >> 3, cy >> 3, cz >> 3))
        if block < 0:
            continue
        here = block_cells[block, ((cx & 7) << 6) | ((cy & 7) << 3) | (cz & 7)]
        if here >= 0:
            found[i] = flatness[first_surfel[here]]
