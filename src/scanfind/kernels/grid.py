"""The streaming pass: raw points → integer moments a cell and a view direction, and the nearest range a view direction.

Sums are integers (offsets in 1/65536 of a cell), so they do not depend on the order of addition: chunks, threads,
files and workers may add in any order and the result is the same to the last bit.
"""

from __future__ import annotations

from math import floor, sqrt

import numpy as np
from numba import njit

from scanfind.kernels.blocks import BIAS, find_block, insert_block, pack_block, unpack_block

MOMENTS = 13  # n, Σx Σy Σz, Σxx Σxy Σxz Σyy Σyz Σzz, Σ direction to the scanner (3)
OFFSET_UNITS = 65536.0  # offsets within a cell are counted in 1/65536 of its edge: 0.3 µm in a cell of 2 cm
DIRECTION_UNITS = 1048576.0
FARTHEST = 1e6  # metres: no scanner looks so far; some exporters write 1e38 for "no data"
ROWS_OF_OCTANT = 64 * 54  # 64 cells, each seen in every one of the bins below
VIEW_BINS = 3  # a view direction is one of 6 cube faces × 3 × 3: two in one bin are less than 35° apart


@njit(cache=True, nogil=True)
def cube_pixel(x, y, z, edge):
    """The pixel of a cube map of 6 × edge × edge a direction (any length but 0) falls into."""
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        face, major, u, v = (0 if x > 0 else 1), ax, y, z
    elif ay >= az:
        face, major, u, v = (2 if y > 0 else 3), ay, x, z
    else:
        face, major, u, v = (4 if z > 0 else 5), az, x, y
    iu = min(edge - 1, int((u / major + 1.0) * 0.5 * edge))
    iv = min(edge - 1, int((v / major + 1.0) * 0.5 * edge))
    return (face * edge + iu) * edge + iv


@njit(cache=True, nogil=True)
def row_of_view(block_cells, links, block, local, view):
    """The row of a cell's moments that holds a view, -1 where there is none yet. Few cells have more than three."""
    row = np.int64(block_cells[block, local])
    while row >= 0 and links[row, 0] != view:
        row = np.int64(links[row, 1])
    return row


@njit(cache=True, nogil=True)
def add_row(block_cells, links, moments, counts, block, local, view):
    """A new, empty row for a view of a cell, first in the cell's chain; there must be room."""
    row = counts[1]
    counts[1] += 1
    links[row, 0], links[row, 1] = view, block_cells[block, local]
    block_cells[block, local] = row
    moments[row, :] = 0
    return row


@njit(cache=True, nogil=True)
def add_child(parents, p, children, c, ex, ey, ez):
    """Add a child's row of moments, about a centre at offset e, to its parent's row."""
    n, sx, sy, sz = children[c, 0], children[c, 1], children[c, 2], children[c, 3]
    parents[p, 0] += n
    parents[p, 1] += sx + n * ex
    parents[p, 2] += sy + n * ey
    parents[p, 3] += sz + n * ez
    parents[p, 4] += children[c, 4] + 2 * ex * sx + n * ex * ex
    parents[p, 5] += children[c, 5] + ex * sy + ey * sx + n * ex * ey
    parents[p, 6] += children[c, 6] + ex * sz + ez * sx + n * ex * ez
    parents[p, 7] += children[c, 7] + 2 * ey * sy + n * ey * ey
    parents[p, 8] += children[c, 8] + ey * sz + ez * sy + n * ey * ez
    parents[p, 9] += children[c, 9] + 2 * ez * sz + n * ez * ez
    for k in range(10, 13):
        parents[p, k] += children[c, k]


