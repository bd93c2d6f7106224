"""How likely a pose is right: how often poses of such a score were, in simulated scenes where the truth is known.

The curves are what `python -m benchmarks.calibration` makes of the rows in benchmarks/results/calibration_fit.csv
(isotonic regression: Ayer et al. 1955; Zadrozny & Elkan 2002). docs/score.md says of which scenes, and how well they
hold on others.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scanfind.evidence.verify import VerifyParameters


class Curve(NamedTuple):
    """Shares of right poses over their scores, both ascending; between two scores linear, beyond them level."""

    scores: tuple[float, ...]
    right: tuple[float, ...]

    def at(self, score: float) -> float:
        """The share at a score."""
        return float(np.interp(score, self.scores, self.right))


# Scanner positions known: beams tell what is missing.
SEEN = Curve((0.1, 0.5, 0.9, 1.0), (0.01, 0.05, 0.5, 0.98))
# None known.
BLIND = Curve((0.1, 0.5, 0.9, 1.0), (0.01, 0.05, 0.5, 0.98))
# Another pose was told, that explains more of the same surface, or where nothing else tells shows more of itself.
OUTWEIGHED = Curve((0.1, 0.5, 0.9, 1.0), (0.01, 0.05, 0.1, 0.1))


def probability(score: float, rival: float, *, blind: bool, outweighed: bool) -> float:
    """That a model is there, at a pose of this score, and was not told before.

    rival : the best score among other poses of the same surface, NaN where there is none
    blind : no scanner position is known; outweighed : another pose was told in its stead
    """
    return (OUTWEIGHED if outweighed else BLIND if blind else SEEN).at(score)


def weighed_as_measured(parameters: VerifyParameters) -> bool:
    """Does a score mean what it meant when the curves were measured: are its weights those of the default?"""
    measured = VerifyParameters()
    return (parameters.penalty_weight, parameters.beside_weight) == (measured.penalty_weight, measured.beside_weight)
