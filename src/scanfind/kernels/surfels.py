"""Moments → surfels: the mean and the oriented normal of each cell, one for each side the scanners saw."""

from __future__ import annotations

from math import acos, cos, pi, sqrt

import numpy as np

from scanfind.kernels.blocks import find_block, octant_of, pack_block, row_at, unpack_block
from scanfind.kernels.jit import kernel


@kernel
def smallest_eigenvector(a00, a01, a02, a11, a12, a22):
    """Unit eigenvector of the smallest eigenvalue of a symmetric 3×3 matrix, and the three eigenvalues, ascending.

    Trigonometric solution of the characteristic cubic; the vector is the largest cross product of two rows of
    A - λI, which is accurate whenever λ is simple. A multiple of the identity gives z.
    """
    mean = (a00 + a11 + a22) / 3.0
    b00, b11, b22 = a00 - mean, a11 - mean, a22 - mean
    p = (b00 * b00 + b11 * b11 + b22 * b22 + 2.0 * (a01 * a01 + a02 * a02 + a12 * a12)) / 6.0
    if p <= 1e-30 * mean * mean + 1e-300:
        return 0.0, 0.0, 1.0, mean, mean, mean
    p = sqrt(p)
    determinant = (b00 * (b11 * b22 - a12 * a12) - a01 * (a01 * b22 - a12 * a02) + a02 * (a01 * a12 - b11 * a02)) / (
        2.0 * p * p * p
    )
    phi = acos(min(1.0, max(-1.0, determinant))) / 3.0
    high = mean + 2.0 * p * cos(phi)
    low = mean + 2.0 * p * cos(phi + 2.0 * pi / 3.0)
    c00, c11, c22 = a00 - low, a11 - low, a22 - low
    x1, y1, z1 = a01 * a12 - a02 * c11, a02 * a01 - c00 * a12, c00 * c11 - a01 * a01
    x2, y2, z2 = a01 * c22 - a02 * a12, a02 * a02 - c00 * c22, c00 * a12 - a01 * a02
    x3, y3, z3 = c11 * c22 - a12 * a12, a12 * a02 - a01 * c22, a01 * a12 - c11 * a02
    n1, n2, n3 = x1 * x1 + y1 * y1 + z1 * z1, x2 * x2 + y2 * y2 + z2 * z2, x3 * x3 + y3 * y3 + z3 * z3
    if n1 >= n2 and n1 >= n3:
        x, y, z, n = x1, y1, z1, n1
    elif n2 >= n3:
        x, y, z, n = x2, y2, z2, n2
    else:
        x, y, z, n = x3, y3, z3, n3
    if n <= 1e-300:
        return 0.0, 0.0, 1.0, low, 3.0 * mean - low - high, high
    n = sqrt(n)
    return x / n, y / n, z / n, low, 3.0 * mean - low - high, high


@kernel
def count_cells(start, stop, order, block_rows, counts):
    """Occupied cells of blocks order[start:stop], into counts (B,)."""
    for block in range(start, stop):
        counts[block] = 0
        for octant in block_rows.octants[order[block]]:
            if octant >= 0:
                counts[block] += (block_rows.cells[octant] >= 0).sum()


@kernel
def number_cells(start, stop, order, block_rows, first_cell, cell_locals, cell_rows, filled):
    """Note the place and the row of each cell of blocks order[start:stop], block `k` of them from first_cell[k] on, and
    its bit in filled (B, 8).
    """
    for block in range(start, stop):
        cell = first_cell[block]
        for start_of_run in range(0, 512, 4):
            octant, place = octant_of(start_of_run)
            where = block_rows.octants[order[block], octant]
            if where < 0:
                continue
            for k in range(4):
                row = block_rows.cells[where, place + k]
                if row >= 0:
                    local = start_of_run + k
                    cell_locals[cell], cell_rows[cell] = local, row
                    filled[order[block], local >> 6] |= np.uint64(1) << np.uint64(local & 63)
                    cell += 1