@njit(cache=True, nogil=True)
def accumulate(
    points, start, origin, has_origin, offset, cell,
    hash_keys, hash_values, block_keys, block_cells, moments, links, counts,
):  # fmt: skip
    """Add points[start:] to the grid; returns how far it came: len(points), or less where an array is full.

    offset : (3,) the grid's own origin, the points' frame
    hash_keys, hash_values : open addressing, power of two
    block_keys : (B,) packed; block_cells : (B, 512) a row of each cell's moments, -1 for an empty cell
    moments : (R, 13) one row for each cell and view; links : (R, 2) the row's view, and the cell's next row or -1
    counts : [blocks used, rows used, points too far away to be addressed]
    """
    inverse = 1.0 / cell
    n = points.shape[0]
    last_key = np.int64(-1)
    last_block = np.int64(-1)
    view = np.int64(0)
    dx = dy = dz = 0.0
    for i in range(start, n):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        gx, gy, gz = (px - offset[0]) * inverse, (py - offset[1]) * inverse, (pz - offset[2]) * inverse
        # Before floor, which makes an int64 of it: the 1e38 some exporters write for "no data" would wrap round.
        if not (abs(gx) < 8 * (BIAS - 2) and abs(gy) < 8 * (BIAS - 2) and abs(gz) < 8 * (BIAS - 2)):
            counts[2] += 1
            continue
        fx, fy, fz = floor(gx), floor(gy), floor(gz)
        cx, cy, cz = np.int64(fx), np.int64(fy), np.int64(fz)
        if has_origin:
            dx, dy, dz = origin[0] - px, origin[1] - py, origin[2] - pz
            view = cube_pixel(dx, dy, dz, VIEW_BINS) if dx != 0.0 or dy != 0.0 or dz != 0.0 else 0
        key = pack_block(cx >> 3, cy >> 3, cz >> 3)
        if key != last_key:
            last_block = find_block(hash_keys, hash_values, key)
            if last_block < 0:
                if counts[0] == block_keys.shape[0]:
                    return i
                last_block = counts[0]
                block_keys[last_block] = key
                block_cells[last_block, :] = -1
                insert_block(hash_keys, hash_values, key, last_block)
                counts[0] += 1
            last_key = key
        local = ((cx & 7) << 6) | ((cy & 7) << 3) | (cz & 7)
        row = row_of_view(block_cells, links, last_block, local, view)
        if row < 0:
            if counts[1] == moments.shape[0]:
                return i
            row = add_row(block_cells, links, moments, counts, last_block, local, view)
        ox = np.int64(floor((gx - fx - 0.5) * OFFSET_UNITS + 0.5))
        oy = np.int64(floor((gy - fy - 0.5) * OFFSET_UNITS + 0.5))
        oz = np.int64(floor((gz - fz - 0.5) * OFFSET_UNITS + 0.5))
        m = moments[row]
        m[0] += 1
        m[1] += ox
        m[2] += oy
        m[3] += oz
        m[4] += ox * ox
        m[5] += ox * oy
        m[6] += ox * oz
        m[7] += oy * oy
        m[8] += oy * oz
        m[9] += oz * oz
        if has_origin:
            distance = sqrt(dx * dx + dy * dy + dz * dz)
            if distance > 0.0:
                scale = DIRECTION_UNITS / distance
                m[10] += np.int64(dx * scale)
                m[11] += np.int64(dy * scale)
                m[12] += np.int64(dz * scale)
    return n


@njit(cache=True, nogil=True)
def note_ranges(points, origin, depth, edge):
    """Keep the nearest range in each direction from a scanner; depth : (6·edge²,) metres, inf where there is none."""
    for i in range(points.shape[0]):
        dx, dy, dz = points[i, 0] - origin[0], points[i, 1] - origin[1], points[i, 2] - origin[2]
        distance = sqrt(dx * dx + dy * dy + dz * dz)
        if 0.0 < distance < FARTHEST:
            pixel = cube_pixel(dx, dy, dz, edge)
            depth[pixel] = min(depth[pixel], np.float32(distance))


@njit(cache=True, nogil=True)
def sum_children(
    start, child_keys, child_cells, child_moments, child_links, half,
    hash_keys, hash_values, block_keys, block_cells, moments, links, counts,
):  # fmt: skip
    """Sum cells into cells of twice the edge, from child block `start` on; returns how far it came (see accumulate).

    half : half a child's edge in offset units: a child's centre lies so far from its parent's, along each axis
    """
    for child in range(start, child_keys.shape[0]):
        # A child block fills one octant of its parent: at most one new block, and 64 new cells with all their views.
        if counts[0] + 1 > block_keys.shape[0] or counts[1] + ROWS_OF_OCTANT > moments.shape[0]:
            return child
        bx, by, bz = unpack_block(child_keys[child])
        key = pack_block(bx >> 1, by >> 1, bz >> 1)
        block = find_block(hash_keys, hash_values, key)
        if block < 0:
            block = counts[0]
            block_keys[block] = key
            block_cells[block, :] = -1
            insert_block(hash_keys, hash_values, key, block)
            counts[0] += 1
        for local in range(512):
            child_row = np.int64(child_cells[child, local])
            if child_row < 0:
                continue
            lx, ly, lz = local >> 6, (local >> 3) & 7, local & 7
            px, py, pz = ((bx & 1) << 2) | (lx >> 1), ((by & 1) << 2) | (ly >> 1), ((bz & 1) << 2) | (lz >> 1)
            parent = (px << 6) | (py << 3) | pz
            ex = half if lx & 1 else -half
            ey = half if ly & 1 else -half
            ez = half if lz & 1 else -half
            while child_row >= 0:
                view = np.int64(child_links[child_row, 0])
                row = row_of_view(block_cells, links, block, parent, view)
                if row < 0:
                    row = add_row(block_cells, links, moments, counts, block, parent, view)
                add_child(moments, row, child_moments, child_row, ex, ey, ez)
                child_row = np.int64(child_links[child_row, 1])
    return child_keys.shape[0]
