"""Where nothing is: air that beams went through, in cells coarse enough for one look-up to refute a sample.

Four of ten samples of a wrong hypothesis hang in the air, of a right one two of a hundred; that a sample lies on no
surface says far less, since it may be hidden (decisions/0032-in-the-air.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.grid.blocks import block_table, packed, unpacked
from scanfind.threads import in_threads

if TYPE_CHECKING:
    from scanfind.grid.depth import DepthMap
    from scanfind.kernels.blocks import BlockTable

Floats = NDArray[np.float64]

# Blocks of eight cells: so many about what was seen are asked. Farther out no part of a pose that touches it reaches.
BLOCKS_AROUND = 3
COARSEST_PIXELS = 45  # along an edge of the cube maps, 2° a pixel: two metres from a scanner, with cells of 0.1 m


class Air(NamedTuple):
    """Cells that scanners looked through.

    cell : edge, metres; where : the blocks
    cells : (B, 8) uint64, a bit for each of a block's 512 cells
    """

    cell: float
    where: BlockTable
    cells: NDArray[np.uint64]


def no_air() -> Air:
    """Of a scan by nobody knows whom: no place is known to be empty."""
    return Air(1.0, block_table(np.empty(0, np.int64)), np.empty((0, 8), np.uint64))


def air_of(depths: Sequence[DepthMap], seen: Floats, cell: float, jobs: int) -> Air:
    """The air about what was seen.

    depths : maps of what each scanner saw, of one resolution; seen : (N, 3) where something is, relative to the grid's
    offset; cell : metres
    """
    from scanfind.kernels.air import mark_air, unmark_air

    if not depths or not len(seen):
        return no_air()
    keys = blocks_about(seen, 8.0 * cell)
    air = Air(cell, block_table(keys), np.zeros((len(keys), 8), np.uint64))
    origins = np.array([depth.origin for depth in depths])
    edges, starts, ranges = pyramids(depths)
    in_threads(
        jobs, len(keys),
        lambda start, stop: mark_air(start, stop, keys, cell, origins, edges, starts, ranges, air.cells),
    )  # fmt: skip
    unmark_air(seen, cell, air.where, air.cells)
    return air


def pyramids(depths: Sequence[DepthMap]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """Edges of each scanner's maps, finest first, where each begins, and their ranges map after map, (K, P)."""
    maps = [list(depths)]
    while maps[-1][0].edge > COARSEST_PIXELS and maps[-1][0].edge % 2 == 0:
        maps.append([depth.coarser() for depth in maps[-1]])
    edges = np.array([level[0].edge for level in maps], np.int64)
    starts = np.concatenate([[0], np.cumsum(6 * edges[:-1] ** 2)]).astype(np.int64)
    return edges, starts, np.hstack([np.array([depth.ranges for depth in level]) for level in maps])


def blocks_about(points: Floats, edge: float) -> NDArray[np.int64]:
    """Packed coordinates of the blocks of an edge, metres, that points (N, 3) lie in, and of those around them."""
    keys = np.unique(packed(np.floor(points / edge).astype(np.int64)))
    for _ in range(BLOCKS_AROUND):
        for axis in np.eye(3, dtype=np.int64):
            at = unpacked(keys)
            keys = np.unique(packed(np.concatenate([at - axis, at, at + axis])))
    return keys
