"""The surfel grid: one streaming pass over the raw points answers everything the method asks of a scene.

Each cell keeps moments: n, Σx, Σxxᵀ, Σ direction to the scanner. Their means are the paper's weighted octree (3.1),
their pooled covariance its normals by PCA (3.2); moments add, so levels, chunks, files and workers merge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.cloud import PointChunk
from scanfind.errors import require

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

DEPTH_PIXELS = 360  # along an edge of the cube map: 0.25° a pixel, 35 mm at 8 m
# Where a scan has fewer beams than pixels, pixels are joined until most of what was looked at has a range.
MOST_HOLES, LEAST_DEPTH_PIXELS = 0.15, 45
# Room to begin with: 134 MB and 470 MB of addresses, of which only what is written becomes memory. From 2^14 and 2^20
# on, doubling took 0.9 s of a pass over 10 M points that needs 0.8 s.
EMPTY_BLOCKS, EMPTY_ROWS = 1 << 16, 1 << 22
POINTS_TO_SETTLE = 1000  # of which the median says where the scan lies


@dataclass(frozen=True)
class GridParameters:
    """How the scene is resampled.

    cell_m : edge of a cell, metres; None: `cells_across` of them along the smallest model's diameter, made larger
        until the scan fills them
    cells_across : how many cells the diameter of the smallest model spans; 180 makes 20 mm of a 3.6 m spool
    least_cells_across : never fewer, however sparse the scan
    points_per_cell : a cell must hold so many points on average, or cells are doubled; fewer make poor normals
    min_neighbours : occupied cells of the 3×3×3 (itself included) below which a cell has no normal, only presence
    """

    cell_m: float | None = None
    cells_across: float = 180.0
    least_cells_across: float = 30.0
    points_per_cell: float = 1.25
    min_neighbours: int = 5

    def __post_init__(self) -> None:
        require(self.cell_m is None or 0.0 < self.cell_m < 100.0, "cell_m", self.cell_m, "a length up to 100 metres")
        require(self.least_cells_across >= 1.0, "least_cells_across", self.least_cells_across, "1 or more")
        require(
            self.cells_across >= self.least_cells_across, "cells_across", self.cells_across, "no less than the least"
        )
        require(self.points_per_cell >= 0.0, "points_per_cell", self.points_per_cell, "0 or more")
        require(1 <= self.min_neighbours <= 27, "min_neighbours", self.min_neighbours, "from 1 to 27")


class Surfels(NamedTuple):
    """A scene as oriented points in an addressable grid; V cells, S ≥ V surfels, B blocks of 8×8×8 cells.

    cell : edge, metres
    offset : (3,) the grid's origin in the scan's frame; everything below is relative to it
    hash_keys, hash_values : packed block coordinates → block
    block_keys : (B,) ascending; block_cells : (B, 512) int32, number of each cell, -1 for an empty one
    first_surfel : (V+1,) the surfels of each cell: one, or two where scanners saw both faces of something thin
    means : (S, 3) float64; normals : (S, 3) float64, unit, zero where a cell has too few neighbours
    flatness : (S,) standard deviation across the plane fitted to the 3×3×3, metres
    points : (S,) raw points in each
    signed : the normals point to the scanner; False where nobody knows their side
    """

    cell: float
    offset: Floats
    hash_keys: Ints
    hash_values: NDArray[np.int32]
    block_keys: Ints
    block_cells: NDArray[np.int32]
    first_surfel: NDArray[np.int32]
    means: Floats
    normals: Floats
    flatness: Floats
    points: Floats
    signed: bool

    def has_normal(self) -> NDArray[np.bool_]:
        """Which surfels have a normal, (S,)."""
        x, y, z = self.normals.T
        return np.asarray((x != 0.0) | (y != 0.0) | (z != 0.0))


class DepthMap(NamedTuple):
    """The nearest surface seen from one scanner position in each direction.

    origin : (3,) relative to the grid's offset
    ranges : (6 · edge²,) float32, metres, cube map (see kernels.grid.cube_pixel); inf where no beam came back
    """

    origin: Floats
    ranges: NDArray[np.float32]
    edge: int

    def coarser(self) -> DepthMap:
        """Pixels of twice the edge, each the nearest of its four."""
        half = self.edge // 2
        pixels = self.ranges.reshape(6, half, 2, half, 2)
        return DepthMap(self.origin, pixels.min(axis=(2, 4)).reshape(-1), half)

    def holes(self) -> float:
        """Share of empty pixels among the four of each coarser pixel that saw anything: 3/4 where beams are sparse."""
        filled = float(np.isfinite(self.ranges).sum())
        around = 4.0 * float(np.isfinite(self.coarser().ranges).sum())
        return 1.0 - filled / around if around else 0.0


class MomentGrid:
    """Raw points in, surfels out. `add` every chunk, in any order; the result does not depend on it.

    cell : edge of a cell, metres; offset : (3,) float64, the grid's origin in the points' frame (`None`: the median of
    the first points, rounded to whole metres, so that coordinates keep their digits however far from zero the scan is).
    """

    def __init__(self, cell: float, offset: Floats | None = None) -> None:
        from scanfind.kernels.grid import MOMENTS

        self.cell = cell
        self.offset = offset
        self.points = 0
        self.unaddressable = 0
        self.signed = True
        self._units = 65536.0
        self._hash_keys = np.full(4 * EMPTY_BLOCKS, -1, np.int64)
        self._hash_values = np.zeros(4 * EMPTY_BLOCKS, np.int32)
        self._block_keys = np.empty(EMPTY_BLOCKS, np.int64)
        self._block_cells = np.empty((EMPTY_BLOCKS, 512), np.int32)
        self._moments = np.empty((EMPTY_ROWS, MOMENTS), np.int64)
        self._links = np.empty((EMPTY_ROWS, 2), np.int32)
        self._counts = np.zeros(3, np.int64)
        self._held: list[PointChunk] = []
        self._depths: dict[tuple[float, ...], NDArray[np.float32]] = {}

    def add(self, chunk: PointChunk) -> None:
        """Sum a chunk's points into the grid and into the depth map of its scanner."""
        from scanfind.kernels.grid import accumulate

        if not len(chunk):
            return
        if self.offset is None:
            self._settle(chunk)
            return
        has_origin = chunk.origin is not None
        self.signed &= has_origin
        origin = np.zeros(3) if chunk.origin is None else np.asarray(chunk.origin, np.float64)
        ranges = np.empty(0, np.float32)
        if has_origin:
            key = tuple((origin - self.offset).tolist())
            ranges = self._depths.setdefault(key, np.full(6 * DEPTH_PIXELS**2, np.inf, np.float32))
        at = 0
        while True:
            at = accumulate(
                chunk.xyz, at, origin, has_origin, self.offset, self.cell, self._hash_keys, self._hash_values,
                self._block_keys, self._block_cells, self._moments, self._links, self._counts, ranges, DEPTH_PIXELS,
            )  # fmt: skip
            if at == len(chunk):
                break
            self._make_room()
        self.points += len(chunk)
        self.unaddressable = int(self._counts[2])

    def _settle(self, chunk: PointChunk) -> None:
        """Hold chunks back until there are enough points to say where the scan lies; then add what was held.

        The median of the first points, not the first: one stray record would put the whole scan out of reach.
        """
        self._held.append(chunk)
        if sum(len(held) for held in self._held) >= POINTS_TO_SETTLE:
            self._release()

    def _release(self) -> None:
        """Add the chunks held back."""
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

        if self._counts[0] + 1 > len(self._block_keys):
            self._block_keys = doubled(self._block_keys)
            self._block_cells = doubled(self._block_cells)
            self._hash_keys = np.full(4 * len(self._block_keys), -1, np.int64)
            self._hash_values = np.zeros(len(self._hash_keys), np.int32)
            fill_hash(self._block_keys[: self._counts[0]], self._hash_keys, self._hash_values)
        if self._counts[1] + ROWS_OF_OCTANT > len(self._moments):
            self._moments, self._links = doubled(self._moments), doubled(self._links)

    def points_per_row(self) -> float:
        """Raw points a cell, on average, counting a cell once for each view."""
        self._release()
        return self.points / max(int(self._counts[1]), 1)

    def coarser(self) -> MomentGrid:
        """The next level of the octree: cells of twice the edge, each the sum of its eight children."""
        from scanfind.kernels.grid import sum_children

        self._release()
        parent = MomentGrid(2.0 * self.cell, self.offset)
        parent.points, parent.unaddressable, parent.signed = self.points, self.unaddressable, self.signed
        parent._units = 2.0 * self._units
        parent._depths = self._depths
        blocks = int(self._counts[0])
        at = 0
        while True:
            at = sum_children(
                at, self._block_keys[:blocks], self._block_cells, self._moments, self._links, np.int64(self._units / 2),
                parent._hash_keys, parent._hash_values, parent._block_keys, parent._block_cells, parent._moments,
                parent._links, parent._counts,
            )  # fmt: skip
            if at == blocks:
                return parent
            parent._make_room()

    def depth_maps(self) -> list[DepthMap]:
        """One for each scanner position, in the order of their coordinates."""
        self._release()
        maps = [DepthMap(np.array(key), self._depths[key], DEPTH_PIXELS) for key in sorted(self._depths)]
        while maps and maps[0].edge > LEAST_DEPTH_PIXELS and max(depth.holes() for depth in maps) > MOST_HOLES:
            maps = [depth.coarser() for depth in maps]
        return maps

    def surfels(self, min_neighbours: int = 5, jobs: int = 1) -> Surfels:
        """The mean and the oriented normal of each cell (paper 3.2: PCA over a neighbourhood).

        min_neighbours : see GridParameters; jobs : threads, on which the result does not depend
        """
        from scanfind.kernels.blocks import fill_hash
        from scanfind.kernels.surfels import count_cells, fit_surfels, number_cells
        from scanfind.threads import in_threads

        self._release()
        used = int(self._counts[0])
        order = np.argsort(self._block_keys[:used])
        block_keys = self._block_keys[order]
        hash_keys, hash_values = empty_hash(used)
        fill_hash(block_keys, hash_keys, hash_values)

        counts = np.empty(used, np.int64)
        in_threads(jobs, used, lambda start, stop: count_cells(start, stop, order, self._block_cells, counts))
        first_cell = np.concatenate([[0], np.cumsum(counts)])
        cells = int(first_cell[-1])
        block_cells = np.empty((used, 512), np.int32)
        cell_locals, cell_rows = np.empty(cells, np.int16), np.empty(cells, np.int32)
        totals = np.empty((cells, 10), np.float32)
        in_threads(
            jobs, used,
            lambda start, stop: number_cells(
                start, stop, order, self._block_cells, first_cell, self._moments, self._links, block_cells,
                cell_locals, cell_rows, totals,
            ),
        )  # fmt: skip

        sides, means, normals = np.empty(cells, np.int64), np.empty((cells, 3)), np.empty((cells, 3))
        flatness, points = np.empty(cells), np.empty(cells)
        backs = in_threads(
            jobs, used,
            lambda start, stop: fit_surfels(
                start, stop, block_keys, hash_keys, hash_values, self._moments, self._links, block_cells,
                first_cell, cell_locals, cell_rows, totals, self.cell, self._units, min_neighbours,
                sides, means, normals, flatness, points,
            ),
        )  # fmt: skip
        two = np.flatnonzero(sides == 2)
        if len(two):
            # A cell's second face stands right behind its first.
            back = np.concatenate(backs)
            means, normals = (
                np.insert(a, two + 1, b, axis=0) for a, b in ((means, back[:, :3]), (normals, back[:, 3:6]))
            )
            flatness, points = (np.insert(a, two + 1, b) for a, b in ((flatness, back[:, 6]), (points, back[:, 7])))
        first_surfel = np.concatenate([[0], np.cumsum(sides)]).astype(np.int32)
        return Surfels(
            self.cell, np.zeros(3) if self.offset is None else self.offset, hash_keys, hash_values, block_keys,
            block_cells, first_surfel, means, normals, flatness, points, self.signed,
        )  # fmt: skip


def doubled(array: NDArray[Any]) -> NDArray[Any]:
    """Twice the room along the first axis; the new half is left untouched, so that it costs no memory yet."""
    larger = np.empty((2 * len(array), *array.shape[1:]), array.dtype)
    larger[: len(array)] = array
    return larger


def empty_hash(entries: int) -> tuple[Ints, NDArray[np.int32]]:
    """Keys and values of an empty hash table with room for so many entries at a load of at most a half."""
    size = 1 << max(4, int(2 * max(entries, 1) - 1).bit_length())
    return np.full(size, -1, np.int64), np.zeros(size, np.int32)
