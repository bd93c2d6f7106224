"""Moments → surfels: the mean and the oriented normal of each cell, one for each side the scanners saw."""

from __future__ import annotations

from math import acos, cos, pi, sqrt

import numpy as np
from numba import njit

from scanfind.kernels.blocks import find_block, pack_block, unpack_block


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def count_cells(start, stop, blocks, rows, counts):
    """Occupied cells of blocks start … stop, into counts (B,).

    blocks : (B,) the blocks in order; rows : (blocks, 512) a row of each cell's moments, -1 for an empty one
    """
    for block in range(start, stop):
        counts[block] = 0
        for local in range(512):
            if rows[blocks[block], local] >= 0:
                counts[block] += 1


@njit(cache=True, nogil=True)
def number_cells(
    start, stop, blocks, rows, first_cell, moments, links, block_cells, cell_locals, cell_rows, totals
):  # fmt: skip
    """Number the cells of blocks start … stop and sum their views.

    block_cells : (B, 512) out: number of each cell, -1 for empty; cell_rows : (V,) out: a row of each cell's moments
    totals : (V, 10) float32 out: n, Σx, Σxxᵀ of each cell, all views together; 40 bytes that the 27 cells around read
    """
    views = np.zeros(10, np.int64)
    for block in range(start, stop):
        cell = first_cell[block]
        for local in range(512):
            row = np.int64(rows[blocks[block], local])
            block_cells[block, local] = -1
            if row < 0:
                continue
            block_cells[block, local] = cell
            cell_locals[cell] = local
            cell_rows[cell] = row
            # Summed as integers first: the views of a cell are chained in the order the points came in.
            views[:] = 0
            while row >= 0:
                for k in range(10):
                    views[k] += moments[row, k]
                row = np.int64(links[row, 1])
            for k in range(10):
                totals[cell, k] = views[k]
            cell += 1


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def plane_of(pool):
    """Normal and eigenvalues of pooled moments."""
    n = pool[0]
    mx, my, mz = pool[1] / n, pool[2] / n, pool[3] / n
    return smallest_eigenvector(
        pool[4] / n - mx * mx, pool[5] / n - mx * my, pool[6] / n - mx * mz,
        pool[7] / n - my * my, pool[8] / n - my * mz, pool[9] / n - mz * mz,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def fit_surfels(
    first_block, last_block, block_keys, hash_keys, hash_values, moments, links, block_cells,
    first_cell, cell_locals, cell_rows, totals, cell, units, min_neighbours,
    n_sides, means, normals, flatness, points,
):  # fmt: skip
    """Fit one or two surfels in every cell of some blocks.

    cell : edge, metres; units : offset units a cell
    min_neighbours : occupied cells of the 3×3×3 a normal needs, the cell itself included
    n_sides : (V,) out: 1, or 2 where the scanners saw both faces of something thin
    means : (V, 3) out, metres from the grid's offset; normals : (V, 3) out, unit, towards the scanner, zero where there
        are too few neighbours; flatness : (V,) out, standard deviation across the pooled plane, metres; points : (V,)
    Returns the second faces, (cells with two, 8): mean, normal, flatness, points, in the order of the cells.
    """
    unit = cell / units
    backs, back_count = np.empty((first_cell[last_block] - first_cell[first_block], 8)), 0
    pool = np.zeros(10)
    side = np.zeros(10)
    around = np.empty(27, np.int64)
    neighbour_cell = np.empty(27, np.int64)
    views = np.zeros((1, 13), np.int64)
    for block in range(first_block, last_block):
        bx, by, bz = unpack_block(block_keys[block])
        for k in range(27):
            key = pack_block(bx + k // 9 - 1, by + k // 3 % 3 - 1, bz + k % 3 - 1)
            around[k] = block if k == 13 else find_block(hash_keys, hash_values, key)
        for c in range(first_cell[block], first_cell[block + 1]):
            local = np.int64(cell_locals[c])
            lx, ly, lz = local >> 6, (local >> 3) & 7, local & 7
            pool[:] = 0.0
            occupied = 0
            for k in range(27):
                ix, iy, iz = lx + k // 9 - 1, ly + k // 3 % 3 - 1, lz + k % 3 - 1
                other = around[((ix >> 3) + 1) * 9 + ((iy >> 3) + 1) * 3 + (iz >> 3) + 1]
                neighbour_cell[k] = -1
                if other >= 0:
                    there = ((ix & 7) << 6) | ((iy & 7) << 3) | (iz & 7)
                    found = block_cells[other, there]
                    neighbour_cell[k] = found
                    if found >= 0:
                        occupied += 1
                        add_moved(
                            pool, totals, found,
                            (k // 9 - 1) * units, (k // 3 % 3 - 1) * units, (k % 3 - 1) * units,
                        )  # fmt: skip
            nx, ny, nz, low, _, _ = plane_of(pool)
            cx, cy, cz = ((bx << 3) + lx + 0.5) * cell, ((by << 3) + ly + 0.5) * cell, ((bz << 3) + lz + 0.5) * cell

            # A thin plate scanned from both sides: its views disagree about the side.
            front = back = dx = dy = dz = np.int64(0)
            row = np.int64(cell_rows[c])
            while row >= 0:
                along = moments[row, 10] * nx + moments[row, 11] * ny + moments[row, 12] * nz
                if along > 0.0:
                    front += moments[row, 0]
                elif along < 0.0:
                    back += moments[row, 0]
                dx += moments[row, 10]
                dy += moments[row, 11]
                dz += moments[row, 12]
                row = np.int64(links[row, 1])
            two = occupied >= min_neighbours and min(front, back) >= max(2.0, 0.1 * totals[c, 0])
            n_sides[c] = 2 if two else 1
            if not two:
                sign = -1.0 if dx * nx + dy * ny + dz * nz < 0.0 else 1.0
                if occupied < min_neighbours:
                    sign = 0.0
                n = totals[c, 0]
                means[c, 0], means[c, 1] = cx + totals[c, 1] / n * unit, cy + totals[c, 2] / n * unit
                means[c, 2] = cz + totals[c, 3] / n * unit
                normals[c, 0], normals[c, 1], normals[c, 2] = sign * nx, sign * ny, sign * nz
                flatness[c], points[c] = sqrt(max(low, 0.0)) * unit, n
                continue
            for s in range(2):
                sign = 1.0 - 2.0 * s
                side[:] = 0.0
                pool[:] = 0.0
                occupied = 0
                dx = dy = dz = np.int64(0)
                for k in range(27):
                    if neighbour_cell[k] < 0:
                        continue
                    views[:, :] = 0
                    row = np.int64(cell_rows[neighbour_cell[k]])
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
                        pool, views, 0, (k // 9 - 1) * units, (k // 3 % 3 - 1) * units, (k % 3 - 1) * units
                    )  # fmt: skip
                    if k == 13:
                        add_moved(side, views, 0, 0.0, 0.0, 0.0)
                mx, my, mz, low = nx, ny, nz, 0.0
                if occupied >= min_neighbours:
                    mx, my, mz, low, _, _ = plane_of(pool)
                flip = -1.0 if dx * mx + dy * my + dz * mz < 0.0 else 1.0
                n, spread = side[0], sqrt(max(low, 0.0)) * unit
                x, y, z = cx + side[1] / n * unit, cy + side[2] / n * unit, cz + side[3] / n * unit
                if s == 0:
                    means[c, 0], means[c, 1], means[c, 2] = x, y, z
                    normals[c, 0], normals[c, 1], normals[c, 2] = flip * mx, flip * my, flip * mz
                    flatness[c], points[c] = spread, n
                else:
                    b = back_count
                    backs[b, 0], backs[b, 1], backs[b, 2] = x, y, z
                    backs[b, 3], backs[b, 4], backs[b, 5] = flip * mx, flip * my, flip * mz
                    backs[b, 6], backs[b, 7] = spread, n
                    back_count += 1
    return backs[:back_count].copy()
