"""Addresses of cells: blocks of 8×8×8 cells found through an open-addressing hash of their packed coordinates.

A hash rather than a dense table over the site's bounds: a stray point 5,000 km away costs one block, not a table of
10^20 entries, and no site is too large to address (see decisions/0002-hashed-blocks.md).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.kernels.jit import kernel

BIAS = 1 << 19  # block coordinates are packed as 20 bits an axis: ± 524,288 blocks, ± 84 km with cells of 2 cm
EMPTY = np.int64(-1)


@kernel
def pack_block(bx, by, bz):
    """One int64, never negative, for a block's coordinates."""
    return ((np.int64(bx) + BIAS) << 40) | ((np.int64(by) + BIAS) << 20) | (np.int64(bz) + BIAS)


@kernel
def unpack_block(key):
    """The block coordinates `pack_block` was given."""
    return (key >> 40) - BIAS, ((key >> 20) & 0xFFFFF) - BIAS, (key & 0xFFFFF) - BIAS


@kernel
def hash_slot(key, mask):
    """Where the search for a key starts (Fibonacci hashing; the high bits are the well-mixed ones)."""
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    return np.int64((mixed >> np.uint64(24)) & np.uint64(mask))


@kernel
def find_block(keys, values, key):
    """The value stored for a key, -1 where there is none."""
    mask = keys.shape[0] - 1
    slot = hash_slot(key, mask)
    while True:
        here = keys[slot]
        if here == key:
            return np.int64(values[slot])
        if here == EMPTY:
            return np.int64(-1)
        slot = (slot + 1) & mask


@kernel
def insert_block(keys, values, key, value):
    """Store a value for a key that is not there yet; the table must have room."""
    mask = keys.shape[0] - 1
    slot = hash_slot(key, mask)
    while keys[slot] != EMPTY:
        slot = (slot + 1) & mask
    keys[slot] = key
    values[slot] = value


@kernel
def fill_hash(block_keys, blocks, keys, values):
    """Store b for block_keys[b], b in blocks; `keys` must come filled with EMPTY and be at least twice as long."""
    for block in blocks:
        insert_block(keys, values, block_keys[block], block)


class BlockRows(NamedTuple):
    """The row of each cell of each block. A block is eight octants of 4×4×4 cells, and only what has a point has room:
    where points lie farther apart than blocks are wide, one for each cell of a block was 2 kB a point.

    octants : (B, 8) int32, where the cells of each octant are, -1 where it has none
    cells : (O, 64) int32, the row of each, -1 for an empty one
    """

    octants: NDArray[np.int32]
    cells: NDArray[np.int32]

    def of(self, blocks: NDArray[np.integer]) -> NDArray[np.int32]:
        """The rows of all cells of some blocks, (K, 512), by their place in the block; -1 for an empty one."""
        octants = self.octants[blocks]
        rows = np.where(octants[..., None] < 0, np.int32(-1), self.cells[octants])
        # Which half and which quarter along each axis, one beside the other, are the place along it.
        return rows.reshape(-1, 2, 2, 2, 4, 4, 4).transpose(0, 1, 4, 2, 5, 3, 6).reshape(-1, 512)


@kernel
def octant_of(local):
    """Which of its block's octants a cell lies in, and where in that."""
    octant = ((local >> 6) & 4) | ((local >> 4) & 2) | ((local >> 2) & 1)
    return octant, ((local >> 2) & 0x30) | ((local >> 1) & 0xC) | (local & 3)


@kernel
def row_at(rows, block, local):
    """The row of a cell of a block, -1 where it is empty; rows : BlockRows."""
    octant, place = octant_of(local)
    where = rows.octants[block, octant]
    if where < 0:
        return np.int64(-1)
    return np.int64(rows.cells[where, place])


class BlockTable(NamedTuple):
    """Where the blocks of a sparse grid are: in a dense table of the box they lie in, for one that is looked up a lot.

    low, shape : (3,) int64 the box, in blocks
    places : (X·Y·Z,) int32, the number of each block in it, -1 where there is none; empty where the box is too large
    hash_keys, hash_values : packed block coordinates → the same number
    """

    low: NDArray[np.int64]
    shape: NDArray[np.int64]
    places: NDArray[np.int32]
    hash_keys: NDArray[np.int64]
    hash_values: NDArray[np.int32]


@kernel
def block_in(where, bx, by, bz):
    """The number of a block in a BlockTable, -1 where there is none."""
    if len(where.places) == 0:
        return find_block(where.hash_keys, where.hash_values, pack_block(bx, by, bz))
    x, y, z = bx - where.low[0], by - where.low[1], bz - where.low[2]
    if x < 0 or y < 0 or z < 0 or x >= where.shape[0] or y >= where.shape[1] or z >= where.shape[2]:
        return np.int64(-1)
    return np.int64(where.places[(x * where.shape[1] + y) * where.shape[2] + z])
