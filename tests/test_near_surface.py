"""Laws of the distance to a model's surface."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import naive_distance as naive
from scanfind.cloud import OrientedCloud
from scanfind.errors import InvalidGeometryError
from scanfind.library.near_surface import near_samples, near_triangles, signed_distances, weld
from scanfind.pose import Pose

Floats = NDArray[np.float64]

BOX = np.asarray(trimesh.creation.box((1.0, 2.0, 0.5)).triangles)
SPHERE = np.asarray(trimesh.creation.icosphere(2, 0.3).triangles)
# A star has edges and corners of every kind, sharper than 90° and hollow ones too: where signs go wrong.
_ball = trimesh.creation.icosphere(2, 1.0)
STAR = (_ball.vertices * np.random.default_rng(5).uniform(0.2, 0.5, (len(_ball.vertices), 1)))[_ball.faces]
CLOSED = {"box": BOX, "sphere": SPHERE, "star": STAR}

seeds = st.integers(0, 2**32 - 1)


def on_edges_and_corners(triangles: Floats, rng: np.random.Generator) -> Floats:
    """Points where faces tie: at corners, on edges, and straight above both."""
    t = triangles[rng.integers(len(triangles), size=4)]
    on_edge = 0.5 * (t[:, 0] + t[:, 1])
    return np.concatenate([t[:, 0], on_edge, t[:, 0] * 1.05, on_edge * 1.05])


@settings(max_examples=30, deadline=None)
@given(seeds, st.integers(1, 20), st.sampled_from([1.0, 1e-3, 1e-7, 1e-12, 0.0]))
def test_the_nearest_triangle_is_the_naive_one(seed: int, faces: int, thinness: float) -> None:
    rng = np.random.default_rng(seed)
    triangles = rng.normal(size=(faces, 3, 3))
    # The third corner near the line of the other two: needles down to no height at all.
    foot = triangles[:, 0] + rng.uniform(-0.5, 1.5, (faces, 1)) * (triangles[:, 1] - triangles[:, 0])
    triangles[:, 2] = foot + thinness * (triangles[:, 2] - foot)
    points = np.concatenate([rng.normal(size=(10, 3)), on_edges_and_corners(triangles, rng)])
    distance, face = signed_distances(near_triangles(triangles, 100.0), points)
    want = naive.distances(triangles, points)
    np.testing.assert_allclose(np.abs(distance), want.min(axis=1), rtol=2e-7, atol=3e-8)
    np.testing.assert_allclose(want[np.arange(len(points)), face], want.min(axis=1), rtol=1e-7, atol=3e-8)


@pytest.mark.parametrize("triangles", CLOSED.values(), ids=CLOSED.keys())
def test_minus_is_inside(triangles: Floats) -> None:
    rng = np.random.default_rng(1)
    around = rng.uniform(-1.2, 1.2, (3000, 3)) * np.abs(triangles).max(axis=(0, 1))
    near_corners = triangles.reshape(-1, 3)[:600] + rng.normal(size=(min(600, len(triangles) * 3), 3)) * 0.02
    points = np.concatenate([around, near_corners])
    distance, _ = signed_distances(near_triangles(triangles, 10.0), points)
    clear = np.abs(distance) > 1e-6
    np.testing.assert_array_equal(distance[clear] < 0, naive.winding(triangles, points)[clear] > 0.5)


def test_distances_to_a_box_are_known() -> None:
    half = np.array([0.5, 1.0, 0.25])
    points = np.random.default_rng(2).uniform(-2, 2, (2000, 3))
    beyond = np.abs(points) - half
    want = np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0)
    np.testing.assert_allclose(signed_distances(near_triangles(BOX, 10.0), points)[0], want, rtol=2e-7, atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(seeds, st.sampled_from([0.0, 10.0, 5e6]))
def test_distances_move_with_the_model(seed: int, far: float) -> None:
    rng = np.random.default_rng(seed)
    pose = Pose.from_rotation_vector(rng.normal(size=3), far * rng.uniform(-1, 1, 3))
    points = rng.uniform(-0.6, 0.6, (200, 3))
    here, _ = signed_distances(near_triangles(STAR, 0.2), points)
    moved = pose.move(STAR.reshape(-1, 3)).reshape(STAR.shape)
    there, _ = signed_distances(near_triangles(moved, 0.2), pose.move(points))
    settled = np.abs(np.nan_to_num(np.abs(here), nan=0.2) - 0.2) > 1e-6  # not on the very brink of reach
    # Double precision leaves a nanometre or two at 5,000 km.
    np.testing.assert_allclose(there[settled], here[settled], atol=1e-7 if far < 1e6 else 1e-8 * 5)


def test_beyond_reach_is_nan_and_reach_itself_is_not() -> None:
    triangle = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    distance, face = signed_distances(
        near_triangles(triangle, 0.25),
        np.array([[0.2, 0.2, 0.25], [0.2, 0.2, -0.25], [0.2, 0.2, 0.2500001], [-0.3, 0, 0]]),
    )
    np.testing.assert_array_equal(distance, np.array([0.25, -0.25, np.nan, np.nan], np.float32))
    np.testing.assert_array_equal(face, [0, 0, -1, -1])


def test_reach_only_cuts() -> None:
    points = np.random.default_rng(3).uniform(-0.6, 0.6, (2000, 3))
    far, far_face = signed_distances(near_triangles(STAR, 10.0), points)
    for reach in (0.003, 0.05):
        near, face = signed_distances(near_triangles(STAR, reach), points)
        cut = np.abs(far) > reach
        np.testing.assert_array_equal(near, np.where(cut, np.nan, far))
        np.testing.assert_array_equal(face, np.where(cut, -1, far_face))


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_the_order_of_faces_does_not_matter(seed: int) -> None:
    order = np.random.default_rng(seed).permutation(len(STAR))
    points = np.random.default_rng(seed + 1).uniform(-0.6, 0.6, (300, 3))
    distance, _ = signed_distances(near_triangles(STAR, 1.0), points)
    other, _ = signed_distances(near_triangles(STAR[order], 1.0), points)
    np.testing.assert_allclose(other, distance, rtol=1e-6, atol=1e-12)


def test_of_equally_near_faces_the_lowest_is_named() -> None:
    rng = np.random.default_rng(4)
    twice = np.concatenate([STAR, STAR[::-1]])
    _, face = signed_distances(near_triangles(twice, 1.0), rng.uniform(-0.6, 0.6, (500, 3)))
    assert (face < len(STAR)).all()
    # Straight out of a corner of the box all its faces tie.
    corner = BOX[0, 0]
    _, face = signed_distances(near_triangles(BOX, 1.0), corner[None] * 1.1)
    assert face[0] == min(np.flatnonzero((corner == BOX).all(axis=2).any(axis=1)))


def test_hidden_faces_attract_nobody() -> None:
    inner = BOX * 0.98  # the inner wall of a hollow box, 5 to 20 mm behind the outer one, turned inwards
    hollow = np.concatenate([BOX, inner[:, ::-1]])
    hidden = np.arange(len(hollow)) >= len(BOX)
    points = np.random.default_rng(6).uniform(-1, 1, (1000, 3)) * [0.6, 1.1, 0.3]
    wanted = signed_distances(near_triangles(BOX, 1.0), points)
    got = signed_distances(near_triangles(hollow, 1.0, hidden), points)
    np.testing.assert_array_equal(got, wanted)


def test_outside_of_parts_that_run_into_one_another_the_inner_faces_do_not_show() -> None:
    parts = np.concatenate([BOX, BOX[..., [1, 0, 2]][:, ::-1] * 0.9])  # crossed; mirrored, so turned back
    points = np.random.default_rng(7).uniform(-1.2, 1.2, (3000, 3))
    alone = [signed_distances(near_triangles(part, 10.0), points)[0] for part in (parts[:12], parts[12:])]
    outside = (alone[0] > 0) & (alone[1] > 0)
    both, _ = signed_distances(near_triangles(parts, 10.0), points)
    np.testing.assert_array_equal(both[outside], np.minimum(*alone)[outside])


def test_without_a_side_there_is_no_sign() -> None:
    points = np.random.default_rng(8).uniform(-0.6, 0.6, (500, 3))
    signed, _ = signed_distances(near_triangles(STAR, 1.0), points)
    unsigned, _ = signed_distances(near_triangles(STAR, 1.0, signed=False), points)
    np.testing.assert_array_equal(unsigned, np.abs(signed))


@pytest.mark.parametrize("signed", [True, False])
def test_samples_stand_for_small_disks(signed: bool) -> None:
    rng = np.random.default_rng(9)
    x, y = np.meshgrid(np.arange(20) * 0.05, np.arange(20) * 0.05)
    flat = np.stack([x.ravel(), y.ravel(), np.zeros(400)], axis=1)
    pose = Pose.from_rotation_vector([0.3, -1.0, 2.0], [4.0, 5.0, 6.0])
    cloud = OrientedCloud(pose.move(flat), pose.turn(np.tile([0.0, 0, 1], (400, 1))), signed)
    points = rng.uniform([-0.3, -0.3, -0.1], [1.3, 1.3, 0.1], (3000, 3))
    distance, sample = signed_distances(near_samples(cloud, 0.05, 0.03), pose.move(points))
    gap = np.linalg.norm(points[:, None] - flat[None], axis=2)
    nearest = gap.argmin(axis=1)
    aside = np.linalg.norm((points - flat[nearest])[:, :2], axis=1)
    owned = (aside <= 0.05) & (np.abs(points[:, 2]) <= 0.03)
    want = points[:, 2] if signed else np.abs(points[:, 2])
    np.testing.assert_allclose(distance, np.where(owned, want, np.nan), atol=1e-8)
    np.testing.assert_array_equal(sample, np.where(owned, nearest, -1))


def test_equal_corners_are_one() -> None:
    assert weld(BOX).max() + 1 == 8
    assert weld(STAR + 1e5).max() + 1 == len(np.unique((STAR + 1e5).reshape(-1, 3), axis=0))


@pytest.mark.parametrize(
    ("triangles", "reach", "words"),
    [
        (np.zeros((2, 3)), 1.0, "shape"),
        (np.zeros((0, 3, 3)), 1.0, "at least one"),
        (np.full((1, 3, 3), np.nan), 1.0, "finite"),
        (BOX, 0.0, "reach"),
        (BOX, np.nan, "reach"),
    ],
)
def test_the_door(triangles: Floats, reach: float, words: str) -> None:
    with pytest.raises(InvalidGeometryError, match=words):
        near_triangles(triangles, reach)


def test_the_door_for_hidden_faces_and_samples() -> None:
    with pytest.raises(InvalidGeometryError, match="each of 12 faces"):
        near_triangles(BOX, 1.0, np.zeros(3, dtype=np.bool_))
    with pytest.raises(InvalidGeometryError, match="at least one"):
        near_triangles(BOX, 1.0, np.ones(12, dtype=np.bool_))
    cloud = OrientedCloud(np.zeros((2, 3)), np.zeros((1, 3)))
    with pytest.raises(InvalidGeometryError, match="normal"):
        near_samples(cloud, 0.1, 1.0)
    with pytest.raises(InvalidGeometryError, match="spacing"):
        near_samples(cloud, -0.1, 1.0)
    with pytest.raises(InvalidGeometryError, match=r"\(N, 3\)"):
        signed_distances(near_triangles(BOX, 1.0), np.zeros(3))


def test_no_points_no_distances() -> None:
    distance, face = signed_distances(near_triangles(BOX, 1.0), np.empty((0, 3)))
    assert len(distance) == len(face) == 0
