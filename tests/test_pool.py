"""Where pairs are drawn from: how the surface around a point bulges, and what that makes of a scene and a model."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from scanfind.cloud import PointChunk
from scanfind.grid.moments import MomentGrid
from scanfind.grid.scene import GridParameters, Scene, build_scene
from scanfind.grid.surfels import Surfels
from scanfind.kernels.shape import FACING, LEAST_AROUND, bulge_of_samples, bulge_of_surfels
from scanfind.library.model import Model, build_model
from scanfind.search.pool import BULGE_BORDERS, Pool, bulge_classes, counts, ratios, shares
from scanfind.simulate.parts import pipe

Floats = NDArray[np.float64]

RADIUS, LENGTH, SIDE = 0.15, 1.6, 3.0


def in_a_room(seed: int, pipes: int, walls: int) -> Floats:
    """Points on a pipe along z that hangs about the origin, and on the walls around it."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi, pipes)
    pipe_points = np.stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), rng.uniform(0, LENGTH, pipes)], axis=1)
    wall_points = rng.uniform(-SIDE, SIDE, (walls, 3))
    wall_points[np.arange(walls), rng.integers(0, 3, walls)] = rng.choice([-SIDE, SIDE], walls)
    return np.concatenate([pipe_points, wall_points])


@cache
def scene() -> Scene:
    """A pipe in a room, seen from four sides."""
    grid = MomentGrid(0.02, np.zeros(3))
    corners = np.array([[x, y, 0.7] for x in (-2.0, 2.0) for y in (-2.0, 2.0)])
    points = in_a_room(0, 40_000, 300_000)
    for corner in corners:
        # What of the pipe faces away is not seen; of the walls all is.
        beside = np.linalg.norm(points[:, :2], axis=1) < 2 * RADIUS
        seen = ~beside | ((points[:, :2] * (corner[:2] - points[:, :2])).sum(axis=1) > 0)
        some = points[seen]
        grid.add(PointChunk(some, {}, np.arange(len(some)), origin=corner))
    return build_scene(grid, LENGTH, GridParameters(), 45.0, 1)


@cache
def model() -> Model:
    return build_model(pipe(RADIUS, LENGTH))


def drawn_from(*, by_shape: bool = True, seed: int = 0, jobs: int = 1) -> Pool:
    return Pool(scene(), [model()], by_shape=by_shape, seed=seed, jobs=jobs)


def on_pipe(pool: Pool) -> NDArray[np.bool_]:
    points = pool.points().points + scene().fine.cells.offset
    return np.asarray(np.linalg.norm(points[:, :2], axis=1) < RADIUS + 0.03)


def bulges(points: Floats, normals: Floats, of: Surfels, reach: float, cuts: tuple[int, ...] = ()) -> Floats:
    """What the kernel says, asked in pieces that end at the cuts."""
    out, at = np.full(len(points), np.nan), of.cells
    ends = [0, *sorted(min(cut, len(points)) for cut in cuts), len(points)]
    for start, stop in pairwise(ends):
        bulge_of_surfels(
            start, stop, points, normals, of.means, of.normals, of.signed, of.first_surfel, of.sides, of.cell,
            at.hash_keys, at.hash_values, at.block_rows, reach, out,
        )  # fmt: skip
    return out


def naive(points: Floats, normals: Floats, means: Floats, directions: Floats, reach: float) -> Floats:
    """The same, every point against every other."""
    told = np.zeros(len(points))
    for k, (point, normal) in enumerate(zip(points, normals, strict=True)):
        off = means - point
        near = (np.linalg.norm(off, axis=1) <= reach) & (directions @ normal >= FACING)
        if np.count_nonzero(near) >= LEAST_AROUND:
            told[k] = (off[near] @ normal).mean() / reach
    return told


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1), st.floats(0.03, 0.3), st.lists(st.integers(0, 60), max_size=3))
def test_a_bulge_is_the_mean_height_of_what_faces_the_same_way(seed: int, reach: float, cuts: list[int]) -> None:
    coarse, some = scene().coarse, np.random.default_rng(seed).integers(0, len(scene().coarse), 20)
    some = some[coarse.has_normal()[some]]
    points, normals = coarse.means[some], coarse.normals[some]
    told = bulges(points, normals, coarse, reach, tuple(cuts))
    np.testing.assert_allclose(told, naive(points, normals, coarse.means, coarse.normals, reach), atol=1e-12)


