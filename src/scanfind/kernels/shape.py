"""How bent the surface around a point is, on the scale of a window: the same measure for scene and model."""

from __future__ import annotations

from math import sqrt

import numpy as np

from scanfind.kernels.blocks import find_block, pack_block, unpack_block
from scanfind.kernels.jit import kernel
from scanfind.kernels.surfels import smallest_eigenvector


@kernel
def bend_of_samples(points, normals, window, bends):
    """Standard deviation across the plane fitted to a model's samples in a cube of edge `window` metres about each of
    the first B of them, (B,), metres.

    Only samples that face the same way as the one in the middle count: a scanner sees them together.
    """
    half = 0.5 * window
    for i in range(bends.shape[0]):
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


@kernel
def spread_down(levels, block_keys, order, first_cell, cell_locals, hash_keys, hash_values, block_rows, above, found):
    """Give each cell what the cell `levels` above it in the octree has.

    block_keys, order, first_cell, cell_locals : of the cells; hash_keys, hash_values, block_rows : of those above
    above : values by row; found : (V,) out
    """
    for block in range(order.shape[0]):
        bx, by, bz = unpack_block(block_keys[order[block]])
        # Up to three levels above, all of a block's cells lie in one block.
        higher = find_block(hash_keys, hash_values, pack_block(bx >> levels, by >> levels, bz >> levels))
        for c in range(first_cell[block], first_cell[block + 1]):
            local = np.int64(cell_locals[c])
            x = (((bx << 3) | (local >> 6)) >> levels) & 7
            y = (((by << 3) | ((local >> 3) & 7)) >> levels) & 7
            z = (((bz << 3) | (local & 7)) >> levels) & 7
            found[c] = above[block_rows[higher, (x << 6) | (y << 3) | z]]
