"""The surfel a placed model point lies on: the nearest in the cells around it, with a like normal."""

from __future__ import annotations

from math import floor

import numpy as np

from scanfind.kernels.blocks import find_block, pack_block, row_at
from scanfind.kernels.jit import kernel

# A sequence in which each six bits come once (Leiserson, Prokop & Randall 1998), and where they come.
DE_BRUIJN = np.uint64(0x03F79D71B4CB0A89)
PLACES = np.empty(64, np.int64)
PLACES[[(int(DE_BRUIJN) << place & (1 << 64) - 1) >> 58 for place in range(64)]] = np.arange(64)


@kernel
def nearest_surfel(
    x, y, z, nx, ny, nz, gate, least_cosine, signed,
    cell, hash_keys, hash_values, filled, block_rows, first_surfel, sides, means, normals,
):  # fmt: skip
    """The nearest surfel within `gate` metres whose normal agrees, -1 where there is none.

    least_cosine : of the angle between normals; by magnitude where the scene's normals are not signed
    filled : (B, 8) uint64, see Cells: most samples of a wrong pose lie in the empty, and end in a word or two
    """
    inverse = 1.0 / cell
    reach = gate * inverse
    x0, x1 = np.int64(floor(x * inverse - reach)), np.int64(floor(x * inverse + reach))
    y0, y1 = np.int64(floor(y * inverse - reach)), np.int64(floor(y * inverse + reach))
    z0, z1 = np.int64(floor(z * inverse - reach)), np.int64(floor(z * inverse + reach))
    best, nearest = np.int64(-1), gate * gate
    for bx in range(x0 >> 3, (x1 >> 3) + 1):
        for by in range(y0 >> 3, (y1 >> 3) + 1):
            for bz in range(z0 >> 3, (z1 >> 3) + 1):
                block = find_block(hash_keys, hash_values, pack_block(bx, by, bz))
                if block < 0:
                    continue
                first_y, last_y = max(y0 - (by << 3), 0), min(y1 - (by << 3), 7)
                first_z, last_z = max(z0 - (bz << 3), 0), min(z1 - (bz << 3), 7)
                word = square(first_y, last_y, first_z, last_z)
                for lx in range(max(x0 - (bx << 3), 0), min(x1 - (bx << 3), 7) + 1):
                    there = filled[block, lx] & word
                    while there != 0:
                        others = there & (there - np.uint64(1))
                        row = row_at(block_rows, block, (lx << 6) | place_of(there ^ others))
                        there = others
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


@kernel
def place_of(bit):
    """Which of 64 bits it is that is set: each of them shifts another six bits to the top."""
    return PLACES[(bit * DE_BRUIJN) >> np.uint64(58)]


@kernel
def square(first_y, last_y, first_z, last_z):
    """The bits, of the word of one layer of a block, of the cells from first_y … last_y and first_z … last_z."""
    run = ((np.uint64(1) << np.uint64(last_z - first_z + 1)) - np.uint64(1)) << np.uint64(first_z)
    word = np.uint64(0)
    for ly in range(first_y, last_y + 1):
        word |= run << np.uint64(8 * ly)
    return word


@kernel
def mark_around(points, reach, cell, hash_keys, hash_values, layers):
    """Mark the cells up to `reach` cells, at most 8, from those points (N, 3) lie in.

    layers : (B, 8) uint64, in place: a bit for each cell of a block, eight words of eight by eight. A cube of cells is
        a few words of a few blocks: ten times faster than cell by cell.
    """
    inverse = 1.0 / cell
    last = np.empty(3, np.int64)
    for i in range(points.shape[0]):
        x, y, z = floor(points[i, 0] * inverse), floor(points[i, 1] * inverse), floor(points[i, 2] * inverse)
        if i > 0 and x == last[0] and y == last[1] and z == last[2]:
            continue
        last[0], last[1], last[2] = x, y, z
        for bx in range((x - reach) >> 3, ((x + reach) >> 3) + 1):
            for by in range((y - reach) >> 3, ((y + reach) >> 3) + 1):
                for bz in range((z - reach) >> 3, ((z + reach) >> 3) + 1):
                    block = find_block(hash_keys, hash_values, pack_block(bx, by, bz))
                    if block < 0:
                        continue
                    word = square(
                        max(y - reach - (by << 3), 0), min(y + reach - (by << 3), 7),
                        max(z - reach - (bz << 3), 0), min(z + reach - (bz << 3), 7),
                    )  # fmt: skip
                    for lx in range(max(x - reach - (bx << 3), 0), min(x + reach - (bx << 3), 7) + 1):
                        layers[block, lx] |= word


@kernel
def mark_rows(blocks, layers, block_rows, marked):
    """Mark the rows (bool, in place) of the occupied ones of the cells marked in some blocks."""
    for block in blocks:
        for lx in range(8):
            word = layers[block, lx]
            if word == 0:
                continue
            for place in range(64):
                if (word >> np.uint64(place)) & np.uint64(1):
                    row = row_at(block_rows, block, (lx << 6) | place)
                    if row >= 0:
                        marked[row] = True
