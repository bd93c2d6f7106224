"""A scan thinned to one point a cell, to be asked what lies near a place: coarse, and cheap for a whole site."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

BITS = 21  # of a cell's number along each axis: 2 million cells, 160 km of 8 cm
STEPS = np.array([(x << 2 * BITS) + (y << BITS) + z for x, y, z in product((-1, 0, 1), repeat=3)], np.int64)
FAR_OFF = np.int64(-1) << 62  # a cell that has no number, and no neighbours with one


class Thinned:
    """The mean of the points in each cell of a scan that has any.

    cell : edge, metres; means : (V, 3) scan frame
    """

    def __init__(self, chunks: Iterable[Floats], cell: float) -> None:
        """`chunks` : points (N, 3), one after the other."""
        self.cell = cell
        # About the first point: far from zero sums of coordinates would lose their digits.
        self._middle: Floats = np.zeros(3)
        keys, sums = np.empty(0, np.int64), np.empty((0, 4))
        for points in chunks:
            if not len(keys) and len(points):
                self._middle = np.floor(points[0] / cell) * cell
            some = np.concatenate([sums, np.column_stack([points - self._middle, np.ones(len(points))])])
            keys, where = np.unique(np.concatenate([keys, self._keys(points)]), return_inverse=True)
            sums = np.column_stack([np.bincount(where, some[:, k], len(keys)) for k in range(4)])
        self._sorted = keys
        self.means: Floats = sums[:, :3] / np.maximum(sums[:, 3:], 1.0) + self._middle

    def nearest(self, points: Floats) -> tuple[Floats, NDArray[np.intp]]:
        """How far N points (N, 3) are from the nearest mean of the cells around theirs, (N,), inf for none; which."""
        if not len(self._sorted):
            return np.full(len(points), np.inf), np.zeros(len(points), np.intp)
        keys = self._keys(points) + STEPS[:, None]  # a step to another cell is a number to be added
        at = np.minimum(np.searchsorted(self._sorted, keys), len(self._sorted) - 1)
        step, point = np.nonzero(self._sorted[at] == keys)
        away = np.full(keys.shape, np.inf)
        away[step, point] = np.linalg.norm(self.means[at[step, point]] - points[point], axis=1)
        best, every = np.argmin(away, axis=0), np.arange(len(points))
        return away[best, every], at[best, every]

    def _keys(self, points: Floats) -> NDArray[np.int64]:
        cells = np.floor((points - self._middle) / self.cell).astype(np.int64) + (1 << (BITS - 1))
        inside = ((cells >= 0) & (cells < 1 << BITS)).all(axis=1)
        x, y, z = cells.T
        return np.where(inside, (x << 2 * BITS) | (y << BITS) | z, FAR_OFF)
