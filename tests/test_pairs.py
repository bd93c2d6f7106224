"""Pairs of oriented points: features no motion changes, keys brute force agrees with, poses of least squares."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import naive
from scanfind.cloud import OrientedCloud
from scanfind.errors import InvalidGeometryError
from scanfind.kernels.features import feature_key
from scanfind.kernels.pair_pose import fit_pairs
from scanfind.kernels.search import key_pairs
from scanfind.library.pairs import PairParameters, build_pairs, key_count, rung_distance, rungs_of
from scanfind.pose import Pose, random_rotation

Floats = NDArray[np.float64]
Pair = tuple[Floats, Floats, Floats, Floats]

seeds = st.integers(0, 2**32 - 1)


def directions(rng: np.random.Generator, count: int) -> Floats:
    ways = rng.standard_normal((count, 3))
    unit: Floats = ways / np.linalg.norm(ways, axis=1)[:, None]
    return unit


def some_pose(rng: np.random.Generator) -> Pose:
    return Pose(random_rotation(rng), rng.uniform(-10, 10, 3))


def some_pair(rng: np.random.Generator, apart: float | None = None) -> Pair:
    """Two oriented points 0.3 … 3 m apart: p, n, q, m."""
    p, (n, m, way) = rng.uniform(-2, 2, 3), directions(rng, 3)
    return p, n, p + way * (apart or rng.uniform(0.3, 3.0)), m


def moved(pose: Pose, pair: Pair) -> Pair:
    p, n, q, m = pair
    return pose.move(p), pose.turn(n), pose.move(q), pose.turn(m)


def jolted(rng: np.random.Generator, pair: Pair, degrees: float, stretch: float) -> Pair:
    """The pair as a noisy scan has it: normals turned about any axis, one point shifted along the pair."""
    p, n, q, m = pair
    n, m = (Pose.from_rotation_vector(np.radians(degrees) * directions(rng, 1)[0]).turn(x) for x in (n, m))
    return p, n, q + stretch * (q - p), m


def fit(model: Pair, scene: Pair, length: float) -> Pose:
    m1, a1, m2, a2 = (np.ascontiguousarray(x[None]) for x in model)
    s1, b1, s2, b2 = (np.ascontiguousarray(x[None]) for x in scene)
    rotations, translations = np.empty((1, 3, 3)), np.empty((1, 3))
    fit_pairs(m1, a1, m2, a2, s1, b1, s2, b2, length, rotations, translations)
    return Pose(rotations[0], translations[0])


def roll_is_sure(*pairs: Pair) -> bool:
    """Do the normals stand well off the line through the points, and not against each other there?"""
    for p, n, q, m in pairs:
        d = (q - p) / np.linalg.norm(q - p)
        across = [x - d * (x @ d) for x in (n, m)]
        if np.linalg.norm(across[0] + across[1]) < 0.5 or min(map(float, map(np.linalg.norm, across))) < 0.4:
            return False
    return True


# ── poses of pairs ──


@settings(deadline=None)  # the first call compiles
@given(seeds, st.sampled_from([0.0, 0.01, 0.3, 1.0]))
def test_a_pair_that_was_only_moved_gives_the_motion(seed: int, length: float) -> None:
    rng = np.random.default_rng(seed)
    pair, pose = some_pair(rng), some_pose(rng)
    if not roll_is_sure(pair):
        return
    found = fit(pair, moved(pose, pair), length)
    np.testing.assert_allclose(found.matrix(), pose.matrix(), rtol=0, atol=1e-11)


@settings(deadline=None)  # the first call compiles
@given(seeds, st.floats(0.3, 2.0), st.floats(0.0, 12.0), st.floats(-0.05, 0.05))
def test_the_pose_is_the_least_squares_one_of_the_four_point_sets(
    seed: int, length: float, degrees: float, stretch: float
) -> None:
    rng = np.random.default_rng(seed)
    model = some_pair(rng)
    scene = jolted(rng, moved(some_pose(rng), model), degrees, stretch)
    if not roll_is_sure(model, scene):
        return
    found = fit(model, scene, length)
    rotation, translation = naive.kabsch(naive.four_points(*model, length), naive.four_points(*scene, length))
    np.testing.assert_allclose(found.rotation, rotation, rtol=0, atol=1e-7)
    np.testing.assert_allclose(found.translation, translation, rtol=0, atol=1e-6)


@settings(deadline=None)  # the first call compiles
@given(seeds, st.floats(0.0, 12.0))
def test_without_length_it_is_the_limit_of_short_normals(seed: int, degrees: float) -> None:
    rng = np.random.default_rng(seed)
    model = some_pair(rng, 1.0)
    scene = jolted(rng, moved(some_pose(rng), model), degrees, 0.0)
    if not roll_is_sure(model, scene):
        return
    short = 1e-5
    rotation, translation = naive.kabsch(naive.four_points(*model, short), naive.four_points(*scene, short))
    found = fit(model, scene, 0.0)
    # The axis gives way by as much as the normals are long.
    np.testing.assert_allclose(found.rotation, rotation, rtol=0, atol=5 * short)
    np.testing.assert_allclose(found.translation, translation, rtol=0, atol=50 * short)


@settings(deadline=None)  # the first call compiles
@given(seeds, st.sampled_from([0.0, 0.5, 1.0]))
def test_a_fitted_pose_is_rigid(seed: int, length: float) -> None:
    rng = np.random.default_rng(seed)
    found = fit(some_pair(rng), some_pair(rng), length)
    if np.isfinite(found.rotation).all():
        np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), rtol=0, atol=1e-12)
        assert np.linalg.det(found.rotation) == pytest.approx(1.0, abs=1e-12)


@settings(deadline=None)  # the first call compiles
@given(seeds, st.sampled_from([0.0, 1.0]))
def test_fitting_moves_with_the_scene_and_with_the_model(seed: int, length: float) -> None:
    rng = np.random.default_rng(seed)
    model = some_pair(rng)
    scene, one, other = jolted(rng, model, 8.0, 0.02), some_pose(rng), some_pose(rng)
    if not roll_is_sure(model, scene):
        return
    found = fit(moved(one, model), moved(other, scene), length)
    expected = other @ fit(model, scene, length) @ one.inverse()
    np.testing.assert_allclose(found.matrix(), expected.matrix(), rtol=0, atol=1e-7)


@settings(deadline=None)  # the first call compiles
@given(seeds, st.sampled_from([0.0, 1.0]), st.sampled_from([(1, 1), (1, -1), (-1, -1)]))
def test_normals_along_the_pair_leave_the_roll_open(seed: int, length: float, sides: tuple[int, int]) -> None:
    rng = np.random.default_rng(seed)
    p, _, q, _ = some_pair(rng)
    d = (q - p) / np.linalg.norm(q - p)
    pair = p, sides[0] * d, q, sides[1] * d
    assert np.isnan(fit(pair, moved(some_pose(rng), pair), length).rotation).all()


# ── features and keys ──


def key_of(feature: Floats, parameters: PairParameters) -> int:
    return int(feature_key(*np.cos(feature).tolist(), parameters.edges))


def off_the_borders(feature: Floats, parameters: PairParameters) -> bool:
    share = np.degrees(feature) / parameters.angle_cell_deg
    return bool((np.abs(share - share.round()) > 1e-6).all())


@settings(deadline=None)  # the first call compiles
@given(seeds, st.floats(3.0, 60.0))
def test_keys_are_the_feature_s_cell_and_no_motion_changes_them(seed: int, angle_cell: float) -> None:
    rng = np.random.default_rng(seed)
    parameters = PairParameters(angle_cell_deg=angle_cell)
    pair = some_pair(rng)
    feature = naive.feature(*pair)
    np.testing.assert_allclose(naive.feature(*moved(some_pose(rng), pair)), feature, rtol=0, atol=1e-6)
    if not off_the_borders(feature, parameters):
        return
    bins = parameters.angle_bins()
    b1, b2, b3 = (int(np.degrees(angle) // parameters.angle_cell_deg) for angle in feature)
    for p, n, q, m in (pair, moved(some_pose(rng), pair)):
        keys = np.empty(1, np.int64)
        ends, normals = np.stack([p, q]), np.stack([n, m])
        numbers = np.array([0]), np.array([1]), np.array([0])
        key_pairs(*numbers, ends, normals, parameters.edges, keys)
        assert keys[0] == (b1 * bins + b2) * bins + b3
    assert keys[0] < parameters.cells_per_rung()


@settings(deadline=None)  # the first call compiles
@given(seeds)
def test_signs_turn_the_normals(seed: int) -> None:
    p, n, q, m = some_pair(np.random.default_rng(seed))
    parameters = PairParameters()
    keys, numbers = np.empty(4, np.int64), (np.zeros(4, np.int64), np.ones(4, np.int64), np.arange(4))
    key_pairs(*numbers, np.stack([p, q]), np.stack([n, m]), parameters.edges, keys)
    for k, (one, two) in enumerate([(1, 1), (-1, 1), (1, -1), (-1, -1)]):
        feature = naive.feature(p, one * n, q, two * m)
        if off_the_borders(feature, parameters):
            assert keys[k] == key_of(feature, parameters)


@pytest.mark.parametrize("extreme", [0.0, np.pi])
@settings(deadline=None)  # the first call compiles
@given(angle_cell=st.floats(3.0, 90.0))
def test_the_ends_of_the_range_have_a_cell(extreme: float, angle_cell: float) -> None:
    parameters = PairParameters(angle_cell_deg=angle_cell)
    assert 0 <= key_of(np.full(3, extreme), parameters) < parameters.cells_per_rung()


@settings(max_examples=20, deadline=None)
@given(seeds, st.integers(2, 60), st.floats(0.02, 0.3))
def test_pairs_are_those_brute_force_finds(seed: int, count: int, spacing: float) -> None:
    rng = np.random.default_rng(seed)
    samples = OrientedCloud(rng.uniform(-1, 1, (count, 3)), directions(rng, count))
    parameters = PairParameters()
    table = build_pairs(samples, 2.0, spacing, parameters)
    assert (np.diff(table.keys) >= 0).all()
    assert ((table.keys >= 0) & (table.keys < key_count(parameters))).all()

    expected = defaultdict(set)
    for rung in rungs_of(2.0, parameters):
        for i in range(count):
            for j in range(count):
                apart = np.linalg.norm(samples.points[i] - samples.points[j])
                if i != j and abs(apart - rung_distance(rung, parameters)) <= parameters.tolerance * spacing:
                    feature = naive.feature(
                        samples.points[i], samples.normals[i], samples.points[j], samples.normals[j]
                    )
                    if not off_the_borders(feature, parameters):
                        return
                    expected[rung * parameters.cells_per_rung() + key_of(feature, parameters)].add((i, j))
    found = defaultdict(set)
    for key, i, j in zip(*(column.tolist() for column in table), strict=True):
        found[key].add((i, j))
    assert found == expected
    assert sum(map(len, found.values())) == len(table.keys)
    both_ways = {pair for pairs in found.values() for pair in pairs}
    assert both_ways == {(j, i) for i, j in both_ways}


@settings(deadline=None)  # the first call compiles
@given(st.floats(2e-3, 100.0), st.floats(0.05, 1.0), st.integers(1, 64))
def test_the_ladder_has_a_rung_near_every_distance(diameter: float, share: float, rungs: int) -> None:
    parameters = PairParameters(distances=(share,), rungs_per_octave=rungs)
    (rung,) = rungs_of(diameter, parameters)
    wanted = share * diameter
    if wanted >= 1e-3:
        assert abs(np.log2(rung_distance(rung, parameters) / wanted)) <= 0.5 / rungs + 1e-9


def test_equal_rungs_are_used_once() -> None:
    parameters = PairParameters(distances=(0.75, 0.751, 0.4))
    rungs = rungs_of(3.6, parameters)
    assert len(rungs) == 2
    assert rungs == sorted(rungs, reverse=True)


@pytest.mark.parametrize("count", [0, 1])
def test_a_single_point_has_no_pairs(count: int) -> None:
    with pytest.raises(InvalidGeometryError, match="two samples"):
        build_pairs(OrientedCloud(np.zeros((count, 3)), np.zeros((count, 3))), 1.0, 0.1, PairParameters())
