"""Poses are the rigid motions: a group that acts on points; and the doors of the nouns let nothing else in."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from scanfind.cloud import SHIFT_BEYOND_M, as_points, shift_for
from scanfind.errors import InvalidGeometryError
from scanfind.mesh import Mesh
from scanfind.pose import Pose, nearest_rotation, random_rotation, rotation_from_vector

Floats = NDArray[np.float64]

# Angles where formulas for rotations lose their digits: none, hardly any, a half turn and just off it, a full turn.
TROUBLE = [0.0, 1e-300, 1e-12, 1e-9, 2e-9, 1e-6, np.pi - 1e-9, np.pi - 1e-6, np.pi, np.pi + 1e-9, 2 * np.pi]
unit = st.tuples(*[st.floats(-1, 1) for _ in range(3)]).filter(lambda v: np.linalg.norm(v) > 1e-3)
axes = st.one_of(unit, st.sampled_from([(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 1.0, 0.0)]))
angles = st.one_of(st.floats(-np.pi, np.pi), st.sampled_from(TROUBLE))
places = st.tuples(*[st.floats(-100, 100) for _ in range(3)])


@st.composite
def poses(draw: st.DrawFn) -> Pose:
    axis = np.array(draw(axes))
    return Pose.from_rotation_vector(axis / np.linalg.norm(axis) * draw(angles), draw(places))


def assert_same(one: Pose, other: Pose) -> None:
    np.testing.assert_allclose(one.matrix(), other.matrix(), rtol=0, atol=1e-11)


@given(poses())
def test_a_rotation_is_orthonormal_and_right_handed(pose: Pose) -> None:
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), rtol=0, atol=1e-14)
    assert np.linalg.det(pose.rotation) == pytest.approx(1.0, abs=1e-14)


@given(poses(), poses(), poses())
def test_poses_are_a_group(a: Pose, b: Pose, c: Pose) -> None:
    assert_same((a @ b) @ c, a @ (b @ c))
    assert_same(a @ Pose.identity(), a)
    assert_same(Pose.identity() @ a, a)
    assert_same(a @ a.inverse(), Pose.identity())
    assert_same(a.inverse() @ a, Pose.identity())
    assert_same((a @ b).inverse(), b.inverse() @ a.inverse())


@given(poses(), poses(), st.lists(places, min_size=1, max_size=5))
def test_they_act_on_points_and_on_directions(a: Pose, b: Pose, points: list[tuple[float, ...]]) -> None:
    x = np.array(points)
    np.testing.assert_allclose((a @ b).move(x), a.move(b.move(x)), rtol=0, atol=1e-10)
    np.testing.assert_allclose(a.inverse().move(a.move(x)), x, rtol=0, atol=1e-10)
    # A direction is a difference of points.
    np.testing.assert_allclose(a.turn(x), a.move(x) - a.move(np.zeros((1, 3))), rtol=0, atol=1e-10)
    one = np.append(x[0], 1.0)
    np.testing.assert_allclose((a.matrix() @ one)[:3], a.move(x[:1])[0], rtol=0, atol=1e-10)


@given(poses())
def test_a_matrix_holds_all_of_a_pose(pose: Pose) -> None:
    assert_same(Pose.from_matrix(pose.matrix()), pose)


@given(poses())
def test_a_matrix_with_few_decimals_is_made_rigid(pose: Pose) -> None:
    back = Pose.from_matrix(pose.matrix().round(4))
    np.testing.assert_allclose(back.rotation @ back.rotation.T, np.eye(3), rtol=0, atol=1e-14)
    np.testing.assert_allclose(back.rotation, pose.rotation, rtol=0, atol=2e-4)


@given(poses(), places.map(np.array))
def test_a_quaternion_turns_as_its_matrix_does(pose: Pose, point: Floats) -> None:
    q = pose.quaternion()
    assert list(q) == ["x", "y", "z", "w"]
    assert q["w"] >= 0.0
    v, w = np.array([q["x"], q["y"], q["z"]]), q["w"]
    assert v @ v + w * w == pytest.approx(1.0, abs=1e-14)
    turned = point + 2.0 * np.cross(v, np.cross(v, point) + w * point)
    np.testing.assert_allclose(turned, pose.turn(point[None])[0], rtol=0, atol=1e-11)


@given(axes, angles, places, poses())
def test_the_difference_is_how_far_one_moves_to_the_other(
    axis: tuple[float, ...], angle: float, step: tuple[float, ...], start: Pose
) -> None:
    unit_axis = np.array(axis) / np.linalg.norm(axis)
    other = Pose(start.rotation @ rotation_from_vector(unit_axis * angle), start.translation + step)
    metres, radians = start.difference(other)
    assert metres == pytest.approx(float(np.linalg.norm(step)), abs=1e-11)
    # 1e-9 rad is told from none: no arccos of a cosine.
    assert radians == pytest.approx(abs(angle) if abs(angle) <= np.pi else 2 * np.pi - abs(angle), abs=1e-14, rel=1e-7)
    assert start.difference(other) == pytest.approx(other.difference(start), abs=1e-14)


@given(axes, st.floats(-np.pi, np.pi), st.floats(-np.pi, np.pi))
def test_turns_about_one_axis_add(axis: tuple[float, ...], one: float, other: float) -> None:
    unit_axis = np.array(axis) / np.linalg.norm(axis)
    both = rotation_from_vector(unit_axis * one) @ rotation_from_vector(unit_axis * other)
    np.testing.assert_allclose(both, rotation_from_vector(unit_axis * (one + other)), rtol=0, atol=1e-13)
    np.testing.assert_allclose(rotation_from_vector(unit_axis * one) @ unit_axis, unit_axis, rtol=0, atol=1e-13)


def test_random_rotations_favour_no_direction() -> None:
    rng = np.random.default_rng(0)
    turns = np.array([random_rotation(rng) for _ in range(4000)])
    np.testing.assert_allclose(turns @ turns.transpose(0, 2, 1), np.broadcast_to(np.eye(3), turns.shape), atol=1e-13)
    assert (np.linalg.det(turns) > 0.999).all()
    # Each entry is uniform in -1 … 1: mean 0 ± 0.009, mean square 1/3 ± 0.005; five sigma.
    assert np.abs(turns.mean(axis=0)).max() < 0.046
    assert np.abs((turns**2).mean(axis=0) - 1 / 3).max() < 0.024


@pytest.mark.parametrize(
    "matrix",
    [
        np.eye(3),
        np.zeros((4, 4)),
        np.diag([1.0, 1.0, -1.0, 1.0]),
        np.diag([1.01, 1.01, 1.01, 1.0]),
        np.diag([1.0, 1.0, 1.0, 2.0]),
        np.full((4, 4), np.nan),
        np.diag([np.inf, 1.0, 1.0, 1.0]),
    ],
    ids=["3x3", "zeros", "mirror", "scale", "last row", "nan", "inf"],
)
def test_what_is_no_rigid_motion_is_refused(matrix: Floats) -> None:
    with pytest.raises(InvalidGeometryError):
        Pose.from_matrix(matrix)


def test_the_nearest_rotation_of_a_shear_is_refused() -> None:
    with pytest.raises(InvalidGeometryError, match="rigid"):
        nearest_rotation([[1.0, 0.2, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("wrong", [np.zeros(3), np.zeros((4, 2)), np.zeros((2, 3, 1)), "abc", [[1, 2, "x"]], None])
def test_points_have_three_columns(wrong: Any) -> None:
    with pytest.raises(InvalidGeometryError, match=r"\(N, 3\)"):
        as_points(wrong)


@pytest.mark.parametrize("dtype", [np.float32, np.int16, np.float64])
def test_points_come_in_any_number_type_and_order(dtype: type) -> None:
    given_points: NDArray[Any] = np.asfortranarray(np.arange(12).reshape(4, 3).astype(dtype))
    points = as_points(given_points)
    assert points.dtype == np.float64
    assert points.flags.c_contiguous
    np.testing.assert_array_equal(points, given_points)


@given(st.tuples(*[st.floats(-1e8, 1e8) for _ in range(3)]).map(np.array))
def test_a_shift_brings_far_points_near_and_leaves_near_ones(point: Floats) -> None:
    shift = shift_for(point)
    near = np.abs(point) <= SHIFT_BEYOND_M
    assert (shift[near] == 0.0).all()
    assert (np.abs(point - shift)[~near] <= 50.0).all()
    assert (np.mod(shift, 100.0) == 0.0).all()


CORNERS: list[list[float]] = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
SIDES = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]


@pytest.mark.parametrize(
    ("vertices", "faces", "why"),
    [
        (CORNERS, [[0, 1, 4]], "vertices it does not have"),
        (CORNERS, [[0, 1, -1]], "vertices it does not have"),
        (CORNERS, [[0, 1]], "faces"),
        (np.zeros((4, 2)), SIDES, "vertices"),
        ([[np.nan, 0, 0], *CORNERS[1:]], SIDES, "finite"),
        (CORNERS, np.zeros((0, 3)), "no triangle"),
        (CORNERS, [[0, 1, 1], [2, 2, 2]], "no triangle"),
    ],
)
def test_a_mesh_that_is_none_is_refused(vertices: Any, faces: Any, why: str) -> None:
    with pytest.raises(InvalidGeometryError, match=why):
        Mesh.of("wrong", vertices, faces)


def test_a_mesh_loses_only_its_degenerate_faces() -> None:
    mesh = Mesh.of("tetrahedron", CORNERS, [*SIDES, [1, 1, 2]])
    assert mesh.faces.tolist() == SIDES
    assert mesh.area() == pytest.approx(1.5 + np.sqrt(3) / 2)
    assert mesh.triangles().shape == (4, 3, 3)


@given(st.floats(1e-3, 1e3))
def test_area_grows_with_the_square_of_the_unit(factor: float) -> None:
    mesh = Mesh.of("tetrahedron", CORNERS, SIDES)
    assert mesh.scaled(factor).area() == pytest.approx(factor**2 * mesh.area())
