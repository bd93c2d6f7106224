"""The streaming pass: raw points in, moments of every cell out, at every level of the octree.

Each cell keeps moments: n, Σx, Σxxᵀ, Σ direction to the scanner. Their means are the paper's weighted octree (3.1),
their pooled covariance its normals by PCA (3.2); moments add, so levels, chunks, files and workers merge.
"""

from __future__ import annotations

from mmap import mmap
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanfind.cloud import PointChunk
from scanfind.depth import DEPTH_PIXELS, DepthMap, joined_until_spoken
from scanfind.threads import side_by_side

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Room to begin with: 134 MB and 470 MB of addresses, of which only what is written becomes memory. From 2^14 and 2^20
# on, doubling took 0.9 s of a pass over 10 M points that needs 0.8 s.
EMPTY_BLOCKS, EMPTY_ROWS = 1 << 16, 1 << 22
POINTS_TO_SETTLE = 1000  # of which the median says where the scan lies


class MomentGrid:
    """Raw points in, moments out. `add` every chunk, in any order; the result does not depend on it.

    cell : edge of a cell, metres; offset : (3,) float64, the grid's origin in the points' frame (`None`: the median of
    the first points, rounded to whole metres, so that coordinates keep their digits however far from zero the scan is).
    jobs : threads

    points : added so far; unaddressable : those too far from the rest to be in a cell
    signed : every chunk said where its scanner stood
    units : offset units a cell
    hash_keys, hash_values : packed block coordinates → block
    block_keys : (blocks,) packed; block_rows : (blocks, 512) a row of each cell's moments, -1 for an empty cell
    moments : (rows, 13) for each cell and view; links : (rows, 2) the row's view, and the cell's next row or -1
    counts : blocks and rows in use; what lies behind them in the arrays is room to grow
    """

    def __init__(self, cell: float, offset: Floats | None = None, jobs: int = 1) -> None:
        from scanfind.kernels.grid import MOMENTS, OFFSET_UNITS

        self.cell = cell
        self.offset = offset
        self.points = 0
        self.unaddressable = 0
        self.signed = True
        self.units = OFFSET_UNITS
        self.hash_keys = np.full(4 * EMPTY_BLOCKS, -1, np.int64)
        self.hash_values = np.zeros(4 * EMPTY_BLOCKS, np.int32)
        self.block_keys = np.empty(EMPTY_BLOCKS, np.int64)
        self.block_rows = room((EMPTY_BLOCKS, 512), np.dtype(np.int32))
        self.moments = room((EMPTY_ROWS, MOMENTS), np.dtype(np.int64))
        self.links = room((EMPTY_ROWS, 2), np.dtype(np.int32))
        self.counts = np.zeros(3, np.int64)
        self._jobs = jobs
        self._held: list[PointChunk] = []
        self._depths: dict[tuple[float, ...], NDArray[np.float32]] = {}

    def add(self, chunk: PointChunk) -> None:
        """Sum a chunk's points into the grid and into the depth map of its scanner."""
        if not len(chunk):
            return
        if self.offset is None:
            self._settle(chunk)
            return
        # Each takes a core: neither touches what the other writes.
        side_by_side(self._jobs, lambda: self._sum(chunk), lambda: self._look(chunk))
        self.points += len(chunk)
        self.unaddressable = int(self.counts[2])

    def _sum(self, chunk: PointChunk) -> None:
        """Add a chunk's points to the moments of their cells."""
        from scanfind.kernels.grid import accumulate

        has_origin = chunk.origin is not None
        self.signed &= has_origin
        origin = np.zeros(3) if chunk.origin is None else np.asarray(chunk.origin, np.float64)
        at = 0
        while True:
            at = accumulate(
                chunk.xyz, at, origin, has_origin, self.offset, self.cell, self.hash_keys, self.hash_values,
                self.block_keys, self.block_rows, self.moments, self.links, self.counts,
            )  # fmt: skip
            if at == len(chunk):
                return
            self._make_room()

    def _look(self, chunk: PointChunk) -> None:
        """Note how far a chunk's scanner saw in each direction."""
        from scanfind.kernels.grid import note_ranges

        if chunk.origin is None or self.offset is None:
            return
        origin = np.asarray(chunk.origin, np.float64)
        key = tuple((origin - self.offset).tolist())
        ranges = self._depths.setdefault(key, np.full(6 * DEPTH_PIXELS**2, np.inf, np.float32))
        note_ranges(chunk.xyz, origin, ranges, DEPTH_PIXELS)

    def _settle(self, chunk: PointChunk) -> None:
        """Hold chunks back until there are enough points to say where the scan lies; then add what was held.

        The median of the first points, not the first: one stray record would put the whole scan out of reach.
        """
        self._held.append(chunk)
        if sum(len(held) for held in self._held) >= POINTS_TO_SETTLE:
            self.release()

    def release(self) -> None:
        """Add the chunks held back, of a scan too small to settle by itself; needed before the sums are read."""
        held, self._held = self._held, []
        if self.offset is None and held:
            first = np.concatenate([chunk.xyz[:POINTS_TO_SETTLE] for chunk in held])[:POINTS_TO_SETTLE]
            self.offset = np.round(np.median(first, axis=0))
        for chunk in held:
            self.add(chunk)

    def _make_room(self) -> None:
        """Double whichever array is full; copied is only what is in use."""
        from scanfind.kernels.blocks import fill_hash
        from scanfind.kernels.grid import ROWS_OF_OCTANT

        if self.counts[0] + 1 > len(self.block_keys):
            self.block_keys = doubled(self.block_keys)
            self.block_rows = doubled(self.block_rows)
            self.hash_keys = np.full(4 * len(self.block_keys), -1, np.int64)
            self.hash_values = np.zeros(len(self.hash_keys), np.int32)
            fill_hash(self.block_keys[: self.counts[0]], self.hash_keys, self.hash_values)
        if self.counts[1] + ROWS_OF_OCTANT > len(self.moments):
            self.moments, self.links = doubled(self.moments), doubled(self.links)

    def points_per_row(self) -> float:
        """Raw points a cell, on average, counting a cell once for each view."""
        self.release()
        return self.points / max(int(self.counts[1]), 1)

    def coarser(self) -> MomentGrid:
        """The next level of the octree: cells of twice the edge, each the sum of its eight children."""
        from scanfind.kernels.grid import sum_children

        self.release()
        parent = MomentGrid(2.0 * self.cell, self.offset, self._jobs)
        parent.points, parent.unaddressable, parent.signed = self.points, self.unaddressable, self.signed
        parent.units = 2.0 * self.units
        parent._depths = self._depths
        blocks = int(self.counts[0])
        at = 0
        while True:
            at = sum_children(
                at, self.block_keys[:blocks], self.block_rows, self.moments, self.links, np.int64(self.units / 2),
                parent.hash_keys, parent.hash_values, parent.block_keys, parent.block_rows, parent.moments,
                parent.links, parent.counts,
            )  # fmt: skip
            if at == blocks:
                return parent
            parent._make_room()

    def depth_maps(self) -> list[DepthMap]:
        """One for each scanner position, in the order of their coordinates."""
        self.release()
        return joined_until_spoken(
            [DepthMap(np.array(key), self._depths[key], DEPTH_PIXELS) for key in sorted(self._depths)]
        )


def room(shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    """An array of zeros that costs memory only where it is written.

    NumPy asks for huge pages, of which one written byte takes 2 MB: on a virtual machine that was a second of a pass.
    """
    return np.frombuffer(mmap(-1, int(np.prod(shape)) * dtype.itemsize), dtype).reshape(shape)


def doubled(array: NDArray[Any]) -> NDArray[Any]:
    """Twice the room along the first axis."""
    larger = room((2 * len(array), *array.shape[1:]), array.dtype)
    larger[: len(array)] = array
    return larger
