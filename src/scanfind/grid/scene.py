"""The scene as the search sees it: two levels of surfels and what each scanner saw in each direction (paper 3.3)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.cloud import OrientedCloud
from scanfind.errors import require
from scanfind.grid.air import Air, air_of
from scanfind.grid.blocks import block_table
from scanfind.grid.depth import Beams, DepthMap, joined_until_spoken
from scanfind.grid.moments import MomentGrid, empty_hash
from scanfind.grid.surfels import Surfels

if TYPE_CHECKING:
    from scanfind.kernels.blocks import BlockTable

Floats = NDArray[np.float64]

SMALLEST_CELL_M = 1e-3
SAMPLE = 20_000  # cells tell the noise, as a median, within a hundredth


@dataclass(frozen=True)
class GridParameters:
    """How the scene is resampled.

    cell_m : edge of a cell, metres; None: `cells_across` of them along the smallest model's diameter, made larger
        until the scan fills them
    cells_across : how many cells the diameter of the smallest model spans; 180 makes 20 mm of a 3.6 m spool
    least_cells_across : never fewer, however sparse the scan
    points_per_cell : a cell must hold so many points on average, or cells are doubled; fewer make poor normals
    normal_share : share of the points that must lie in cells with a normal, or cells are doubled
    min_neighbours : occupied cells of the 3×3×3 (itself included) below which a cell has no normal, only presence
    """

    cell_m: float | None = None
    cells_across: float = 180.0
    least_cells_across: float = 30.0
    points_per_cell: float = 1.25
    normal_share: float = 0.65
    min_neighbours: int = 5

    def __post_init__(self) -> None:
        require(self.cell_m is None or 0.0 < self.cell_m < 100.0, "cell_m", self.cell_m, "a length up to 100 metres")
        require(self.least_cells_across >= 1.0, "least_cells_across", self.least_cells_across, "1 or more")
        require(
            self.cells_across >= self.least_cells_across, "cells_across", self.cells_across, "no less than the least"
        )
        require(self.points_per_cell >= 0.0, "points_per_cell", self.points_per_cell, "0 or more")
        require(0.0 <= self.normal_share <= 1.0, "normal_share", self.normal_share, "from 0 to 1")
        require(1 <= self.min_neighbours <= 27, "min_neighbours", self.min_neighbours, "from 1 to 27")


class OrientationGrid(NamedTuple):
    """Coarse cells that know which way the surface in and near them faces: one look-up tests a point of a hypothesis.

    cell : edge, metres; where : the blocks
    occupied : (B, 8) uint64, a bit for each of a block's 512 cells that is marked at all
    masks : (B, 512) uint64, a bit for each of 54 directions (kernels.search.normal_bit)
    """

    cell: float
    where: BlockTable
    occupied: NDArray[np.uint64]
    masks: NDArray[np.uint64]


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene, resampled.

    fine : cells for drawing, verification and ICP, fitted where they are asked for
    coarse : cells of twice the edge, for ICP's first steps; around : of four times, for the shape around a cell
    tolerant : cells for the sequential test, at least four times as large as the fine ones
    beams : what each known scanner position saw; empty where none is known
    depths : the same as ranges, in pixels joined until they are mostly filled: quick to ask, and at edges wrong
    noise : spread of raw points across the median surfel: the scanner's noise, metres (see `noise_of`)
    points, unaddressable : raw points in the grid, and those too far from the rest to be
    """

    fine: Surfels
    coarse: Surfels
    around: Surfels
    tolerant: OrientationGrid
    beams: list[Beams]
    depths: list[DepthMap]
    noise: float
    points: int
    unaddressable: int

    @cached_property
    def air(self) -> Air:
        """Cells as large as the test's that scanners looked through: a fifth of a second, when first asked for."""
        return air_of(self.depths, self.around.means, self.tolerant.cell, self.fine.jobs)

    def origins(self) -> Floats:
        """Scanner positions relative to the grid's offset, (K, 3)."""
        return np.array([depth.origin for depth in self.depths]).reshape(-1, 3)

    def ranges(self) -> NDArray[np.float32]:
        """Depth maps, (K, 6·edge²)."""
        edge = self.depths[0].edge if self.depths else 1
        return np.array([depth.ranges for depth in self.depths], np.float32).reshape(-1, 6 * edge**2)


def first_cell(diameters: Iterable[float], parameters: GridParameters) -> float:
    """The edge of the cells the raw points are summed in, metres, from the diameters of the models sought."""
    if parameters.cell_m is not None:
        return parameters.cell_m
    return max(min(diameters) / parameters.cells_across, SMALLEST_CELL_M)


