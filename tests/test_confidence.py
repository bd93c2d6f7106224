"""Probabilities: curves that rise from 0 to 1, made of the rows that are kept, and what is right of what they tell."""

from __future__ import annotations

from dataclasses import replace
from math import nan
from pathlib import Path

import numpy as np
import pytest
from benchmarks.calibration.candidates import AGAINST_ANOTHER, BELIEVED, REFUSED, Row
from benchmarks.calibration.fit import curve, curves, error_by_chance, expected_error, named, probability
from benchmarks.common import RESULTS
from benchmarks.ledger import read_rows
from benchmarks.page import calibration as page
from hypothesis import given
from hypothesis import strategies as st

from scanfind import find
from scanfind.evidence import confidence
from scanfind.evidence.confidence import (
    AS_GOOD,
    BLIND,
    CONTESTED,
    CURVES,
    OUTWEIGHED,
    SEEN,
    curve_of,
    weighed_as_measured,
)
from scanfind.evidence.verify import VerifyParameters
from scanfind.mesh import Mesh
from scanfind.parameters import PRESETS
from test_find import BRACKET, QUICK, clouds

SHARES = st.floats(0.0, 1.0)
ROW = Row(0, 0, "shop", "phase", "spool", BELIEVED, 0.95, 0.3, 1.0, 0.0, nan, 1, 0.1, 0.01, "spool", 0.1, 1.0)


@pytest.mark.parametrize("name", CURVES)
def test_a_curve_rises_within_0_and_1_and_goes_through_its_knots(name: str) -> None:
    scores, right = CURVES[name]
    assert len(scores) == len(right)
    assert (np.diff(scores) > 0.0).all()
    assert (np.diff(right) >= 0.0).all()
    assert 0.0 < right[0] <= right[-1] < 1.0  # of however many seen, the next may be otherwise
    assert [CURVES[name].at(score) for score in scores] == list(right)


@given(one=SHARES, other=SHARES, rival=st.one_of(SHARES, st.just(nan)), blind=st.booleans(), outweighed=st.booleans())
def test_of_two_on_one_curve_the_better_score_is_no_less_likely(
    one: float, other: float, rival: float, blind: bool, outweighed: bool
) -> None:
    low, high = sorted((one, other))
    if curve_of(low, rival, blind=blind, outweighed=outweighed) == curve_of(
        high, rival, blind=blind, outweighed=outweighed
    ):
        less, more = (confidence.probability(s, rival, blind=blind, outweighed=outweighed) for s in (low, high))
        assert 0.0 <= less <= more <= 1.0


def test_which_curve_a_pose_is_read_from() -> None:
    assert curve_of(0.95, nan, blind=False, outweighed=False) == SEEN
    assert curve_of(0.95, nan, blind=True, outweighed=False) == BLIND
    assert curve_of(0.99, 0.95, blind=False, outweighed=False) == SEEN
    assert curve_of(0.95, 0.99, blind=False, outweighed=True) == OUTWEIGHED
    assert curve_of(0.95, nan, blind=False, outweighed=True) == OUTWEIGHED
    assert curve_of(1.0, 1.0, blind=True, outweighed=False) == BLIND
    for rival in (0.95 - 0.9 * AS_GOOD, 0.95, 1.0):
        assert curve_of(0.95, rival, blind=False, outweighed=False) == CONTESTED


def test_the_curves_are_those_of_the_rows() -> None:
    """Whoever measures anew has to carry the curves over: `python -m benchmarks.calibration --part curves`."""
    assert curves(read_rows(Row, RESULTS / "calibration_fit.csv")[1]) == CURVES


@given(st.lists(st.tuples(SHARES, st.integers(0, 1)), min_size=1, max_size=80))
def test_a_curve_through_rows_rises_whatever_their_order(drawn: list[tuple[float, int]]) -> None:
    rows = [replace(ROW, score=score, right=right) for score, right in drawn]
    made = curve(rows)
    assert (np.diff(made.scores) > 0.0).all()
    assert (np.diff(made.right) >= 0.0).all()
    assert curve(rows[::-1]) == made


def test_a_curve_through_a_step_is_the_step() -> None:
    rows = [replace(ROW, score=k / 200, right=int(k >= 100)) for k in range(200)]
    made = curve(rows)
    half = 0.5 / (100 + 1)
    told = [made.at(score) for score in (0.0, 0.25, 0.495, 0.5, 0.75, 1.0)]
    np.testing.assert_allclose(told, [half] * 3 + [1 - half] * 3, atol=1e-3)


def test_what_is_told_true_has_no_error_and_chance_shows_some() -> None:
    told = np.repeat([0.25, 0.75], 40)
    right = np.tile([1, 0, 0, 0], 10).tolist() + np.tile([1, 1, 1, 0], 10).tolist()
    assert expected_error(told, np.array(right), 2) == 0.0
    assert expected_error(1.0 - told, np.array(right), 2) == 0.5
    assert 0.0 < error_by_chance(told, 2) < 0.1


def test_rows_are_read_as_scanfind_tells_them() -> None:
    assert named(ROW) == SEEN
    assert named(replace(ROW, sensor="blind", told=REFUSED)) == BLIND
    assert named(replace(ROW, told=AGAINST_ANOTHER)) == OUTWEIGHED
    assert named(replace(ROW, told=REFUSED, rival=1.0)) == OUTWEIGHED
    assert named(replace(ROW, rival=1.0)) == CONTESTED
    assert probability(ROW) == CURVES[SEEN].at(ROW.score)


def test_the_page_tells_whether_it_is_held(tmp_path: Path) -> None:
    some = 100 * probability(ROW)
    true = [replace(ROW, seed=k // 4, number=k % 4, right=int((k * 37) % 100 < some)) for k in range(100)]
    wrong = [replace(row, right=0) for row in true]
    for rows, held in ((true, "| held |"), (wrong, "**NOT held**")):
        parts = {"held": page.Measured(["commit: none"], rows)}
        assert held in page.section(parts)
        (drawn,) = page.draw(parts, tmp_path)
        assert drawn.read_text().startswith("<?xml")
    assert page.section({}) == ""
    assert page.draw({}, tmp_path) == []


def test_nobody_measured_what_other_weights_make_of_a_score() -> None:
    assert weighed_as_measured(VerifyParameters(min_score=0.5, inlier_noises=5.0))
    assert not weighed_as_measured(VerifyParameters(penalty_weight=10.0))
    assert not weighed_as_measured(PRESETS["sharif2017"].verify)


def test_a_part_and_one_that_is_a_hair_longer_contest_a_place() -> None:
    again = Mesh.of("again", BRACKET.vertices * 1.0001, BRACKET.faces)
    found = find(clouds(), [BRACKET, again], parameters=QUICK, isolate=False)
    (told,) = found
    assert told.rival == pytest.approx(told.score, abs=AS_GOOD)
    assert told.probability == CURVES[CONTESTED].at(told.score)
    (other,) = [each for each in found.refused if each.model != told.model and each.rival == told.score]
    assert other.probability == CURVES[OUTWEIGHED].at(other.score)
