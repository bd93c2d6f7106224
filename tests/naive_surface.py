"""Plain twins of the sampling kernels: all pairs, no grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def poisson_order(
    points: Floats, normals: Floats, wanted: int, radius: float, shrink: float, levels: int
) -> tuple[list[int], float]:
    """Dart throwing at shrinking radii: a candidate sticks where no sample that faces its way is near."""
    order: list[int] = []
    for level in range(levels):
        radius *= shrink if level else 1.0
        for c in range(len(points)):
            if len(order) == min(wanted, len(points)):
                return order, radius
            near = ((points[order] - points[c]) ** 2).sum(axis=1) < radius * radius
            if c not in order and not (near & (normals[order] @ normals[c] > -0.5)).any():
                order.append(c)
    return order, radius


def distances(a: Floats, b: Floats) -> Floats:
    """All distances, (len(a), len(b))."""
    out: Floats = np.linalg.norm(a[:, None] - b[None], axis=2)
    return out
