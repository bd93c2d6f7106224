"""Steel members from one point to another, as structures have them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanfind.mesh import Mesh
from scanfind.pose import Pose
from scanfind.simulate.parts import hollow_section, i_section

Floats = NDArray[np.float64]


def along(start: ArrayLike, end: ArrayLike) -> Pose:
    """The pose that takes z from `start` (3,) towards `end` (3,), with y as upright as that allows (+y when z is)."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    z = (b - a) / np.linalg.norm(b - a)
    up = np.array([0.0, 1.0, 0.0]) if abs(z[2]) > 0.999 else np.array([0.0, 0.0, 1.0])
    y = up - (up @ z) * z
    y /= np.linalg.norm(y)
    return Pose(np.stack([np.cross(y, z), y, z], axis=1), a)


def i_beam(start: ArrayLike, end: ArrayLike, width: float, depth: float) -> tuple[Mesh, Pose]:
    """An I section from `start` to `end`, its depth upright; flanges and web as rolled sections have them."""
    mesh = i_section(width, depth, 0.06 * depth, 0.04 * depth, float(np.linalg.norm(np.subtract(end, start))))
    return mesh, along(start, end)


def hollow_beam(start: ArrayLike, end: ArrayLike, side: float) -> tuple[Mesh, Pose]:
    """A square hollow section from `start` to `end`."""
    return hollow_section(side, side, float(np.linalg.norm(np.subtract(end, start)))), along(start, end)
