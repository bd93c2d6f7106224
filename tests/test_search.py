"""The search's parts: draws that depend on nothing but their number, Wald's test, masks of orientation."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from scanfind.cloud import PointChunk
from scanfind.grid.moments import MomentGrid
from scanfind.grid.scene import orientation_grid
from scanfind.grid.surfels import Surfels
from scanfind.kernels.blocks import block_in, find_block, pack_block
from scanfind.kernels.search import draw_firsts, draw_seconds, normal_bit
from scanfind.library.self_similar import cube_turns
from scanfind.search.draws import BINS_A_DISTANCE, bin_pool, wald_table
from scanfind.threads import in_threads

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

DISTANCE, TOLERANCE = 0.8, 0.03


def room(count: int = 30_000, cell: float = 0.05) -> Surfels:
    """The inside of a box of 2 × 2 × 2 m about the origin, seen from its middle."""
    rng = np.random.default_rng(1)
    points = rng.uniform(-1, 1, (count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = rng.choice([-1.0, 1.0], count)
    grid = MomentGrid(cell, np.zeros(3))
    grid.add(PointChunk(points, {}, np.arange(count), origin=np.full(3, 0.1)))
    return Surfels(grid).fit()


@pytest.fixture(scope="module")
def surfels() -> Surfels:
    return room()


def draw(
    surfels: Surfels, pool: NDArray[np.intp], count: int, seed: int = 5, cuts: tuple[int, ...] = (), tries: int = 1000
) -> tuple[Ints, Ints]:
    """`count` pairs of the pool at DISTANCE ± TOLERANCE, drawn in pieces that end at the cuts."""
    bins = bin_pool(pool, surfels.means, DISTANCE, TOLERANCE)
    first, second = np.full(count, -7, np.int64), np.full(count, -7, np.int64)
    draw_firsts(seed, 3, len(pool), first)
    order = np.argsort(bins.bin_of[first], kind="stable")
    for start, stop in pairwise([0, *sorted(cuts), count]):
        draw_seconds(
            start, stop, order, first, seed, 3, bins.keys, bins.bin_of, bins.hash_keys, bins.hash_values, bins.starts,
            bins.points, bins.shell, DISTANCE, TOLERANCE, tries, second,
        )  # fmt: skip
    return bins.pool[first], np.where(second >= 0, bins.pool[second], second)


def test_pairs_are_of_the_pool_and_at_the_distance(surfels: Surfels) -> None:
    pool = np.flatnonzero(surfels.means[:, 2] > -0.5)
    first, second = draw(surfels, pool, 5000)
    met = second >= 0
    assert met.mean() > 0.99
    assert (second[~met] == -1).all()
    assert np.isin(first, pool).all()
    assert np.isin(second[met], pool).all()
    apart = np.linalg.norm(surfels.means[first[met]] - surfels.means[second[met]], axis=1)
    assert np.abs(apart - DISTANCE).max() <= TOLERANCE + 1e-12


@settings(deadline=None, max_examples=25)
@given(st.lists(st.integers(0, 2000), max_size=6), st.integers(0, 2**63 - 1))
def test_a_draw_depends_on_its_number_only(surfels: Surfels, cuts: list[int], seed: int) -> None:
    pool = np.arange(len(surfels.means))
    whole, pieces = draw(surfels, pool, 2000, seed), draw(surfels, pool, 2000, seed, tuple(cuts))
    np.testing.assert_array_equal(whole, pieces)
    fewer = draw(surfels, pool, 700, seed)
    np.testing.assert_array_equal(fewer, np.array(whole)[:, :700])


def test_seeds_draw_different_pairs(surfels: Surfels) -> None:
    pool = np.arange(len(surfels.means))
    one, other = draw(surfels, pool, 2000, 0)[0], draw(surfels, pool, 2000, 1)[0]
    assert (one == other).mean() < 0.05


def test_first_points_are_drawn_evenly(surfels: Surfels) -> None:
    pool = np.arange(0, len(surfels.means), 50)
    first, _ = draw(surfels, pool, 40_000, tries=1)
    counts = np.bincount(np.searchsorted(pool, first), minlength=len(pool))
    mean = 40_000 / len(pool)
    # χ² of so many degrees of freedom, five sigma.
    assert ((counts - mean) ** 2).sum() / mean < len(pool) + 5 * np.sqrt(2 * len(pool))


def test_nothing_at_the_distance_is_said(surfels: Surfels) -> None:
    near = np.flatnonzero(np.linalg.norm(surfels.means - [1, 1, 1], axis=1) < 0.3)
    _, second = draw(surfels, near, 100)
    assert (second == -1).all()


def test_the_pool_s_bins_hold_each_surfel_once(surfels: Surfels) -> None:
    pool = np.arange(0, len(surfels.means), 3)
    bins = bin_pool(pool, surfels.means, 0.2 * BINS_A_DISTANCE, TOLERANCE)
    np.testing.assert_array_equal(np.sort(bins.pool), pool)
    assert bins.starts[0] == 0
    assert bins.starts[-1] == len(pool)
    where = np.floor(surfels.means[bins.pool] / 0.2).astype(int)
    for place, at in enumerate(where.tolist()):
        number = find_block(bins.hash_keys, bins.hash_values, pack_block(*at))
        assert bins.starts[number] <= place < bins.starts[number + 1]
        assert bins.bin_of[place] == number
        assert bins.keys[number] == pack_block(*at)


def test_seconds_are_drawn_evenly_among_all_at_the_distance(surfels: Surfels) -> None:
    pool = np.arange(0, len(surfels.means), 4)
    first, _ = draw(surfels, pool, 60_000)
    one = np.bincount(first).argmax()
    bins = bin_pool(pool, surfels.means, DISTANCE, TOLERANCE)
    # Every partner there is comes up, and none more often than chance has it: five sigma of χ².
    count, drawn = 40_000, np.full(40_000, np.flatnonzero(bins.pool == one)[0])
    seconds = np.empty(count, np.int64)
    draw_seconds(
        0, count, np.arange(count), drawn, 9, 3, bins.keys, bins.bin_of, bins.hash_keys, bins.hash_values, bins.starts,
        bins.points, bins.shell, DISTANCE, TOLERANCE, 1000, seconds,
    )  # fmt: skip
    apart = np.linalg.norm(bins.points - surfels.means[one], axis=1)
    partners = np.flatnonzero(np.abs(apart - DISTANCE) <= TOLERANCE)
    counts = np.bincount(seconds, minlength=len(bins.points))
    assert counts.sum() == counts[partners].sum() == count
    mean = count / len(partners)
    assert ((counts[partners] - mean) ** 2).sum() / mean < len(partners) + 5 * np.sqrt(2 * len(partners))


@pytest.mark.parametrize("jobs", [1, 2, 3, 16])
@pytest.mark.parametrize("count", [0, 1, 7, 1000])
def test_threads_share_a_range_without_gap_or_overlap(jobs: int, count: int) -> None:
    done = in_threads(jobs, count, lambda start, stop: list(range(start, stop)))
    assert [k for piece in done for k in piece] == list(range(count))


# ── Wald's test ──

chances = st.tuples(st.floats(0.02, 0.4), st.floats(0.05, 0.9))


@given(st.integers(10, 500), chances)
def test_wald_never_gives_up_a_perfect_hypothesis(tests: int, chance: tuple[float, float]) -> None:
    wrong, right = chance
    least = wald_table(tests, min(right, 0.95), wrong)
    assert len(least) == tests + 1
    assert least[0] == 0
    assert (np.diff(least) >= 0).all()
    assert (least <= np.arange(tests + 1)).all()


def survivors(least: Ints, chance: float, runs: int = 4000) -> tuple[float, float]:
    """Share of hypotheses that pass when samples hit with a chance, and the mean number of samples looked at."""
    hits = np.cumsum(np.random.default_rng(2).random((runs, len(least) - 1)) < chance, axis=1)
    lost = hits < least[1:]
    looked = np.where(lost.any(axis=1), lost.argmax(axis=1) + 1, len(least) - 1)
    return float((~lost.any(axis=1)).mean()), float(looked.mean())


@pytest.mark.parametrize(("right", "wrong"), [(0.33, 0.1), (0.4, 0.15), (0.6, 0.2)])
def test_wald_keeps_the_right_and_ends_the_wrong_early(right: float, wrong: float) -> None:
    least = wald_table(192, right, wrong)
    kept, _ = survivors(least, right)
    believed, looked = survivors(least, wrong)
    assert kept > 0.93  # 2 % in the course of it and 2.3 % (two sigma) at its end
    assert believed < 0.01
    assert looked < 40


# ── orientation masks ──


@pytest.mark.parametrize("signed", [True, False])
def test_a_surfel_marks_its_own_cell_and_those_along_its_normal(signed: bool) -> None:
    surfels = room()
    surfels.signed = signed
    grid = orientation_grid(surfels.oriented(), 0.1, 0.2)
    marked = 0
    for mean, normal in zip(surfels.means[::7], surfels.normals[::7], strict=True):
        if not normal.any():
            continue
        for along in (0.0, 0.1, -0.1):
            at = np.floor((mean + along * normal) / 0.2).astype(int)
            block = block_in(grid.where, *(at >> 3).tolist())
            mask = int(grid.masks[block, int((at[0] & 7) << 6 | (at[1] & 7) << 3 | (at[2] & 7))])
            assert block >= 0
            assert mask & int(normal_bit(*normal))
            assert not signed or not mask & int(normal_bit(*-normal))
            assert signed or mask & int(normal_bit(*-normal))
        marked += 1
    assert marked > 100


@settings(deadline=None)
@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1), st.floats(1e-3, 1e3))
def test_directions_have_one_bit_of_54(way: tuple[float, float, float], length: float) -> None:
    bit = int(normal_bit(*way))
    assert bit.bit_count() == 1
    assert bit < 1 << 54
    x, y, z = (np.array(way) * length).tolist()
    off_border = all(abs(abs(c) / max(map(abs, way)) - b) > 1e-9 for c in way for b in (1 / 3, 1.0))
    if off_border or length == 1.0:
        assert int(normal_bit(x, y, z)) == bit


# ── the turns of a cube ──


def test_the_turns_of_a_cube_are_a_group_of_24() -> None:
    turns = cube_turns()
    names = {tuple(turn.astype(int).ravel().tolist()) for turn in turns}
    assert len(turns) == len(names) == 24
    assert tuple(np.eye(3, dtype=int).ravel().tolist()) in names
    for one in turns:
        assert np.linalg.det(one) == pytest.approx(1.0)
        np.testing.assert_array_equal(one @ one.T, np.eye(3))
        assert all(tuple((one @ other).astype(int).ravel().tolist()) in names for other in turns)