def build_scene(
    grid: MomentGrid, diameter: float, parameters: GridParameters, test_cells_across: float, jobs: int
) -> Scene:
    """Resample a filled grid (paper 3.1), doubling its cells until the scan fills them.

    grid : the raw points, in cells of `first_cell` or smaller ones; it is left as it is
    diameter : of the smallest model sought, metres
    test_cells_across : cells of the sequential test along that diameter; a surfel tolerates a sample that is half of
        one off along its normal
    """
    while 2.0 * grid.cell <= first_cell([diameter], parameters) * (1.0 + 1e-9):
        grid = grid.coarser()
    fine = Surfels(grid, parameters.min_neighbours, jobs)
    while can_double(grid, diameter, parameters) and not filled(grid, fine, parameters):
        grid = grid.coarser()
        fine = Surfels(grid, parameters.min_neighbours, jobs)
    half = grid.coarser()
    quarter = half.coarser()
    coarse = Surfels(half, parameters.min_neighbours, jobs).fit()
    around = Surfels(quarter, 1, jobs).fit()
    test_cell = max(diameter / test_cells_across, around.cell)
    tolerant = orientation_grid(coarse.oriented(), 0.5 * test_cell, test_cell)
    beams = grid.beams()
    depths = joined_until_spoken([of.ranges() for of in beams])
    return Scene(
        fine, coarse, around, tolerant, beams, depths, noise_of(fine, some(fine)), grid.points, grid.unaddressable
    )


def without_sparse_levels(grid: MomentGrid, diameter: float, parameters: GridParameters) -> MomentGrid:
    """A filled grid without the levels that the scan is too sparse for, whatever is built of them: of points farther
    apart than the finest cells these took a quarter of all memory.

    diameter : of the smallest model sought, metres: for larger ones cells are doubled as long, and longer
    """
    while can_double(grid, diameter, parameters) and grid.points_per_row() < parameters.points_per_cell:
        grid = grid.coarser()
    return grid


def can_double(grid: MomentGrid, diameter: float, parameters: GridParameters) -> bool:
    """May cells be doubled, and still be small enough for a model?"""
    return parameters.cell_m is None and 2.0 * grid.cell <= diameter / parameters.least_cells_across


def some(surfels: Surfels) -> NDArray[np.intp]:
    """Surfels of cells spread over the scene, SAMPLE of them."""
    cells = len(surfels.cells)
    return surfels.of(np.arange(0, cells, max(1, cells // SAMPLE)))


def filled(grid: MomentGrid, surfels: Surfels, parameters: GridParameters) -> bool:
    """Does a scan fill the cells of a level, so that most of its points get a normal?"""
    if grid.points_per_row() < parameters.points_per_cell:
        return False
    of = some(surfels)
    points = surfels.points[of]
    return bool(points @ surfels.has_normal()[of] >= parameters.normal_share * points.sum())


def noise_of(surfels: Surfels, of: NDArray[np.intp]) -> float:
    """The noise in a scan, metres: the flatness of the median of some surfels.

    The median: edges and bends spread the upper half, and quantised ranges (a Kinect's) lie in one plane in much of the
    lower.
    """
    # Of too few points there is no plane that they do not all lie in.
    with_normal = of[surfels.has_normal()[of]]
    of = with_normal if len(with_normal) else of
    return float(np.median(surfels.flatness[of])) if len(of) else 0.0


def flatness_above(surfels: Surfels, levels: int, around: Surfels) -> NDArray[np.float32]:
    """For each cell the flatness about the cell some levels above it, (V,), metres."""
    from scanfind.kernels.shape import spread_down

    found, cells, above = np.empty(len(surfels.cells), np.float32), surfels.cells, around.cells
    spread_down(
        levels, cells.block_keys, cells.order, cells.first_cell, cells.locals, above.hash_keys, above.hash_values,
        above.block_rows, around.flatness[around.first_surfel], found,
    )  # fmt: skip
    return found


# Half the width of a bin: a normal near its border, or off by noise, still meets the bin of the model's normal.
SPREAD = np.radians(20.0)


def orientation_grid(of: OrientedCloud, reach: float, cell: float) -> OrientationGrid:
    """Mark every point's direction in the cells it supports: where it is and up to `reach` metres along that."""
    from scanfind.kernels.blocks import fill_hash
    from scanfind.kernels.search import mark_orientations

    room = 256
    block_keys, masks = np.empty(room, np.int64), np.empty((room, 512), np.uint64)
    hash_keys, hash_values = empty_hash(2 * room)
    counts = np.zeros(2, np.int64)
    while True:
        at = mark_orientations(
            of.points, of.normals, reach, cell, SPREAD, of.signed, hash_keys, hash_values, block_keys,
            masks, counts,
        )  # fmt: skip
        if at == len(of):
            masks = masks[: counts[0]]
            bits = np.packbits(masks != 0, axis=1, bitorder="little").view(np.uint64)
            return OrientationGrid(cell, block_table(block_keys[: counts[0]]), bits, masks)
        room *= 2
        block_keys = np.concatenate([block_keys, np.empty_like(block_keys)])
        masks = np.concatenate([masks, np.empty_like(masks)])
        hash_keys, hash_values = empty_hash(2 * room)
        fill_hash(block_keys, np.arange(counts[0]), hash_keys, hash_values)
