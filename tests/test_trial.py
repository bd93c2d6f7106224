"""Hypotheses on trial: only of the models sought, and none that hangs in the air."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from scanfind.grid.air import Air, no_air
from scanfind.kernels.search import lie_on_scene
from scanfind.library.joint import JointTable, joint_table
from scanfind.library.model import Model, build_model
from scanfind.priors import Priors
from scanfind.priors.allowed import allowed_poses
from scanfind.search import served, surface
from scanfind.search.draws import Draws, Pairs, Trial, affordable, air_table, wald_table
from scanfind.search.hypotheses import Hypotheses, model_arrays
from scanfind.search.pool import Pool
from scanfind.search.surface import Search, SearchParameters
from scanfind.simulate.parts import pipe
from test_pool import LENGTH, RADIUS, scene

TESTS = 192


@cache
def models() -> tuple[Model, ...]:
    """The pipe that is there, and two that are not."""
    return tuple(
        build_model(pipe(radius, length))
        for radius, length in ((RADIUS, LENGTH), (0.8 * RADIUS, LENGTH), (RADIUS, 1.3))
    )


@cache
def table() -> JointTable:
    return joint_table(models())


@cache
def drawn() -> tuple[Draws, Pairs]:
    pool = Pool(scene(), models(), by_shape=True, seed=0, jobs=1)
    search = Search(scene(), models(), model_arrays(models()), SearchParameters(), 0, 1)
    draws = Draws(pool.points(), search.pairs, search.rungs, 0.02, 1)
    return draws, affordable(draws.draw(500, 0, 0, 1000), np.diff(table().offsets), 30_000, rarest_first=True)


def passed(sought: NDArray[np.bool_], air: Air | None = None, jobs: int = 1) -> Hypotheses:
    draws, pairs = drawn()
    trial = Trial(
        table(), model_arrays(models()), scene().tolerant, scene().origins(), air or no_air(),
        wald_table(TESTS, 0.3, 0.15), air_table(TESTS), 0.0, allowed_poses(models(), Priors(), np.zeros(3)), sought,
    )  # fmt: skip
    return trial.test(pairs, draws.points, jobs)


def same(one: Hypotheses, other: Hypotheses) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


EVERY = np.ones(3, np.bool_)


def test_only_models_that_are_sought_are_tested_and_those_as_ever() -> None:
    every = passed(EVERY)
    assert set(every.models.tolist()) == {0, 1, 2}
    for number in range(3):
        some = passed(np.arange(3) == number)
        assert same(some, every.take(np.flatnonzero(every.models == number)))


def test_threads_try_the_same() -> None:
    assert same(passed(EVERY, scene().air, jobs=2), passed(EVERY, scene().air))


def pipe_at(beside: float, least: int, air: Air) -> tuple[int, int]:
    """Hits and samples tested of the pipe that stands there, put so far beside where it does, metres."""
    samples, marks, never = model_arrays(models()[:1]).samples, scene().tolerant, np.full(TESTS + 1, least)
    hits, looked = lie_on_scene(
        samples, 0, len(samples), never, air_table(TESTS), np.eye(3), np.array([beside, 0.0, 0.0]), scene().origins(),
        1.0 / marks.cell, *marks[1:], 1.0 / air.cell, *air[1:],
    )  # fmt: skip
    return int(hits), int(looked)


def test_what_hangs_in_the_air_is_given_up_and_what_is_there_is_not() -> None:
    for air in (no_air(), scene().air):
        hits, looked = pipe_at(0.0, 0, air)
        assert looked == TESTS
        assert hits > 0.9 * TESTS
    assert pipe_at(1.0, 0, no_air()) == (0, TESTS)  # nothing is there, which alone ends nothing here
    assert pipe_at(1.0, 0, scene().air)[1] == -1
    everywhere = scene().air._replace(cells=np.full_like(scene().air.cells, np.iinfo(np.uint64).max))
    assert pipe_at(0.0, 0, everywhere)[1] == -1
    assert same(passed(EVERY), passed(EVERY, scene().air))  # all that pass without lie on the pipe


def test_what_a_pair_costs_is_counted_of_the_models_sought() -> None:
    keys = np.repeat(np.arange(len(table().offsets) - 1), np.diff(table().offsets))
    for sought in (EVERY, ~EVERY, np.array([True, False, True])):
        naive = np.bincount(keys[sought[table().model]], minlength=len(table().offsets) - 1)
        np.testing.assert_array_equal(table().entries_of(sought), naive)


def test_a_model_that_is_served_is_tested_no_more_and_lines_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(served, "MODELS_A_ROUND", 2)
    search = Search(scene(), models(), model_arrays(models()), SearchParameters(), 0, 1)
    search.served.lines_asked(np.array([4.7, 0.0, 4.7]))
    found = search.round()
    assert set(found.models.tolist()) == {1}
    assert search.served.right[1] > 0.0
    assert search.served.right[[0, 2]].tolist() == [0.0, 0.0]


def test_a_long_round_draws_from_new_surfels_again_and_again(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn_from: list[NDArray[np.intp]] = []
    fill = Pool.fill

    def noted(self: Pool, number: int) -> None:
        fill(self, number)
        drawn_from.append(self.surfels)

    monkeypatch.setattr(Pool, "fill", noted)
    monkeypatch.setattr(served.Served, "share", lambda self: 2.5 * surface.A_CHOICE)
    search = Search(scene(), models(), model_arrays(models()), SearchParameters(), 0, 1)
    found = search.round()
    assert len(drawn_from) == 3  # the first was chosen when the search began
    assert len({surfels.tobytes() for surfels in drawn_from}) == 3
    assert search.served.effort == 2.5 * surface.A_CHOICE
    assert (np.diff(found.support) <= 0.0).all()
