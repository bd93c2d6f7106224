"""Polygons of any number of corners, as OBJ and PLY have them, into triangles."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]


def fans(corners: NDArray[Any], counts: NDArray[Any]) -> Ints:
    """Triangles (F, 3) of P polygons: each is cut into a fan about its first corner.

    corners : (C,) vertex numbers, polygon after polygon
    counts : (P,) corners of each; fewer than three make no triangle
    """
    triangles = np.maximum(counts.astype(np.int64) - 2, 0)
    first = np.repeat(np.cumsum(counts, dtype=np.int64) - counts, triangles)
    step = np.arange(triangles.sum()) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    return np.column_stack([corners[first], corners[first + step + 1], corners[first + step + 2]]).astype(np.int64)


def used_only(vertices: NDArray[np.float64], faces: Ints) -> tuple[NDArray[np.float64], Ints]:
    """The vertices that the faces name, and the faces renumbered for them."""
    used, renumbered = np.unique(faces, return_inverse=True)
    return vertices[used], renumbered.reshape(faces.shape)
