"""Lines: where what lies in a window about a point is long and thin, its middle and its direction."""

from __future__ import annotations

from math import ceil

import numpy as np

from scanfind.kernels.blocks import find_block, pack_block, row_at, unpack_block
from scanfind.kernels.jit import kernel
from scanfind.kernels.search import lie_on_scene
from scanfind.kernels.surfels import add_moved, smallest_eigenvector, sum_views


@kernel
def line_of(pool, line):
    """Write the mean, the direction of the largest spread, and 1 less the ratio of second to largest, (7,)."""
    n = pool[0]
    mx, my, mz = pool[1] / n, pool[2] / n, pool[3] / n
    # The smallest of -A is the largest of A.
    tx, ty, tz, first, second, _ = smallest_eigenvector(
        mx * mx - pool[4] / n, mx * my - pool[5] / n, mx * mz - pool[6] / n,
        my * my - pool[7] / n, my * mz - pool[8] / n, mz * mz - pool[9] / n,
    )  # fmt: skip
    line[0], line[1], line[2], line[3], line[4], line[5] = mx, my, mz, tx, ty, tz
    line[6] = 1.0 - second / first if first < 0.0 else 0.0


@kernel
def fit_lines(
    start, stop, first_cell, cell_locals, order, block_keys, hash_keys, hash_values, block_rows, moments, links, cell,
    units, reach, least, lines,
):  # fmt: skip
    """Fit a line to what lies up to `reach` cells around each cell of blocks order[start:stop], (V, 7), metres.

    first_cell … block_rows : see Cells; units : offset units a cell
    reach : cells, between centres; least : cells that must be occupied there, or the line is all zeros

    Every cell counts once, however many points it has: else the near end of a window would draw the line to itself.
    """
    unit = cell / units
    wide = np.int64(ceil(reach))
    pool, one, views = np.empty(10), np.empty(10), np.empty((1, 13), np.int64)
    line = np.empty(7)
    around = np.empty(27, np.int64)
    for block in range(start, stop):
        bx, by, bz = unpack_block(block_keys[order[block]])
        for k in range(27):
            key = pack_block(bx + k // 9 - 1, by + k // 3 % 3 - 1, bz + k % 3 - 1)
            around[k] = find_block(hash_keys, hash_values, key)
        for c in range(first_cell[block], first_cell[block + 1]):
            local = np.int64(cell_locals[c])
            lx, ly, lz = local >> 6, (local >> 3) & 7, local & 7
            for k in range(10):
                pool[k] = 0.0
            for dx in range(-wide, wide + 1):
                for dy in range(-wide, wide + 1):
                    for dz in range(-wide, wide + 1):
                        if dx * dx + dy * dy + dz * dz > reach * reach:
                            continue
                        ix, iy, iz = lx + dx, ly + dy, lz + dz
                        other = around[((ix >> 3) + 1) * 9 + ((iy >> 3) + 1) * 3 + (iz >> 3) + 1]
                        if other < 0:
                            continue
                        row = row_at(block_rows, other, ((ix & 7) << 6) | ((iy & 7) << 3) | (iz & 7))
                        if row < 0:
                            continue
                        for k in range(10):
                            one[k] = 0.0
                        sum_views(moments, links, row, views)
                        add_moved(one, views, np.int64(0), dx * units, dy * units, dz * units)
                        for k in range(10):
                            pool[k] += one[k] / one[0]
            for k in range(7):
                lines[c, k] = 0.0
            if pool[0] < least:
                continue
            line_of(pool, line)
            lines[c, 0] = ((bx << 3) + lx + 0.5) * cell + line[0] * unit
            lines[c, 1] = ((by << 3) + ly + 0.5) * cell + line[1] * unit
            lines[c, 2] = ((bz << 3) + lz + 0.5) * cell + line[2] * unit
            for k in range(3, 7):
                lines[c, k] = line[k]


@kernel
def lines_of_samples(points, reach, count, lines):
    """Fit a line to the points (N, 3) up to `reach` metres from each of the first `count`, (count, 7), metres."""
    pool, line = np.empty(10), np.empty(7)
    for i in range(count):
        for k in range(10):
            pool[k] = 0.0
        for j in range(points.shape[0]):
            x, y, z = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
            if x * x + y * y + z * z > reach * reach:
                continue
            pool[0] += 1.0
            pool[1] += x
            pool[2] += y
            pool[3] += z
            pool[4] += x * x
            pool[5] += x * y
            pool[6] += x * z
            pool[7] += y * y
            pool[8] += y * z
            pool[9] += z * z
        line_of(pool, line)
        for k in range(3):
            lines[i, k] = points[i, k] + line[k]
        for k in range(3, 7):
            lines[i, k] = line[k]


@kernel
def shares_on_scene(
    start, stop, models, model_starts, samples, rotations, translations, cell, where, occupied, masks, nowhere, shares,
):  # fmt: skip
    """The share of a model's samples, placed, that lie in a cell marked with their direction, for poses start … stop.

    See lie_on_scene; nowhere : a table of no block; shares : (H,) out
    """
    inverse, nobody = 1.0 / cell, np.empty((0, 3))
    endless = np.zeros(np.max(model_starts[1:] - model_starts[:-1]) + 1, np.int64)  # no test ends before all are asked
    no_air = np.empty((0, 8), np.uint64)
    rotation, translation = np.empty((3, 3)), np.empty(3)
    for k in range(start, stop):
        for i in range(3):
            translation[i] = translations[k, i]
            for j in range(3):
                rotation[i, j] = rotations[k, i, j]
        first, end = model_starts[models[k]], model_starts[models[k] + 1]
        hits, _ = lie_on_scene(
            samples, first, end, endless, endless, rotation, translation, nobody, inverse, where, occupied, masks, 1.0,
            nowhere, no_air,
        )  # fmt: skip
        shares[k] = hits / max(end - first, 1)
