"""Moments → surfels: the mean and the oriented normal of each cell (paper 3.2: PCA over a neighbourhood).

Fitted where they are asked for: of the cells of a shop the search draws from a tenth and ICP visits another, and
fitting all of them took a third of a whole search (decisions/0009-fitted-on-demand.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.cloud import OrientedCloud
from scanfind.grid.moments import MomentGrid, empty_hash
from scanfind.threads import in_threads

if TYPE_CHECKING:
    from scanfind.kernels.blocks import BlockRows

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Cells(NamedTuple):
    """The occupied cells of a grid, V of them, numbered in the order of their blocks' keys: no order of the points, nor
    of chunks or threads, changes a number.

    cell : edge, metres
    offset : (3,) the grid's origin in the scan's frame; everything else is relative to it
    hash_keys, hash_values : packed block coordinates → block
    block_keys : packed; block_rows : the row of each cell
    filled : (…, 8) uint64, a bit for each cell that is not empty, eight words of eight by eight
    order : (B,) where the blocks lie in these, by key; first_cell : (B+1,) where the cells of each begin
    locals : (V,) int16, each cell's place in its block; rows : (V,) int32, its row
    """

    cell: float
    offset: Floats
    hash_keys: Ints
    hash_values: NDArray[np.int32]
    block_keys: Ints
    block_rows: BlockRows
    filled: NDArray[np.uint64]
    order: NDArray[np.intp]
    first_cell: Ints
    locals: NDArray[np.int16]
    rows: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.locals)


class Surfels:
    """A scene as oriented points in an addressable grid; S surfels so far in V cells.

    grid, cells : the moments they are fitted to, and the addresses of its cells
    signed : the normals point to the scanner; False where nobody knows their side
    first_surfel, sides : by a cell's row, its surfels: none where it was not fitted yet, else one, or two where
        scanners saw both faces of something thin
    cell_of : (S,) the cell each surfel lies in
    """

    def __init__(self, grid: MomentGrid, min_neighbours: int = 5, jobs: int = 1) -> None:
        """No surfel fitted yet. min_neighbours : see GridParameters; jobs : threads, on which nothing depends."""
        self.cells = number(grid, jobs)
        self.signed = grid.signed
        self.grid, self._min_neighbours, self.jobs = grid, min_neighbours, jobs
        rows = grid.rows_end()
        self.first_surfel, self.sides = np.zeros(rows, np.int32), np.zeros(rows, np.uint8)
        self.cell_of = np.empty(0, np.int32)
        self._faces = np.empty((0, 8))

    @property
    def cell(self) -> float:
        """Edge of a cell, metres."""
        return self.cells.cell

    @property
    def means(self) -> Floats:
        """(S, 3) metres from the grid's offset."""
        return self._faces[:, 0:3]

    @property
    def normals(self) -> Floats:
        """(S, 3) unit, to the scanner where `signed`; zero where a cell has too few neighbours."""
        return self._faces[:, 3:6]

    @property
    def flatness(self) -> Floats:
        """(S,) standard deviation across the plane fitted to the 3×3×3, metres."""
        return self._faces[:, 6]

    @property
    def points(self) -> Floats:
        """(S,) raw points in each."""
        return self._faces[:, 7]

    def __len__(self) -> int:
        return len(self._faces)

    def oriented(self) -> OrientedCloud:
        """Means and normals of those fitted so far."""
        return OrientedCloud(self.means, self.normals, self.signed)

    def fit(self, cells: NDArray[np.integer] | NDArray[np.bool_] | None = None) -> Surfels:
        """Fit those of some cells that are not fitted yet, all of them by default; itself, for chaining.

        cells : (K,) numbers or (V,) a mask
        """
        from scanfind.kernels.surfels import fit_cells

        at, grid = self.cells, self.grid
        wanted = np.zeros(len(at), np.bool_)
        wanted[slice(None) if cells is None else cells] = True
        some = np.flatnonzero(wanted)
        some = some[self.sides[at.rows[some]] == 0]
        if not len(some):
            return self
        sides = np.empty(len(some), np.uint8)
        fitted = in_threads(
            self.jobs, len(some),
            lambda start, stop: fit_cells(
                start, stop, some, at.first_cell.searchsorted(some[start], "right") - 1, at.first_cell, at.locals,
                at.rows, at.order, at.block_keys, at.hash_keys, at.hash_values, at.block_rows, grid.moments, grid.links,
                at.cell, grid.units, self._min_neighbours, sides,
            ),
        )  # fmt: skip
        self.first_surfel[at.rows[some]] = len(self) + np.cumsum(sides, dtype=np.int64) - sides
        self.sides[at.rows[some]] = sides
        self.cell_of = np.concatenate([self.cell_of, np.repeat(some, sides).astype(np.int32)])
        self._faces = np.concatenate([self._faces, *fitted])
        return self

    def of(self, cells: NDArray[np.integer]) -> NDArray[np.intp]:
        """The surfels of some cells, which are fitted where they are not yet."""
        self.fit(cells)
        rows = self.cells.rows[cells]
        sides = self.sides[rows].astype(np.intp)
        within = np.arange(sides.sum()) - np.repeat(np.cumsum(sides) - sides, sides)
        return np.asarray(np.repeat(self.first_surfel[rows].astype(np.intp), sides) + within)

    def has_normal(self) -> NDArray[np.bool_]:
        """Which surfels have a normal, (S,)."""
        x, y, z = self.normals.T
        return np.asarray((x != 0.0) | (y != 0.0) | (z != 0.0))


def number(grid: MomentGrid, jobs: int) -> Cells:
    """Number a grid's cells."""
    from scanfind.kernels.blocks import fill_hash
    from scanfind.kernels.surfels import count_cells, number_cells

    block_keys, block_rows, order = grid.block_keys, grid.block_rows, grid.blocks()
    hash_keys, hash_values = empty_hash(len(order))
    fill_hash(block_keys, order, hash_keys, hash_values)
    counts = np.empty(len(order), np.int64)
    in_threads(jobs, len(order), lambda start, stop: count_cells(start, stop, order, block_rows, counts))
    first_cell = np.concatenate([[0], np.cumsum(counts)])
    places, rows = np.empty(first_cell[-1], np.int16), np.empty(first_cell[-1], np.int32)
    filled = np.zeros((len(block_keys), 8), np.uint64)
    in_threads(
        jobs, len(order),
        lambda start, stop: number_cells(start, stop, order, block_rows, first_cell, places, rows, filled),
    )  # fmt: skip
    offset = np.zeros(3) if grid.offset is None else grid.offset
    return Cells(
        grid.cell, offset, hash_keys, hash_values, block_keys, block_rows, filled, order, first_cell, places, rows
    )  # fmt: skip
