"""The last fit of a pose: its covariance is true, moves with the scene, and is silent on what the data leave open."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from benchmarks.uncertainty import chi2_quantile, error_of, kolmogorov, normalised
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from scanfind.cloud import OrientedCloud
from scanfind.detection import Detection, IsolatedPoints
from scanfind.fit.patches import followed, measured
from scanfind.fit.polish import Polished, polish, polished
from scanfind.fit.refine import RefineParameters
from scanfind.isolation.deviation import deviation_of
from scanfind.kernels.distance import NearSurface
from scanfind.library.near_surface import near_samples, near_triangles, signed_distances
from scanfind.mesh import Mesh
from scanfind.pose import Pose, random_rotation
from scanfind.simulate.parts import assemble, blocks, pipe
from scanfind.simulate.placement import surface_points

Floats = NDArray[np.float64]

REACH = 0.01
NOISE = 0.002
BRACKET = blocks(
    "bracket", [((0, 0, 0), (1.0, 0.6, 0.15)), ((0, 0, 0.15), (0.15, 0.15, 0.9)), ((0.6, 0.3, 0.15), (0.9, 0.6, 0.4))]
)
PLACE = Pose.from_rotation_vector([0.3, -0.5, 1.1], [0.4, -0.7, 1.3])
NUDGE = Pose.from_rotation_vector([0.0004, 0.0003, -0.0005], [0.0004, -0.0003, 0.0002])
# Off a pipe along z, at right angles to it.
BRANCH = Pose.from_rotation_vector([0.0, np.pi / 2, 0.0], [0.08, 0.0, 0.7])
TWICE = RefineParameters()


@cache
def near(mesh: Mesh) -> NearSurface:
    return near_triangles(mesh.triangles(), REACH)


def seen(mesh: Mesh, seed: int, noise: float = NOISE, per_m2: float = 1500.0) -> Floats:
    """Points (N, 3) on the surface of a mesh, model frame, each off it by noise along a beam of its own."""
    rng = np.random.default_rng(seed)
    points = surface_points(mesh, rng, per_m2)
    beams = rng.standard_normal(points.shape)
    beams /= np.linalg.norm(beams, axis=1, keepdims=True)
    return np.asarray(points + noise * beams * rng.standard_normal((len(points), 1)))


def fitted(mesh: Mesh, points: Floats, start: Pose = PLACE @ NUDGE, place: Pose = PLACE) -> Polished:
    """The fit of points of the model's frame that are seen where `place` has them and isolated by `start`."""
    xyz = place.move(points)
    distance = np.abs(offs(mesh, start, xyz))
    found = polish(near(mesh), start, xyz[distance < REACH], np.zeros(int((distance < REACH).sum()), int), TWICE)
    assert found is not None
    return found


def offs(mesh: Mesh, pose: Pose, xyz: Floats) -> Floats:
    return np.nan_to_num(measured(near(mesh), pose, xyz, 1)[0], nan=np.inf).astype(np.float64)


def turned(covariance: Floats, rotation: Floats) -> Floats:
    both = np.kron(np.eye(2), rotation)
    return np.asarray(both @ covariance @ both.T)


def test_errors_are_as_large_as_told() -> None:
    # 60 scenes of 6 motions: the mean is 1 ± 0.075 by chance, three times which is allowed.
    nees = []
    for seed in range(60):
        found = fitted(BRACKET, seen(BRACKET, seed))
        assert found.unobservable == ()
        value, dof = normalised(error_of(found.scene_from_model, PLACE, found.pivot), found.covariance)
        assert dof == 6
        nees.append(value)
    assert np.mean(nees) / 6 == pytest.approx(1.0, abs=0.22)
    assert kolmogorov([chi2_quantile(value, 6) for value in nees]) > 0.01


def test_a_window_about_the_wrong_place_does_not_pull() -> None:
    # Isolated by a pose 3 mm off within a reach of 10 mm, of which noise of 3 mm fills the rest.
    away = PLACE @ Pose(np.eye(3), np.array([0.002, -0.002, 0.001]))
    errors = [
        error_of(fitted(BRACKET, seen(BRACKET, seed, 0.003), away).scene_from_model, PLACE, PLACE.translation)[3:]
        for seed in range(12)
    ]
    assert np.linalg.norm(np.mean(errors, axis=0)) < 0.0001


