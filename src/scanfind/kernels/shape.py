"""How bent the surface around a point is, on the scale of a window: the same measure for scene and model."""

from __future__ import annotations

from math import ceil, floor, sqrt

import numpy as np

from scanfind.kernels.blocks import find_block, pack_block, row_at, unpack_block
from scanfind.kernels.jit import kernel
from scanfind.kernels.surfels import smallest_eigenvector

LEAST_AROUND = 3  # points that tell a bulge, the one in the middle among them
FACING = 0.2  # least cosine between the normals of two points that face much the same way


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
def bulge_of_samples(points, normals, order, reach, bulges):
    """How far the surface around each of the first B of a model's samples bulges, (B,): see `bulge_of_surfels`.

    order : (N,) the samples by x
    """
    xs = points[order, 0]
    for i in range(bulges.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        count, above = 0, 0.0
        for k in range(np.searchsorted(xs, x - reach), np.searchsorted(xs, x + reach, "right")):
            j = order[k]
            dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
            if dx * dx + dy * dy + dz * dz > reach * reach:
                continue
            if normals[j, 0] * nx + normals[j, 1] * ny + normals[j, 2] * nz >= FACING:
                above += dx * nx + dy * ny + dz * nz
                count += 1
        bulges[i] = above / (count * reach) if count >= LEAST_AROUND else 0.0


@kernel
def bulge_of_surfels(
    start, stop, points, normals, means, directions, signed, first_surfel, sides, cell, hash_keys, hash_values,
    block_rows, reach, bulges,
):  # fmt: skip
    """How far the surface around oriented points start … stop bulges: below 0 as a pipe does, above as a corner.

    It is the mean height above the point's tangent plane of the surfels within `reach` metres that face much the same
    way, in shares of `reach`; 0 where these are fewer than LEAST_AROUND. A scanner sees them together, so that what is
    hidden behind a pipe does not count.

    means, directions, first_surfel, sides, cell, hash_keys, hash_values, block_rows : of those surfels, see Surfels
    signed : False: nobody knows the side of a direction, and either will do
    """
    inverse = 1.0 / cell
    wide = np.int64(ceil(reach * inverse))
    for i in range(start, stop):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        cx, cy, cz = np.int64(floor(x * inverse)), np.int64(floor(y * inverse)), np.int64(floor(z * inverse))
        count, above = 0, 0.0
        for ix in range(cx - wide, cx + wide + 1):
            for iy in range(cy - wide, cy + wide + 1):
                block, held = np.int64(-1), (cz - wide - 8) >> 3
                for iz in range(cz - wide, cz + wide + 1):
                    if iz >> 3 != held:
                        held = iz >> 3
                        block = find_block(hash_keys, hash_values, pack_block(ix >> 3, iy >> 3, held))
                    if block < 0:
                        continue
                    row = row_at(block_rows, block, ((ix & 7) << 6) | ((iy & 7) << 3) | (iz & 7))
                    if row < 0:
                        continue
                    for j in range(first_surfel[row], first_surfel[row] + sides[row]):
                        dx, dy, dz = means[j, 0] - x, means[j, 1] - y, means[j, 2] - z
                        if dx * dx + dy * dy + dz * dz > reach * reach:
                            continue
                        cosine = directions[j, 0] * nx + directions[j, 1] * ny + directions[j, 2] * nz
                        if (cosine if signed else abs(cosine)) >= FACING:
                            above += dx * nx + dy * ny + dz * nz
                            count += 1
        bulges[i] = above / (count * reach) if count >= LEAST_AROUND else 0.0


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
            found[c] = above[row_at(block_rows, higher, (x << 6) | (y << 3) | z)]
