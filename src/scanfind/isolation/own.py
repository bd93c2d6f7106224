"""Whose points are whose: of those near a placed model its own are as far from it as most of them, and no farther."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from scanfind.errors import require
from scanfind.isolation.deviation import deviation_of
from scanfind.isolation.isolate import nearer

if TYPE_CHECKING:
    from scanfind.detection import Detection, IsolatedPoints

# Twice what the grid takes for noise: it is a fifth too small where points are many, and cut off there their own spread
# looks smaller still. Where they are few, cells are large, and what bends within them looks like noise: 15 times it.
GATE = 2.0
LEAST_CELLS = 0.1  # of the finest cell: points without noise are rounded, and their pose is off by some of that


@dataclass(frozen=True)
class IsolationParameters:
    """Which raw points belong to a detection.

    tolerance_m : those within this distance of the placed model's surface; None: each detection's own
    noises : that is so many times what its points spread about it (1.48 times the median of their distances), at least
        a tenth of the grid's finest cell and at most half of that it was found with
    dimensions : measure what a drawing would dimension; a second a model, and a tenth of one a detection
    """

    tolerance_m: float | None = None
    noises: float = 4.0
    dimensions: bool = False

    def __post_init__(self) -> None:
        require(
            self.tolerance_m is None or self.tolerance_m > 0.0, "tolerance_m", self.tolerance_m, "a positive length"
        )
        require(self.noises > 0.0, "noises", self.noises, "more than 0")


def isolation_gate(parameters: IsolationParameters, noise: float, cell: float) -> float:
    """Within how many metres of a placed surface a raw point may belong to it, by the noise that the grid tells."""
    if parameters.tolerance_m is not None:
        return parameters.tolerance_m
    return min(max(GATE * parameters.noises * noise, LEAST_CELLS * cell), 0.5 * cell)


def with_own_points(found: Detection, parameters: IsolationParameters, gate: float, finest_cell: float) -> Detection:
    """Of the points within the gate of a detection those that are its own: what spreads about it as most of them do.

    found : fitted to these points; gate, finest_cell : metres
    """
    points = found.isolated
    if points is None or not len(points) or parameters.tolerance_m is not None:
        return replace(found, tolerance_m=None if points is None else gate)
    # The median: up to half of the points may be those of a floor or a neighbour.
    spread = 1.4826 * float(np.median(np.abs(points.deviation)))
    tolerance = min(max(parameters.noises * spread, LEAST_CELLS * finest_cell), gate)
    return within(found, points, tolerance)


def within(found: Detection, points: IsolatedPoints, tolerance: float) -> Detection:
    """A detection with those of some points that are no farther from it than a tolerance, metres."""
    own = nearer(points, tolerance)
    return replace(
        found, isolated=own, deviation=deviation_of(own.deviation) if len(own) else None, tolerance_m=tolerance
    )
