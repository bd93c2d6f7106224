"""Deviation: how far the built thing is from its design, and whether that is allowed."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from scanfind.detection import Deviation
from scanfind.errors import InvalidGeometryError, UsageError


def deviation_of(distances: ArrayLike) -> Deviation:
    """Mean, root mean square, 95th percentile of the absolute and worst of N signed distances (N,), metres, + outside.

    NaN (beyond reach, not measured) does not count. Where the worst inwards equals the worst outwards, the latter is
    given. Raises InvalidGeometryError where no distance is left.
    """
    d = np.asarray(distances, dtype=np.float64)
    if d.ndim != 1:
        msg = f"distances must have shape (N,), got {d.shape}"
        raise InvalidGeometryError(msg)
    d = d[~np.isnan(d)]
    if not len(d):
        msg = "a deviation needs at least one measured distance, got none"
        raise InvalidGeometryError(msg)
    low, high = float(d.min()), float(d.max())
    return Deviation(
        mean_m=float(d.mean()),
        rms_m=float(np.sqrt((d**2).mean())),
        p95_m=float(np.percentile(np.abs(d), 95.0)),
        worst_m=high if high >= -low else low,
    )


def within(deviation: Deviation, tolerance: float) -> bool:
    """Whether 95 % of the points are within `tolerance`, metres.

    Not the worst point: of a million points of a good part one is a mixed pixel at an edge, and lies anywhere.
    Raises UsageError for a tolerance that is not positive.
    """
    if not (np.isfinite(tolerance) and tolerance > 0):
        msg = f"a tolerance must be a positive length in metres, got {tolerance}"
        raise UsageError(msg)
    return deviation.p95_m <= tolerance