@settings(deadline=None, max_examples=10)
@given(st.floats(0.05, 0.4), st.integers(1, 300))
def test_a_model_s_bulges_are_of_its_own_samples(reach: float, first: int) -> None:
    samples, told = model().samples, np.empty(first)
    bulge_of_samples(samples.points, samples.normals, np.argsort(samples.points[:, 0], kind="stable"), reach, told)
    points, normals = samples.points[:first], samples.normals[:first]
    np.testing.assert_allclose(told, naive(points, normals, samples.points, samples.normals, reach), atol=1e-12)


def test_pipes_bulge_outwards_walls_do_not_and_corners_inwards() -> None:
    pool = drawn_from(by_shape=False)
    points, normals = pool.points().points, pool.points().normals
    told = bulges(points, normals, scene().coarse, RADIUS)
    at = points + scene().fine.cells.offset
    # Away from its ends; two metres from a wall's borders; a hand's breadth from two walls.
    tube = on_pipe(pool) & (np.abs(at[:, 2] - LENGTH / 2) < LENGTH / 4)
    from_walls = np.sort(SIDE - np.abs(at), axis=1)
    flat, corner = from_walls[:, 1] > 1.0, (from_walls[:, 1] < 0.05) & (from_walls[:, 2] > 1.0)
    assert np.median(told[tube]) == pytest.approx(-0.14, abs=0.02)
    assert np.abs(told[flat & ~on_pipe(pool)]).max() < 0.02
    assert np.median(told[corner]) > BULGE_BORDERS[-1]


def test_without_sides_a_bulge_has_no_sign() -> None:
    told = np.array([-0.3, -0.1, 0.0, 0.1, 0.3])
    np.testing.assert_array_equal(bulge_classes(told, signed=False), bulge_classes(told, signed=False)[::-1])
    assert bulge_classes(told, signed=True)[0] != bulge_classes(told, signed=True)[-1]


def test_pairs_are_drawn_from_what_looks_like_the_model() -> None:
    evenly, chosen = drawn_from(by_shape=False), drawn_from()
    assert on_pipe(evenly).mean() < 0.06
    assert on_pipe(chosen).mean() > 0.5
    # What does not look like it is thinned, not left out: a scan may show another shape than the model has.
    assert np.count_nonzero(~on_pipe(chosen)) > 50


def test_how_many_lie_on_an_instance_is_foreseen() -> None:
    pool = drawn_from()
    assert pool.on(0) == pytest.approx(np.count_nonzero(on_pipe(pool)), rel=0.5)


def test_a_choice_depends_on_its_number_only() -> None:
    pool, again = drawn_from(), drawn_from(jobs=3)
    np.testing.assert_array_equal(pool.surfels, again.surfels)
    first = pool.surfels
    pool.fill(1)
    assert not np.array_equal(pool.surfels, first)
    again.fill(1)
    np.testing.assert_array_equal(pool.surfels, again.surfels)
    pool.fill(0)
    np.testing.assert_array_equal(pool.surfels, first)


def test_what_is_explained_is_not_drawn_again() -> None:
    pool, fine = drawn_from(), scene().fine
    gone = np.zeros(len(fine.cells), np.bool_)
    gone[fine.cell_of[pool.surfels[on_pipe(pool)]]] = True
    pool.withdraw(gone)
    assert pool.refilled(0)
    assert not pool.refilled(0)
    assert not gone[fine.cell_of[pool.surfels]].any()
    pool.withdraw(np.ones(len(gone), np.bool_))
    assert not pool.left()


@given(st.lists(st.integers(0, 1000), min_size=4, max_size=4))
def test_the_likeliest_class_has_all_and_what_is_absent_nothing(there: list[int]) -> None:
    some = np.array(there)
    found = ratios(shares(np.array([0, 0, 1, 3], np.int8), BULGE_BORDERS, 0.01), some)
    assert (found[some == 0] == 0).all()
    assert found.max() == (1.0 if some.any() else 0.0)


def test_classes_are_counted_even_if_empty() -> None:
    np.testing.assert_array_equal(counts(np.array([2, 2], np.int8), BULGE_BORDERS), [0, 0, 2, 0])
