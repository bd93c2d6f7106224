"""The scene as the search sees it: two levels of surfels and what each scanner saw in each direction (paper 3.3)."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.surfels import DepthMap, GridParameters, MomentGrid, Surfels, empty_hash

Floats = NDArray[np.float64]

SMALLEST_CELL_M = 1e-3


class OrientationGrid(NamedTuple):
    """Coarse cells that know which way the surface in and near them faces: one look-up tests a point of a hypothesis.

    cell : edge, metres
    hash_keys, hash_values : packed block coordinates → block
    occupied : (B, 8) uint64, a bit for each of the block's 512 cells that is marked at all
    masks : (B, 512) uint64, a bit for each of 54 directions (kernels.search.normal_bit)
    """

    cell: float
    hash_keys: NDArray[np.int64]
    hash_values: NDArray[np.int32]
    occupied: NDArray[np.uint64]
    masks: NDArray[np.uint64]


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene, resampled.

    fine : cells for verification and ICP; coarse : cells of twice the edge, for ICP's first steps
    tolerant : cells for the sequential test
    bends : (S,) for each fine surfel, standard deviation across the plane of the `window` around it, metres
    window : edge of that cube, metres
    depths : what each known scanner position saw; empty where none is known
    noise : spread of raw points across the median surfel: the scanner's noise, metres (see `quiet`)
    points, unaddressable : raw points in the grid, and those too far from the rest to be
    """

    fine: Surfels
    coarse: Surfels
    tolerant: OrientationGrid
    bends: Floats
    window: float
    depths: list[DepthMap]
    noise: float
    points: int
    unaddressable: int

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

    grid : the raw points, in cells of `first_cell`; it is left as it is
    diameter : of the smallest model sought, metres
    test_cells_across : cells of the sequential test along that diameter; a surfel tolerates a sample that is half of
        one off along its normal
    """
    largest_cell = diameter / parameters.least_cells_across
    if parameters.cell_m is None:
        while grid.points_per_row() < parameters.points_per_cell and 2.0 * grid.cell <= largest_cell:
            grid = grid.coarser()
    half = grid.coarser()
    fine = grid.surfels(parameters.min_neighbours, jobs)
    test_cell = max(diameter / test_cells_across, 2.0 * grid.cell)
    with ThreadPoolExecutor(1) as beside:  # marking is one long loop: a second core does the coarser levels meanwhile
        marked = beside.submit(orientation_grid, fine, 0.5 * test_cell, test_cell)
        coarse = half.surfels(parameters.min_neighbours, jobs)
        around = half.coarser().surfels(1, jobs)
        tolerant = marked.result()
    bends = flatness_around(fine, around)
    return Scene(
        fine,
        coarse,
        tolerant,
        bends,
        3.0 * around.cell,
        grid.depth_maps(),
        quiet(fine.flatness),
        grid.points,
        grid.unaddressable,
    )


def quiet(flatness: Floats) -> float:
    """The noise in some surfels' flatness, metres: its median.

    Edges and bends spread the upper half, and quantised ranges (a Kinect's) lie in one plane in much of the lower.
    """
    return float(np.median(flatness)) if len(flatness) else 0.0


def flatness_around(fine: Surfels, around: Surfels) -> Floats:
    """For each fine surfel the flatness of the window around the coarse cell it lies in, (S,), metres."""
    from scanfind.kernels.shape import look_up_flatness

    found = np.empty(len(fine.means))
    look_up_flatness(
        fine.means, around.cell, around.hash_keys, around.hash_values, around.block_cells, around.first_surfel,
        around.flatness, found,
    )  # fmt: skip
    return found


# Half the width of a bin: a normal near its border, or off by noise, still meets the bin of the model's normal.
SPREAD = np.radians(20.0)


def orientation_grid(surfels: Surfels, reach: float, cell: float) -> OrientationGrid:
    """Mark every surfel's direction in the cells it supports: where it is and up to `reach` metres along its normal."""
    from scanfind.kernels.blocks import fill_hash
    from scanfind.kernels.search import mark_orientations

    room = 256
    block_keys, masks = np.empty(room, np.int64), np.empty((room, 512), np.uint64)
    hash_keys, hash_values = empty_hash(2 * room)
    counts = np.zeros(2, np.int64)
    while True:
        at = mark_orientations(
            surfels.means, surfels.normals, reach, cell, SPREAD, surfels.signed, hash_keys, hash_values, block_keys,
            masks, counts,
        )  # fmt: skip
        if at == len(surfels.means):
            masks = masks[: counts[0]]
            bits = np.packbits(masks != 0, axis=1, bitorder="little").view(np.uint64)
            return OrientationGrid(cell, hash_keys, hash_values, bits, masks)
        room *= 2
        block_keys = np.concatenate([block_keys, np.empty_like(block_keys)])
        masks = np.concatenate([masks, np.empty_like(masks)])
        hash_keys, hash_values = empty_hash(2 * room)
        fill_hash(block_keys[: counts[0]], hash_keys, hash_values)
