"""Curves through rows, and how far what they tell is from what is right."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from benchmarks.calibration.candidates import AGAINST_ANOTHER, Row
from benchmarks.common import Floats
from scanfind.evidence.confidence import CURVES, Curve, curve_of

# Of fewer candidates a share says little: 20 of which all are right are right with 0.98 ± 0.03.
LEAST = 20


def curves(rows: Sequence[Row]) -> dict[str, Curve]:
    """What evidence.confidence.CURVES are to be."""
    return {name: curve([row for row in rows if named(row) == name]) for name in CURVES}


def named(row: Row) -> str:
    """Which curve a row is of."""
    return curve_of(row.score, row.rival, blind=row.sensor == "blind", outweighed=row.told == AGAINST_ANOTHER)


def probability(row: Row) -> float:
    """What scanfind tells of a row."""
    return CURVES[named(row)].at(row.score)


def curve(rows: Sequence[Row]) -> Curve:
    """The isotonic curve through rows: level over each group of neighbours that share a share.

    Groups begin as LEAST neighbours by score, or more. To each a half is added that was right and a half that was not
    (Jeffreys): of however many none was wrong, the next may be.
    """
    ranked = sorted(rows, key=lambda row: row.score)
    groups = [list(some) for some in np.array_split(np.arange(len(ranked)), max(1, len(ranked) // LEAST)) if len(some)]
    pooled: list[list[int]] = []
    for group in groups:
        pooled.append(group)
        while len(pooled) > 1 and share(ranked, pooled[-2]) >= share(ranked, pooled[-1]):
            last = pooled.pop()
            pooled[-1] = pooled[-1] + last
    knots: dict[float, float] = {}
    for group in pooled:
        for end in (group[0], group[-1]):
            knots.setdefault(round(ranked[end].score, 4), round(share(ranked, group), 3))
    return Curve(tuple(knots), tuple(knots.values()))


def share(rows: Sequence[Row], group: Sequence[int]) -> float:
    """Of a group of rows, by number, the share that is right."""
    return (sum(rows[k].right for k in group) + 0.5) / (len(group) + 1.0)


def bins(told: Floats, right: NDArray[np.int64], count: int) -> list[NDArray[np.int64]]:
    """The candidates (numbers) in so many bins of equally many, by what was told."""
    return np.array_split(np.argsort(told, kind="stable"), count)


def expected_error(told: Floats, right: NDArray[np.int64], count: int) -> float:
    """Expected calibration error (Naeini et al. 2015): mean over the candidates of |told − right| of their bin."""
    parts = bins(told, right, count)
    return float(sum(len(k) * abs(told[k].mean() - right[k].mean()) for k in parts if len(k)) / len(told))


def error_by_chance(told: Floats, count: int, draws: int = 1000) -> float:
    """The median of that error were everything told true, for so few candidates show some."""
    rng = np.random.default_rng(0)
    errors = [expected_error(told, (rng.random(len(told)) < told).astype(np.int64), count) for _ in range(draws)]
    return float(np.median(errors))
