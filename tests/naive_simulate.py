"""Plain twins: rays against every triangle, and the distance of points from the nearest of all triangles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def first_hit(origin: Floats, direction: Floats, triangles: Floats) -> tuple[float, int]:
    """Distance and index of the first triangle (F, 3, 3) a ray meets (Möller & Trumbore); inf, -1 for none."""
    best, which = np.inf, -1
    for k, (a, b, c) in enumerate(triangles):
        p = np.cross(direction, c - a)
        det = float((b - a) @ p)
        if abs(det) < 1e-14:
            continue
        u = float((origin - a) @ p) / det
        q = np.cross(origin - a, b - a)
        v, t = float(direction @ q) / det, float((c - a) @ q) / det
        if u >= 0 and v >= 0 and u + v <= 1 and 0 < t < best:
            best, which = t, k
    return best, which


def distances_to(points: Floats, triangles: Floats) -> Floats:
    """Distance (N,) of points (N, 3) from F triangles (F, 3, 3): from the plane where above one, else from an edge."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    nearest = np.empty(len(points))
    for k, p in enumerate(points):
        height = np.einsum("ij,ij->i", p - a, normal)
        over = np.ones(len(a), dtype=bool)
        edge = np.full(len(a), np.inf)
        for start, end in ((a, b), (b, c), (c, a)):
            along = end - start
            over &= np.einsum("ij,ij->i", np.cross(along, p - start), normal) >= 0
            share = np.clip(np.einsum("ij,ij->i", p - start, along) / (along**2).sum(axis=1), 0, 1)
            edge = np.minimum(edge, np.linalg.norm(start + share[:, None] * along - p, axis=1))
        nearest[k] = np.where(over, np.abs(height), edge).min()
    return nearest
