"""Curves through rows, and how far what they tell is from what is right."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from math import isnan

import numpy as np
from numpy.typing import NDArray

from benchmarks.calibration.candidates import AGAINST_ANOTHER, REFUSED, Row
from benchmarks.common import Floats
from scanfind.evidence.confidence import CURVES, Curve, curve_of


def curves(rows: Sequence[Row]) -> dict[str, Curve]:
    """What evidence.confidence.CURVES are to be."""
    return {name: curve([row for row in rows if named(row) == name]) for name in CURVES}


def named(row: Row) -> str:
    """Which curve a row is of."""
    outweighed = row.told == AGAINST_ANOTHER or (row.told == REFUSED and not isnan(row.rival))
    return curve_of(row.score, row.rival, blind=row.sensor == "blind", outweighed=outweighed)


def probability(row: Row) -> float:
    """What scanfind tells of a row."""
    return CURVES[named(row)].at(row.score)


def curve(rows: Sequence[Row]) -> Curve:
    """The isotonic curve through rows: level over each group of neighbours that have one share."""
    pooled: list[list[Row]] = []
    for _, tied in groupby(sorted(rows, key=score), key=score):
        pooled.append(list(tied))
        while len(pooled) > 1 and not rises(*pooled[-2:]):
            last = pooled.pop()
            pooled[-1] += last
    knots: dict[float, float] = {}
    for group in pooled:
        for end in (group[0], group[-1]):
            knots.setdefault(round(end.score, 4), min(max(round(share(group), 3), 0.001), 0.999))
    return Curve(tuple(knots), tuple(knots.values()))


def score(row: Row) -> float:
    """By what rows are ranked."""
    return row.score


def rises(lower: Sequence[Row], upper: Sequence[Row]) -> bool:
    """Is more of a group right than of the one below it, and would be if little were known of them?"""
    means = [sum(row.right for row in group) / len(group) for group in (lower, upper)]
    return means[0] < means[1] and share(lower) < share(upper)


def share(group: Sequence[Row]) -> float:
    """How much of a group is right, and half a candidate besides, and half a one wrong (Jeffreys): of however many none
    was wrong, the next may be.
    """
    return (sum(row.right for row in group) + 0.5) / (len(group) + 1.0)


def bins(told: Floats, count: int) -> list[NDArray[np.int64]]:
    """The candidates (numbers) in so many bins of equally many, by what was told."""
    return np.array_split(np.argsort(told, kind="stable"), count)


def expected_error(told: Floats, right: NDArray[np.int64], count: int) -> float:
    """Expected calibration error (Naeini et al. 2015): mean over the candidates of |told − right| of their bin."""
    parts = bins(told, count)
    return float(sum(len(k) * abs(told[k].mean() - right[k].mean()) for k in parts if len(k)) / len(told))


def error_by_chance(told: Floats, count: int, draws: int = 1000) -> float:
    """The median of that error were everything told true, for so few candidates show some."""
    rng = np.random.default_rng(0)
    errors = [expected_error(told, (rng.random(len(told)) < told).astype(np.int64), count) for _ in range(draws)]
    return float(np.median(errors))
