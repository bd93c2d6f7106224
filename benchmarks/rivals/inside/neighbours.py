"""Nearest neighbours, as scipy's tree finds them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Neighbours(Protocol):
    """A search tree over N points; what of scipy's cKDTree is used, so that tests can do without scipy."""

    def query(
        self, x: Floats, k: int = 1, *, distance_upper_bound: float = np.inf
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        """Distances and indices of the k nearest within the bound; infinite and N where there are fewer."""


Grow = Callable[[Floats], Neighbours]


def grow_tree(points: Floats) -> Neighbours:
    """A tree over points (N, 3)."""
    from scipy.spatial import cKDTree

    tree: Neighbours = cKDTree(points)
    return tree