@kernel
def sum_views(moments, links, row, views):
    """Sum a cell's rows, from `row` on, into views (1, 13).

    As integers: the views of a cell are chained in the order the points came in, on which nothing may depend.
    """
    for k in range(13):
        views[0, k] = 0
    while row >= 0:
        for k in range(13):
            views[0, k] += moments[row, k]
        row = np.int64(links[row, 1])


@kernel
def add_moved(pool, table, row, ex, ey, ez):
    """Add a row of moments, about a cell centre at offset e, to the pool about its own centre (offset units)."""
    n, sx, sy, sz = float(table[row, 0]), float(table[row, 1]), float(table[row, 2]), float(table[row, 3])
    pool[0] += n
    pool[1] += sx + n * ex
    pool[2] += sy + n * ey
    pool[3] += sz + n * ez
    pool[4] += table[row, 4] + 2.0 * ex * sx + n * ex * ex
    pool[5] += table[row, 5] + ex * sy + ey * sx + n * ex * ey
    pool[6] += table[row, 6] + ex * sz + ez * sx + n * ex * ez
    pool[7] += table[row, 7] + 2.0 * ey * sy + n * ey * ey
    pool[8] += table[row, 8] + ey * sz + ez * sy + n * ey * ez
    pool[9] += table[row, 9] + 2.0 * ez * sz + n * ez * ez


@kernel
def plane_of(pool):
    """Normal and eigenvalues of pooled moments."""
    n = pool[0]
    mx, my, mz = pool[1] / n, pool[2] / n, pool[3] / n
    return smallest_eigenvector(
        pool[4] / n - mx * mx, pool[5] / n - mx * my, pool[6] / n - mx * mz,
        pool[7] / n - my * my, pool[8] / n - my * mz, pool[9] / n - mz * mz,
    )  # fmt: skip


