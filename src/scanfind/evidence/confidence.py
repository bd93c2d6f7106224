"""How likely a pose is right: how often poses of such a score were, in simulated scenes where the truth is known.

The curves are what `python -m benchmarks.calibration --part curves` makes of benchmarks/results/calibration_fit.csv
(isotonic regression: Ayer et al. 1955; Zadrozny & Elkan 2002). docs/score.md says of which scenes, and how well they
hold on others; decision 25 why it is curves.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from scanfind.evidence.verify import VerifyParameters

SEEN, BLIND, CONTESTED, OUTWEIGHED = "seen", "blind", "contested", "outweighed"
# A rival that scores no more than this below a pose, or above it, fits as well: noise decides.
AS_GOOD = 0.005


class Curve(NamedTuple):
    """Shares of right poses over their scores, both ascending; between two scores linear, beyond them level."""

    scores: tuple[float, ...]
    right: tuple[float, ...]

    def at(self, score: float) -> float:
        """The share at a score."""
        return float(np.interp(score, self.scores, self.right))


CURVES: Mapping[str, Curve] = {
    SEEN: Curve(
        (0.0, 0.7602, 0.7643, 0.8882, 0.8903, 0.9354, 0.9355, 0.949, 0.9559, 0.962, 0.9639, 0.9704, 0.9711, 1.0),
        (0.001, 0.001, 0.167, 0.167, 0.35, 0.35, 0.5, 0.5, 0.583, 0.583, 0.625, 0.625, 0.977, 0.977),
    ),
    BLIND: Curve(
        (0.0507, 0.2467, 0.2487, 0.412, 0.4127, 0.5047, 0.5053, 0.5413, 0.5453, 0.6673, 0.6867, 0.9807, 1.0),
        (0.007, 0.007, 0.01, 0.01, 0.023, 0.023, 0.156, 0.156, 0.206, 0.206, 0.643, 0.643, 0.786),
    ),
    CONTESTED: Curve(
        (0.9635, 0.9723, 0.9804, 0.9963, 0.9992, 1.0),
        (0.5, 0.5, 0.562, 0.562, 0.917, 0.917),
    ),
    OUTWEIGHED: Curve(
        (0.056, 0.8823, 0.8842, 0.9638, 0.9644, 0.9993, 1.0),
        (0.001, 0.001, 0.026, 0.026, 0.054, 0.054, 0.139),
    ),
}


def probability(score: float, rival: float, *, blind: bool, outweighed: bool) -> float:
    """That a model is there, at a pose of this score, and was not told before; see `curve_of`."""
    return CURVES[curve_of(score, rival, blind=blind, outweighed=outweighed)].at(score)


def curve_of(score: float, rival: float, *, blind: bool, outweighed: bool) -> str:
    """Which curve a pose is read from.

    rival : the best score among other poses of the same surface, NaN where there is none
    blind : no scanner position is known; outweighed : it was refused, and another pose is told of its surface
    """
    if outweighed:
        return OUTWEIGHED
    if blind:  # a rival's score says little there: many reach 1
        return BLIND
    return CONTESTED if rival >= score - AS_GOOD else SEEN


def weighed_as_measured(parameters: VerifyParameters) -> bool:
    """Does a score mean what it meant when the curves were measured: are its weights those of the default?"""
    measured = VerifyParameters()
    return (parameters.penalty_weight, parameters.beside_weight) == (measured.penalty_weight, measured.beside_weight)
