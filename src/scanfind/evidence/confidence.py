"""How likely a pose is right: how often poses of such a score were, in simulated scenes where the truth is known.

The curves are what `python -m benchmarks.calibration --part curves` makes of benchmarks/results/calibration_fit.csv
(isotonic regression: Ayer et al. 1955; Zadrozny & Elkan 2002). docs/score.md says of which scenes, and how well they
hold on others.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from scanfind.evidence.verify import VerifyParameters

SEEN, BLIND, CONTESTED, OUTWEIGHED = "seen", "blind", "contested", "outweighed"
# A rival that scores no more than this below a pose, or above it, explains the surface as well: noise decides.
AS_GOOD = 0.005


class Curve(NamedTuple):
    """Shares of right poses over their scores, both ascending; between two scores linear, beyond them level."""

    scores: tuple[float, ...]
    right: tuple[float, ...]

    def at(self, score: float) -> float:
        """The share at a score."""
        return float(np.interp(score, self.scores, self.right))


CURVES: Mapping[str, Curve] = {
    SEEN: Curve((0.1, 0.5, 0.9, 1.0), (0.01, 0.05, 0.5, 0.98)),
    BLIND: Curve((0.1, 0.5, 0.9, 1.0), (0.01, 0.05, 0.5, 0.98)),
    CONTESTED: Curve((0.1, 0.5, 0.9, 1.0), (0.01, 0.05, 0.5, 0.98)),
    OUTWEIGHED: Curve((0.1, 0.5, 0.9, 1.0), (0.01, 0.05, 0.5, 0.98)),
}


def probability(score: float, rival: float, *, blind: bool, outweighed: bool) -> float:
    """That a model is there, at a pose of this score, and was not told before; see `curve_of`."""
    return CURVES[curve_of(score, rival, blind=blind, outweighed=outweighed)].at(score)


def curve_of(score: float, rival: float, *, blind: bool, outweighed: bool) -> str:
    """Which curve a pose is read from.

    rival : the best score among other poses of the same surface, NaN where there is none
    blind : no scanner position is known; outweighed : it was refused, and another pose is told of its surface
    """
    if blind:  # a score of all that is expected says nothing of who shows more
        return OUTWEIGHED if outweighed else BLIND
    if abs(score - rival) <= AS_GOOD or (rival > score and not outweighed):
        return CONTESTED
    return OUTWEIGHED if outweighed else SEEN


def weighed_as_measured(parameters: VerifyParameters) -> bool:
    """Does a score mean what it meant when the curves were measured: are its weights those of the default?"""
    measured = VerifyParameters()
    return (parameters.penalty_weight, parameters.beside_weight) == (measured.penalty_weight, measured.beside_weight)