@kernel
def fit_cells(
    start, stop, some, rank, first_cell, cell_locals, cell_rows, order, block_keys, hash_keys, hash_values, block_rows,
    moments, links, cell, units, min_neighbours, n_sides,
):  # fmt: skip
    """Fit one or two surfels in each of the cells some[start:stop], numbers in ascending order.

    rank : of the block, in the order of cells, that the first of them is in
    first_cell, cell_locals, cell_rows : see Cells; order : the blocks in which cells are numbered
    cell : edge, metres; units : offset units a cell
    min_neighbours : occupied cells of the 3×3×3 a normal needs, the cell itself included
    n_sides : (len(some),) out: 1, or 2 where the scanners saw both faces of something thin
    Returns the surfels, (S, 8), in the order of the cells: mean, metres from the grid's offset; normal, unit, towards
    the scanner, zero where there are too few neighbours; standard deviation across the pooled plane, metres; points.
    """
    unit = cell / units
    faces, count = np.empty((2 * (stop - start), 8)), 0
    pool, side = np.empty(10), np.empty(10)
    around = np.empty(27, np.int64)
    neighbours = np.empty(27, np.int64)
    views = np.empty((1, 13), np.int64)
    last = np.int64(-1)
    bx = by = bz = np.int64(0)
    for at in range(start, stop):
        c = some[at]
        while first_cell[rank + 1] <= c:
            rank += 1
        if rank != last:
            last = rank
            bx, by, bz = unpack_block(block_keys[order[rank]])
            for k in range(27):
                key = pack_block(bx + k // 9 - 1, by + k // 3 % 3 - 1, bz + k % 3 - 1)
                around[k] = find_block(hash_keys, hash_values, key)
        local = np.int64(cell_locals[c])
        lx, ly, lz = local >> 6, (local >> 3) & 7, local & 7
        for k in range(10):
            pool[k] = 0.0
        occupied = 0
        for k in range(27):
            ix, iy, iz = lx + k // 9 - 1, ly + k // 3 % 3 - 1, lz + k % 3 - 1
            other = around[((ix >> 3) + 1) * 9 + ((iy >> 3) + 1) * 3 + (iz >> 3) + 1]
            neighbours[k] = -1
            if other < 0:
                continue
            row = row_at(block_rows, other, ((ix & 7) << 6) | ((iy & 7) << 3) | (iz & 7))
            if row < 0:
                continue
            neighbours[k] = row
            occupied += 1
            ex, ey, ez = (k // 9 - 1) * units, (k // 3 % 3 - 1) * units, (k % 3 - 1) * units
            if links[row, 1] < 0:
                add_moved(pool, moments, row, ex, ey, ez)
            else:
                sum_views(moments, links, row, views)
                add_moved(pool, views, np.int64(0), ex, ey, ez)
        nx, ny, nz, low, _, _ = plane_of(pool)
        cx, cy, cz = ((bx << 3) + lx + 0.5) * cell, ((by << 3) + ly + 0.5) * cell, ((bz << 3) + lz + 0.5) * cell

        # A thin plate scanned from both sides: its views disagree about the side.
        front = back = np.int64(0)
        row = np.int64(cell_rows[c])
        while row >= 0:
            along = moments[row, 10] * nx + moments[row, 11] * ny + moments[row, 12] * nz
            if along > 0.0:
                front += moments[row, 0]
            elif along < 0.0:
                back += moments[row, 0]
            row = np.int64(links[row, 1])
        sum_views(moments, links, np.int64(cell_rows[c]), views)
        n = float(views[0, 0])
        two = occupied >= min_neighbours and min(front, back) >= max(2.0, 0.1 * n)
        n_sides[at] = 2 if two else 1
        if not two:
            sign = -1.0 if views[0, 10] * nx + views[0, 11] * ny + views[0, 12] * nz < 0.0 else 1.0
            if occupied < min_neighbours:
                sign = 0.0
            faces[count, 0], faces[count, 1] = cx + views[0, 1] / n * unit, cy + views[0, 2] / n * unit
            faces[count, 2] = cz + views[0, 3] / n * unit
            faces[count, 3], faces[count, 4], faces[count, 5] = sign * nx, sign * ny, sign * nz
            faces[count, 6], faces[count, 7] = sqrt(max(low, 0.0)) * unit, n
            count += 1
            continue
        for s in range(2):
            sign = 1.0 - 2.0 * s
            for k in range(10):
                pool[k] = side[k] = 0.0
            occupied = 0
            dx = dy = dz = np.int64(0)
            for k in range(27):
                for j in range(13):
                    views[0, j] = 0
                row = neighbours[k]
                while row >= 0:
                    along = moments[row, 10] * nx + moments[row, 11] * ny + moments[row, 12] * nz
                    if along * sign > 0.0:
                        for j in range(13):
                            views[0, j] += moments[row, j]
                    row = np.int64(links[row, 1])
                if views[0, 0] == 0:
                    continue
                occupied += 1
                dx += views[0, 10]
                dy += views[0, 11]
                dz += views[0, 12]
                add_moved(
                    pool, views, np.int64(0), (k // 9 - 1) * units, (k // 3 % 3 - 1) * units, (k % 3 - 1) * units
                )  # fmt: skip
                if k == 13:
                    add_moved(side, views, np.int64(0), 0.0, 0.0, 0.0)
            mx, my, mz, low = nx, ny, nz, 0.0
            if occupied >= min_neighbours:
                mx, my, mz, low, _, _ = plane_of(pool)
            flip = -1.0 if dx * mx + dy * my + dz * mz < 0.0 else 1.0
            n = side[0]
            faces[count, 0], faces[count, 1] = cx + side[1] / n * unit, cy + side[2] / n * unit
            faces[count, 2] = cz + side[3] / n * unit
            faces[count, 3], faces[count, 4], faces[count, 5] = flip * mx, flip * my, flip * mz
            faces[count, 6], faces[count, 7] = sqrt(max(low, 0.0)) * unit, n
            count += 1
    return faces[:count]