@settings(deadline=None, max_examples=8)
@given(st.integers(0, 2**32))
def test_the_covariance_moves_with_the_scene(seed: int) -> None:
    rng = np.random.default_rng(seed)
    move = Pose(random_rotation(rng), rng.uniform(-50, 50, 3))
    points = seen(BRACKET, 1)
    still, moved = fitted(BRACKET, points), fitted(BRACKET, points, move @ PLACE @ NUDGE, move @ PLACE)
    assert (move @ still.scene_from_model).difference(moved.scene_from_model) == pytest.approx((0.0, 0.0), abs=1e-7)
    np.testing.assert_allclose(moved.pivot, move.move(still.pivot[None])[0], rtol=0, atol=1e-6)
    scale = np.sqrt(np.diag(moved.covariance))
    expected = turned(still.covariance, move.rotation)
    np.testing.assert_allclose(moved.covariance / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.01)


def test_the_covariance_is_symmetric_and_positive() -> None:
    for mesh in (BRACKET, pipe(0.1, 1.2)):
        covariance = fitted(mesh, seen(mesh, 2)).covariance
        np.testing.assert_array_equal(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance).min() > -1e-12 * np.trace(covariance)


def test_it_grows_with_noise_squared_and_shrinks_with_points() -> None:
    def size(noise: float, per_m2: float) -> float:
        return float(np.trace(fitted(BRACKET, seen(BRACKET, 3, noise, per_m2), PLACE).covariance))

    assert size(0.002, 3000.0) / size(0.001, 3000.0) == pytest.approx(4.0, rel=0.15)
    assert size(0.001, 1500.0) / size(0.001, 6000.0) == pytest.approx(4.0, rel=0.15)


def test_patches_that_disagree_are_not_believed_to_their_noise() -> None:
    # A surface that waves by 2 mm: more points of it are no more certain.
    points = seen(BRACKET, 4, 0.0005)
    waved = points + 0.002 * np.sin(40.0 * points[:, [1, 2, 0]])
    assert np.trace(fitted(BRACKET, waved).covariance) > 5.0 * np.trace(fitted(BRACKET, points).covariance)


def test_a_straight_pipe_slides_and_rolls_and_is_sure_of_the_rest() -> None:
    bare = pipe(0.1, 1.2)
    points = seen(bare, 5)
    points = points[np.abs(points[:, 2] - 0.6) < 0.5]  # without its ends
    found = fitted(bare, points)
    roll, slide = sorted(found.unobservable, key=lambda motion: motion.kind)
    assert (roll.kind, slide.kind) == ("roll", "slide")
    assert roll.sigma is slide.sigma is None
    for motion in (roll, slide):
        np.testing.assert_allclose(motion.axis, [0, 0, 1], rtol=0, atol=0.01)
    np.testing.assert_allclose(roll.through[:2], [0, 0], rtol=0, atol=0.005)
    # Nothing infinite, nothing along the axis, and the rest as small as elsewhere.
    axis = found.scene_from_model.rotation[:, 2]
    assert np.isfinite(found.covariance).all()
    assert axis @ found.covariance[3:, 3:] @ axis < 1e-3 * np.trace(found.covariance[3:, 3:])
    off = PLACE.inverse() @ found.scene_from_model
    assert np.abs(off.translation[:2]).max() < 0.0005
    # Along the axis the pose stays where it was.
    assert abs(off.translation[2] - NUDGE.translation[2]) < 2e-5


def test_a_few_points_on_a_branch_hold_the_roll_of_a_long_header() -> None:
    header = assemble("header", [(pipe(0.08, 2.2), Pose.identity()), (pipe(0.05, 0.3), BRANCH)])
    points = seen(header, 9)
    branch = np.linalg.norm(points[:, :2], axis=1) > 0.12
    some = points[~branch | (np.cumsum(branch) % 2 == 0)]
    assert 20 < np.count_nonzero(np.linalg.norm(some[:, :2], axis=1) > 0.12) < 0.05 * len(some)
    rolled = PLACE @ Pose.from_rotation_vector([0.0, 0.0, np.radians(1.0)])
    found = fitted(header, some, rolled)
    off = np.degrees(PLACE.difference(found.scene_from_model)[1])
    sigma = np.degrees(np.sqrt(np.linalg.eigvalsh(found.covariance[:3, :3]).max()))
    assert off < max(3.0 * sigma, 0.05)
    assert sigma < 0.3
    assert all(motion.sigma is not None for motion in found.unobservable if motion.kind == "roll")


def test_the_facets_of_a_tank_do_not_hold_its_roll() -> None:
    tank = pipe(0.3, 0.6)
    assert "roll" in {motion.kind for motion in fitted(tank, seen(tank, 5)).unobservable if motion.sigma is None}


