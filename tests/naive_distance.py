"""The plain twin of `scanfind.kernels.distance`: every point against every triangle, one at a time, another formula."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def distance_to_segment(a: Floats, b: Floats, p: Floats) -> float:
    """From p (3,) to the segment a → b."""
    along = float((p - a) @ (b - a)) / float((b - a) @ (b - a)) if (a != b).any() else 0.0
    return float(np.linalg.norm(p - (a + np.clip(along, 0.0, 1.0) * (b - a))))


def distance_to_triangle(triangle: Floats, p: Floats) -> float:
    """From p (3,) to a triangle (3, 3): its plane, where p is above the inside, or else its nearest edge."""
    a, b, c = triangle
    candidates = [distance_to_segment(a, b, p), distance_to_segment(b, c, p), distance_to_segment(c, a, p)]
    frame, triangular = np.linalg.qr(np.stack([b - a, c - a], axis=1))
    if abs(triangular[1, 1]) > 1e-8 * np.abs(triangular).max():
        u, v = np.linalg.solve(triangular, frame.T @ (p - a))
        if u >= 0 and v >= 0 and u + v <= 1:
            candidates.append(float(np.linalg.norm(p - a - frame @ (frame.T @ (p - a)))))
    return min(candidates)


def distances(triangles: Floats, points: Floats) -> Floats:
    """Unsigned distances (N, F) of all points (N, 3) to all triangles (F, 3, 3)."""
    return np.array([[distance_to_triangle(t, p) for t in triangles] for p in points]).reshape(len(points), -1)


def winding(triangles: Floats, points: Floats) -> Floats:
    """How often closed triangles go round each point, (N,): 1 inside, 0 outside (van Oosterom & Strackee 1983)."""
    a, b, c = (triangles[None, :, k] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=2) for v in (a, b, c))
    volume = (a * np.cross(b, c)).sum(axis=2)
    rest = la * lb * lc + (a * b).sum(2) * lc + (b * c).sum(2) * la + (c * a).sum(2) * lb
    turns: Floats = np.arctan2(volume, rest).sum(axis=1) / (2 * np.pi)
    return turns
