"""Tables of blocks: see kernels.blocks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.grid.moments import empty_hash

if TYPE_CHECKING:
    from scanfind.kernels.blocks import BlockTable

# Of a box of more blocks than this (64 MB) each is looked up by hash, which takes twice as long: one stray point far
# away must not cost a table of all that lies between.
MOST_PLACES = 1 << 24


def block_table(keys: NDArray[np.int64], most: int = MOST_PLACES) -> BlockTable:
    """The table of some blocks, numbered in the order of their packed coordinates (B,)."""
    from scanfind.kernels.blocks import BIAS, BlockTable, fill_hash

    hash_keys, hash_values = empty_hash(len(keys))
    fill_hash(keys, np.arange(len(keys)), hash_keys, hash_values)
    at = unpacked(keys)
    low = at.min(axis=0, initial=BIAS)
    shape = np.maximum(at.max(axis=0, initial=-BIAS) - low + 1, 0)
    places = np.full(int(shape.prod()) if float(shape.astype(float).prod()) <= most else 0, -1, np.int32)
    if len(places):
        places[np.ravel_multi_index(tuple((at - low).T), tuple(shape))] = np.arange(len(keys))
    return BlockTable(low, shape, places, hash_keys, hash_values)


def packed(at: NDArray[np.int64]) -> NDArray[np.int64]:
    """Packed coordinates (N,) of blocks (N, 3), see kernels.blocks.pack_block."""
    from scanfind.kernels.blocks import BIAS

    x, y, z = at.T + BIAS
    return np.asarray((x << 40) | (y << 20) | z)


def unpacked(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """The coordinates (N, 3) of packed blocks (N,)."""
    from scanfind.kernels.blocks import BIAS

    return np.stack([keys >> 40, (keys >> 20) & 0xFFFFF, keys & 0xFFFFF], axis=1) - BIAS