def test_one_face_leaves_three_motions_open() -> None:
    points = seen(BRACKET, 6)
    face = points[(np.abs(points[:, 2]) < 0.008) & (points[:, :2] > 0.02).all(axis=1) & (points[:, 0] < 0.98)]
    found = fitted(BRACKET, face[face[:, 1] < 0.58])
    assert sorted(motion.kind for motion in found.unobservable) == ["roll", "slide", "slide"]
    assert np.linalg.matrix_rank(found.covariance, tol=1e-9 * np.trace(found.covariance)) == 3


def test_what_hardly_is_fixed_has_its_sigma() -> None:
    # One point on the only faces that stop a slide: no surer than that point.
    points = seen(BRACKET, 7, per_m2=400.0)
    stop = np.abs(points[:, 0]) < 0.006
    rest = (np.abs(points[:, 0] - 1.0) > 0.02) & (np.abs(points[:, 0] - 0.15) > 0.02) & (points[:, 0] < 0.58) & ~stop
    ends = np.flatnonzero(stop & (points[:, 1] > 0.2))[:1]
    found = polish(
        near(BRACKET), PLACE, PLACE.move(points[np.concatenate([np.flatnonzero(rest), ends])]),
        np.zeros(int(rest.sum()) + len(ends), int), replace(TWICE, unobservable_below=1e-7),
    )  # fmt: skip
    assert found is not None
    (slide,) = found.unobservable
    assert slide.kind == "slide"
    np.testing.assert_allclose(np.abs(slide.axis), [1, 0, 0], rtol=0, atol=0.2)
    assert slide.sigma is not None
    # 2 mm / √3 along the normal, and what the rest say of it.
    assert 0.0006 < slide.sigma < 0.0018


def test_too_few_points_say_nothing() -> None:
    for count in (0, 5):
        assert polish(near(BRACKET), PLACE, PLACE.move(seen(BRACKET, 8)[:count]), np.zeros(count, int), TWICE) is None


def test_exact_points_give_the_exact_pose() -> None:
    found = fitted(BRACKET, seen(BRACKET, 9, 0.0))
    assert found.scene_from_model.difference(PLACE) == pytest.approx((0.0, 0.0), abs=2e-6)
    assert np.trace(found.covariance) > 0.0


def test_a_piece_of_scan_is_a_model_as_well() -> None:
    samples = surface_points(BRACKET, np.random.default_rng(10), 20_000.0)
    normals = near(BRACKET).normals[np.argsort(near(BRACKET).face)][signed_distances(near(BRACKET), samples)[1]]
    model, points = near_samples(OrientedCloud(samples, normals), 0.012, REACH), PLACE.move(seen(BRACKET, 11))
    found = polish(model, PLACE @ NUDGE, points, np.zeros(len(points), int), TWICE)
    assert found is not None
    assert found.scene_from_model.difference(PLACE)[0] < 0.001


def test_a_detection_gets_its_distances_from_where_it_is_now() -> None:
    xyz = PLACE.move(seen(BRACKET, 12))
    before = np.nan_to_num(measured(near(BRACKET), PLACE @ NUDGE, xyz, 1)[0], nan=0.001)
    ids = np.arange(len(xyz))
    cut = IsolatedPoints(xyz, {}, np.array(ids % 2, np.int32), ids, before.astype(np.float32))
    raw = Detection(1, "bracket", PLACE @ NUDGE, 0.9, 0.9, 0.9, 0.0, 0.9, 0.001)
    raw = replace(raw, isolated=cut, deviation=deviation_of(before))
    found = polished(raw, near(BRACKET), TWICE, 2)
    assert found.covariance is not None
    assert found.isolated is not None
    assert found.deviation is not None
    now = measured(near(BRACKET), found.scene_from_model, xyz, 1)[0]
    np.testing.assert_array_equal(found.isolated.deviation, np.where(np.isnan(now), before, now))
    assert found.deviation == deviation_of(found.isolated.deviation)
    assert found.sigma_m == pytest.approx(np.sqrt(np.trace(found.covariance[3:, 3:])))
    for left in (
        replace(raw, isolated=None),
        replace(raw, isolated=replace(cut, xyz=xyz[:0], scan_id=cut.scan_id[:0])),
    ):
        assert polished(left, near(BRACKET), TWICE) is left
    assert polished(raw, near(BRACKET), replace(TWICE, raw_steps=0)) is raw
    assert np.isnan(raw.sigma_m)
    assert np.isnan(raw.sigma_rad)


@settings(deadline=None, max_examples=20)
@given(st.floats(0.3, 5.0))
def test_means_of_cut_bells_follow_as_told(gate: float) -> None:
    values, shift = np.linspace(-gate, gate, 20_001), 1e-4
    density = np.exp(-0.5 * (values - shift) ** 2)
    assert (values @ density / density.sum()) / shift == pytest.approx(float(followed(np.array([gate]))[0]), abs=2e-3)
