"""ICP brings a pose home, leaves alone what the data leave open, says so, and moves with the scene."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import naive
from scanfind.cloud import PointChunk
from scanfind.detection import Motion
from scanfind.fit.refine import Refined, covariance_of, icp, shrinking, unobservable
from scanfind.grid.moments import MomentGrid
from scanfind.grid.surfels import Surfels
from scanfind.kernels.blocks import unpack_block
from scanfind.kernels.nearest import mark_around, mark_rows, nearest_surfel
from scanfind.library.model import Model, ModelParameters, build_model
from scanfind.library.surface import SurfaceParameters
from scanfind.mesh import Mesh
from scanfind.pose import Pose, random_rotation
from scanfind.search.hypotheses import Hypotheses, ModelArrays, model_arrays
from scanfind.simulate.parts import blocks, pipe
from scanfind.simulate.placement import surface_points

Floats = NDArray[np.float64]

CELL = 0.02
BRACKET = blocks(
    "bracket", [((0, 0, 0), (1.0, 0.6, 0.15)), ((0, 0, 0.15), (0.15, 0.15, 0.9)), ((0.6, 0.3, 0.15), (0.9, 0.6, 0.4))]
)
SHEET = Mesh.of("sheet", [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
PIPE = pipe(0.1, 1.2)


@cache
def model_of(mesh: Mesh) -> Model:
    return build_model(mesh, ModelParameters(SurfaceParameters(samples=1500)))


def seen(mesh: Mesh, pose: Pose, per_m2: float = 60_000.0, seed: int = 0) -> Surfels:
    """The whole surface of a mesh as surfels, the sides of the normals unknown."""
    points = pose.move(surface_points(mesh, np.random.default_rng(seed), per_m2))
    grid = MomentGrid(CELL, np.zeros(3))
    grid.add(PointChunk(points, {}, np.arange(len(points))))
    return Surfels(grid).fit()


def refined(model: Model, surfels: Surfels, start: list[Pose], jobs: int = 1) -> tuple[Refined, ModelArrays]:
    arrays = model_arrays([model])
    poses = Hypotheses(
        np.zeros(len(start), np.int64), np.array([p.rotation for p in start]),
        np.array([p.translation for p in start]), np.ones(len(start)),
    )  # fmt: skip
    gates = shrinking((1.0, 0.5), 25, CELL)
    return icp(poses, surfels, arrays, False, gates, 1500, 0.8, jobs), arrays


def home(result: Refined, k: int = 0) -> Pose:
    return Pose(result.hypotheses.rotations[k], result.hypotheses.translations[k])


def nudges(count: int, metres: float, degrees: float, seed: int = 1) -> list[Pose]:
    rng = np.random.default_rng(seed)
    return [
        Pose.from_rotation_vector(rng.uniform(-1, 1, 3) * np.radians(degrees), rng.uniform(-1, 1, 3) * metres)
        for _ in range(count)
    ]


PLACE = Pose.from_rotation_vector([0.3, -0.5, 1.1], [0.4, -0.7, 1.3])


def test_small_displacements_are_undone() -> None:
    surfels = seen(BRACKET, PLACE, 200_000.0)
    result, _ = refined(model_of(BRACKET), surfels, [PLACE @ nudge for nudge in nudges(12, 0.006, 0.6)])
    for k in range(12):
        metres, radians = home(result, k).difference(PLACE)
        assert metres < 1e-4
        assert radians < 1e-4
        # All come to the same end; what is left of the way is the chance of where the points lie.
        assert home(result, k).difference(home(result)) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert (result.matched > 0.8).all()
    assert (result.rms < 0.001).all()


def test_where_nothing_is_a_pose_stays() -> None:
    away = Pose(np.eye(3), np.array([50.0, 0.0, 0.0]))
    result, _ = refined(model_of(BRACKET), seen(BRACKET, PLACE), [away])
    np.testing.assert_array_equal(home(result).matrix(), away.matrix())
    assert result.matched[0] == 0.0
    assert result.rms[0] == np.inf


@pytest.mark.parametrize("jobs", [2, 5])
def test_poses_are_refined_each_for_itself(jobs: int) -> None:
    surfels, start = seen(BRACKET, PLACE), [PLACE @ nudge for nudge in nudges(12, 0.005, 0.5)]
    one, many = refined(model_of(BRACKET), surfels, start)[0], refined(model_of(BRACKET), surfels, start, jobs)[0]
    alone = [refined(model_of(BRACKET), surfels, [pose])[0] for pose in start]
    for mine, theirs in zip((*one.hypotheses, *one[1:]), (*many.hypotheses, *many[1:]), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    for k, single in enumerate(alone):
        np.testing.assert_array_equal(home(single).matrix(), home(one, k).matrix())


@settings(deadline=None, max_examples=6)
@given(st.tuples(*[st.integers(-40, 40)] * 3), st.integers(0, 3))
def test_refining_moves_with_the_scene(steps: tuple[int, int, int], quarters: int) -> None:
    # Whole cells and quarter turns map the grid onto itself; other motions resample the scene.
    angle = quarters * np.pi / 2
    move = Pose(Pose.from_rotation_vector([0, 0, angle]).rotation.round(), np.array(steps) * CELL)
    start = PLACE @ nudges(1, 0.005, 0.5)[0]
    still, _ = refined(model_of(BRACKET), seen(BRACKET, PLACE), [start])
    moved, _ = refined(model_of(BRACKET), seen(BRACKET, move @ PLACE), [move @ start])
    # Not to the last bit: the scene's points and cells are rounded.
    assert (move @ home(still)).difference(home(moved)) == pytest.approx((0.0, 0.0), abs=1e-5)


def test_a_sheet_slides_and_turns_in_its_plane_and_nothing_else() -> None:
    model, place = model_of(SHEET), Pose.from_rotation_vector([0.4, 0.2, 0.0], [0.1, 0.2, 0.3])
    wide = Mesh.of("floor", (SHEET.vertices - [0.5, 0.5, 0]) * 3 + [0.5, 0.5, 0], SHEET.faces)
    start = place @ Pose.from_rotation_vector([0.004, -0.003, 0.0], [0.0, 0.0, 0.004])
    result, arrays = refined(model, seen(wide, place, 20_000.0), [start])
    found = home(result)
    # Back into the plane …
    three = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    normal, here = place.rotation[:, 2], found.move(three)
    assert np.abs((here - place.translation) @ normal).max() < 1e-4
    # … and within it where it was.
    assert np.abs((here - place.move(three)) @ place.rotation[:, :2]).max() < 1e-3
    free = motions(result, arrays)
    assert sorted(motion.kind for motion in free) == ["roll", "slide", "slide"]
    for motion in free:
        along = abs(motion.axis[2])
        assert along == pytest.approx(1.0 if motion.kind == "roll" else 0.0, abs=0.02)


def motions(result: Refined, arrays: ModelArrays) -> tuple[Motion, ...]:
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = result.hypotheses.rotations[0]
    hessian = turn.T @ result.hessians[0] @ turn
    return unobservable(hessian, arrays.centres[0], float(arrays.radii[0]), 0.004)


def test_a_straight_pipe_slides_and_rolls() -> None:
    longer = pipe(0.1, 3.0)
    place = Pose.from_rotation_vector([0.7, 0.4, 0.2], [0.3, 0.1, -0.2])
    result, arrays = refined(model_of(PIPE), seen(longer, place), [place @ Pose(np.eye(3), np.array([0.004, 0, 1.0]))])
    slide, roll = sorted(motions(result, arrays), key=lambda motion: motion.kind, reverse=True)
    assert (slide.kind, roll.kind) == ("slide", "roll")
    for motion in (slide, roll):
        np.testing.assert_allclose(motion.axis, [0, 0, 1], rtol=0, atol=0.01)
    np.testing.assert_allclose(roll.through[:2], [0, 0], rtol=0, atol=0.005)  # about its own middle line
    off = home(result).inverse() @ place
    assert np.linalg.norm((place.inverse() @ home(result)).translation[:2]) < 2e-4
    assert abs(off.translation[2] + 1.0) < 0.01


def test_nothing_is_open_on_an_irregular_body() -> None:
    result, arrays = refined(model_of(BRACKET), seen(BRACKET, PLACE), [PLACE])
    assert motions(result, arrays) == ()


def test_the_covariance_is_the_inverse_of_what_the_data_fix() -> None:
    result, arrays = refined(model_of(BRACKET), seen(BRACKET, PLACE), [PLACE])
    radius = float(arrays.radii[0])
    covariance = covariance_of(result.hessians[0], 0.001, radius, 0.004)
    scaled = covariance * np.outer(scale := np.repeat([radius, 1.0], 3), scale)
    np.testing.assert_allclose(scaled @ result.hessians[0], 1e-6 * np.eye(6), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(covariance, covariance.T)
    np.testing.assert_allclose(covariance_of(result.hessians[0], 0.002, radius, 0.004), 4 * covariance, rtol=1e-12)


def test_the_covariance_is_zero_along_what_they_leave_open() -> None:
    result, arrays = refined(
        model_of(PIPE), seen(pipe(0.1, 3.0), Pose.identity()), [Pose(np.eye(3), np.array([0, 0, 1.0]))]
    )
    covariance = covariance_of(result.hessians[0], 0.001, float(arrays.radii[0]), 0.004)
    assert np.linalg.matrix_rank(covariance, tol=1e-6 * np.trace(covariance)) == 4
    slide, roll = covariance[5, 5] / np.trace(covariance[3:, 3:]), covariance[2, 2] / np.trace(covariance[:3, :3])
    assert max(slide, roll) < 1e-3


# ── nearest surfels ──


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32), st.floats(0.05, 2.5), st.floats(-1.0, 0.95), st.booleans())
def test_the_nearest_surfel_is_brute_force_s(seed: int, gate_cells: float, cosine: float, signed: bool) -> None:
    rng = np.random.default_rng(seed)
    surfels = scattered()
    cells = surfels.cells
    gate = gate_cells * surfels.cell
    for _ in range(30):
        near = surfels.means[rng.integers(len(surfels.means))]
        point = near + rng.normal(scale=0.5 * surfels.cell, size=3)
        normal = random_rotation(rng)[0]
        found = nearest_surfel(
            *point, *normal, gate, cosine, signed, surfels.cell, cells.hash_keys, cells.hash_values,
            cells.filled, cells.block_rows, surfels.first_surfel, surfels.sides, surfels.means, surfels.normals,
        )  # fmt: skip
        assert found == naive.nearest(point, normal, surfels.means, surfels.normals, gate, cosine, signed)


@cache
def scattered() -> Surfels:
    points = np.random.default_rng(8).uniform(-1, 1, (3000, 3))
    grid = MomentGrid(0.1, np.zeros(3))
    grid.add(PointChunk(points, {}, np.arange(3000), origin=np.full(3, 4.0)))
    grid.add(PointChunk(points + 0.01, {}, np.arange(3000), origin=np.full(3, -4.0)))
    return Surfels(grid).fit()


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32), st.integers(0, 8), st.integers(1, 40))
def test_marked_are_the_cells_of_a_cube_about_each_point(seed: int, reach: int, count: int) -> None:
    points = np.random.default_rng(seed).uniform(-1.3, 1.3, (count, 3))
    cells = scattered().cells
    layers, marked = np.zeros((len(cells.filled), 8), np.uint64), np.zeros(len(scattered().sides), np.bool_)
    mark_around(points, reach, cells.cell, cells.hash_keys, cells.hash_values, layers)
    mark_rows(cells.order, layers, cells.block_rows, marked)
    blocks = np.repeat(cells.order, np.diff(cells.first_cell))
    corners = np.array([unpack_block(key) for key in cells.block_keys[blocks]]) * 8
    places = corners + np.stack([cells.locals >> 6, (cells.locals >> 3) & 7, cells.locals & 7], axis=1)
    apart = np.abs(places[:, None] - np.floor(points / cells.cell)).max(axis=2).min(axis=1)
    np.testing.assert_array_equal(marked[cells.rows], apart <= reach)


# ── self-similar poses ──
