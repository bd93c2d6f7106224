"""A scene in pieces of the model's size, for solvers made for two clouds that overlap in most of their extent."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Balls around the cells with points in them: neighbours share more than half, so that one holds most of a model.
SPACING, RADIUS = 0.5, 0.75
LEAST_POINTS = 100


def windows(points: Floats, diameter: float) -> Iterator[NDArray[np.int64]]:
    """Rows of points (N, 3) in each ball around the cells where points are."""
    cells = np.unique(np.floor(points / (SPACING * diameter)).astype(np.int64), axis=0)
    for centre in (cells + 0.5) * SPACING * diameter:
        inside = np.flatnonzero(((points - centre) ** 2).sum(axis=1) < (RADIUS * diameter) ** 2)
        if len(inside) >= LEAST_POINTS:
            yield inside
