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
        (0.0, 0.493, 0.4936, 0.6017, 0.6023, 0.7345, 0.7353, 0.8882, 0.8885, 0.9207, 0.9214, 0.9255, 0.9345, 0.9658,
         0.967, 0.9999, 1.0),
        (0.001, 0.001, 0.02, 0.02, 0.03, 0.03, 0.207, 0.207, 0.346, 0.346, 0.5, 0.5, 0.646, 0.646,
         0.958, 0.958, 0.975),
    ),
    BLIND: Curve(
        (0.0013, 0.3573, 0.3587, 0.392, 0.3927, 0.442, 0.4433, 0.47, 0.4707, 0.686, 0.6867, 0.7167, 0.7193, 0.8587,
         0.8687, 0.9807, 1.0),
        (0.002, 0.002, 0.02, 0.02, 0.041, 0.041, 0.046, 0.046, 0.084, 0.084, 0.15, 0.15, 0.204, 0.204,
         0.694, 0.694, 0.929),
    ),
    CONTESTED: Curve(
        (0.9064, 0.9522, 0.9584, 0.9967, 0.997, 1.0),
        (0.214, 0.214, 0.567, 0.567, 0.967, 0.967),
    ),
    OUTWEIGHED: Curve(
        (0.048, 0.9809, 0.9814, 0.997, 0.9973, 1.0),
        (0.001, 0.001, 0.062, 0.062, 0.068, 0.068),
    ),
}  # fmt: skip


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
