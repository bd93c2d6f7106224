"""How well models are served: what rounds, finds and lines count for, and what a search does not wait for."""

from __future__ import annotations

from dataclasses import replace
from math import exp

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanfind.search.served import MODELS_A_ROUND, MOST_ROUND, RIGHT_PAIR_FINDS, Served
from scanfind.search.surface import SearchParameters

LIMITS = SearchParameters()
EVERY = np.ones(3, np.bool_)
FEW, MANY = MODELS_A_ROUND, MODELS_A_ROUND + 1
NEEDED = -np.log(LIMITS.miss_probability)


def served(most: float = 50.0, limits: SearchParameters = LIMITS) -> Served:
    return Served(3, limits, most)


def pairs(hits: float) -> float:
    """So many right pairs that as many hits are foreseen."""
    return hits / RIGHT_PAIR_FINDS


@given(st.lists(st.tuples(st.floats(0.15, 3.0), st.floats(0.0, 500.0)), min_size=1, max_size=6))
def test_rounds_add_up(rounds: list[tuple[float, float]]) -> None:
    one = served(most=1e9)
    for share, right in rounds:
        one.took(share, EVERY, np.full(3, right))
    foreseen = RIGHT_PAIR_FINDS * sum(right for _, right in rounds)
    assert one.effort == pytest.approx(sum(share for share, _ in rounds))
    assert one.chance_missed() == pytest.approx(exp(-foreseen))
    assert one.enough() == (one.chance_missed() < LIMITS.miss_probability)


def test_the_worst_served_of_those_wanted_counts() -> None:
    one = served()
    one.took(1.0, EVERY, np.array([pairs(9.0), pairs(1.0), pairs(3.0)]))
    assert one.chance_missed() == pytest.approx(exp(-1.0))
    np.testing.assert_array_equal(one.unserved(), [False, True, True])
    one.wanted = np.array([True, False, True])
    assert one.chance_missed() == pytest.approx(exp(-3.0))
    one.wanted = np.array([True, False, False])
    assert one.enough()


def test_of_many_models_those_not_served_are_searched_and_of_few_all() -> None:
    for models in (FEW, MANY):
        one = Served(models, LIMITS, 50.0)
        short = np.arange(models) < 2
        one.took(1.0, np.ones(models, np.bool_), np.where(short, pairs(1.0), pairs(9.0)))
        np.testing.assert_array_equal(one.searched(), short if models == MANY else np.ones(models))
        one.wanted = ~short  # all served: these go on
        np.testing.assert_array_equal(one.searched(), ~short)


def test_a_round_counts_only_for_those_it_was_for() -> None:
    one = served()
    one.took(1.0, np.array([True, False, True]), np.full(3, pairs(9.0)))
    np.testing.assert_array_equal(one.right, [pairs(9.0), 0.0, pairs(9.0)])
    np.testing.assert_array_equal(one.unserved(), [False, True, False])


def test_what_is_out_of_reach_is_not_waited_for_but_told() -> None:
    one = served(most=10.0)
    one.took(1.0, EVERY, np.array([pairs(5.0), pairs(5.0), pairs(0.1)]))
    np.testing.assert_array_equal(one.beyond_reach(), [False, False, True])
    np.testing.assert_array_equal(one.unserved(), [False, False, True])
    assert one.enough()
    # Alone it gets what a model is worth, and no more.
    one.wanted = np.array([False, False, True])
    assert not one.enough()
    one.took(8.0, EVERY, np.zeros(3))
    assert not one.enough()
    one.took(1.0, EVERY, np.zeros(3))
    assert one.enough()
    assert one.unserved().any()


def test_where_all_the_time_is_to_be_used_nothing_is_out_of_reach_or_enough() -> None:
    one = served(limits=replace(LIMITS, miss_probability=0.0))
    assert one.share() == 1.0
    one.took(100.0, EVERY, np.full(3, 1e6))
    assert one.share() == 1.0
    assert not one.beyond_reach().any()
    assert not one.enough()
    assert one.searched().all()


def test_the_next_round_is_what_is_missing_and_what_took_long_comes_in_rounds_as_long_again() -> None:
    one = served()
    first = one.share()
    assert first < 1.0
    one.took(1.0, EVERY, np.full(3, pairs(0.5 * NEEDED)))
    assert 1.0 < one.share() < 1.2  # as much again, and a little more
    one.took(1.0, EVERY, np.full(3, pairs(0.49 * NEEDED)))
    assert one.share() < 0.2
    slow = served(most=1e3)
    slow.took(1.0, EVERY, np.full(3, pairs(0.01 * NEEDED)))
    assert slow.share() == MOST_ROUND
    slow.took(9.0, EVERY, np.full(3, pairs(0.09 * NEEDED)))
    assert slow.share() == 10.0


def test_what_is_found_easily_is_searched_no_longer() -> None:
    one = served()
    one.took(1.0, EVERY, np.full(3, pairs(0.1)))
    one.learn(1, 100, LIMITS.overlap_ratio)
    np.testing.assert_array_equal(one.unserved(), [True, False, True])
    before = one.chance_missed()
    one.learn(0, 1, 1.0)  # all of it shown, and hit but once: nothing is searched longer for that
    assert one.chance_missed() == before


def test_a_round_of_lines_counts_where_they_tell() -> None:
    one = served()
    one.took(1.0, EVERY, np.full(3, pairs(0.1)))
    one.lines_asked(np.array([4.6, 4.6, 0.0]))
    np.testing.assert_array_equal(one.unserved(), [False, False, True])
    one.learn(2, 40, LIMITS.overlap_ratio, by_lines=True)
    assert one.enough()
