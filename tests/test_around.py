"""What stands beside its place: found where ICP does not lead, and never taken for it where it is another's."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import scanfind
from scanfind.design.elements import INSTALLED
from scanfind.fit.pull import pulled
from scanfind.library.near_surface import near_triangles
from scanfind.mesh import Mesh, Placement
from scanfind.parameters import PRESETS
from scanfind.pose import Pose, random_rotation, rotation_from_vector
from scanfind.recognition.around import DISTINCT_M, GATES_M, drawn_in, of_others
from scanfind.recognition.candidate import Standing
from scanfind.simulate.parts import blocks, box
from scanfind.simulate.placement import sample_oriented
from scanfind.simulate.scanner import Scanner, scan
from scanfind.simulate.scene import Scene, SceneObject

Floats = NDArray[np.float64]

FLAT = replace(box(1.5, 0.08, 0.008), name="flat")
STUB = replace(box(0.3, 0.22, 0.2), name="stub")
FLOOR = SceneObject("floor", blocks("floor", [((-4, -4, -0.3), (4, 4, -0.2))]), Pose.identity())
STATIONS = np.array([[-1.0, -3.0, 1.5], [2.0, -2.5, 1.8], [0.5, 3.0, 1.6]])

QUICK = replace(PRESETS["default"], search=replace(PRESETS["default"].search, time_limit_s=0.1))


def at(x: float, y: float, z: float) -> Pose:
    return Pose(np.eye(3), np.array([x, y, z]))


def ends_on(mesh: Mesh, pose: Pose, rng: np.random.Generator) -> Floats:
    """Where beams would end on all of a mesh, 1 mm of noise across it."""
    points, normals = sample_oriented(mesh, rng, 3000)
    return pose.move(points + 1e-3 * rng.normal(size=(3000, 1)) * normals)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_a_pose_is_drawn_to_its_own_points_wherever_the_scene_stands(seed: int) -> None:
    rng = np.random.default_rng(seed)
    near = near_triangles(STUB.triangles(), 0.1)
    true = Pose(random_rotation(rng), rng.normal(size=3))
    off = Pose(rotation_from_vector(0.02 * rng.normal(size=3)), 0.02 * rng.uniform(-1.0, 1.0, 3))
    ends = ends_on(STUB, true, rng)
    found = pulled(near, true @ off, ends, GATES_M)
    assert np.linalg.norm(found.move(STUB.vertices) - true.move(STUB.vertices), axis=1).max() < 1e-3
    elsewhere = Pose(random_rotation(rng), rng.normal(size=3))
    moved = pulled(near, elsewhere @ true @ off, elsewhere.move(ends), GATES_M)
    np.testing.assert_allclose(moved.move(STUB.vertices), (elsewhere @ found).move(STUB.vertices), atol=1e-6)


def test_too_few_points_draw_a_pose_nowhere() -> None:
    near, pose = near_triangles(FLAT.triangles(), 0.1), at(0.0, 0.0, 0.0)
    for ends in (np.empty((0, 3)), FLAT.vertices[:5], np.full((50, 3), 9.0)):
        assert pulled(near, pose, ends, GATES_M) is pose


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_what_stands_about_a_place_is_reached_from_it(seed: int) -> None:
    # Along its length only the ends of a flat bar tell: there it need not be right.
    rng = np.random.default_rng(seed)
    place, shift = Pose(random_rotation(rng), rng.normal(size=3)), rng.normal(size=3)
    true = place @ Pose(np.eye(3), rng.uniform(0.03, 0.09) * shift / np.linalg.norm(shift))
    poses = drawn_in(near_triangles(FLAT.triangles(), 0.1), place, FLAT.vertices, ends_on(FLAT, true, rng), 0.006)
    assert min(np.abs((true.inverse() @ pose).translation[1:]).max() for pose in poses) < 2e-3
    outlines = [pose.move(FLAT.vertices) for pose in poses]
    assert all(np.linalg.norm(a - b, axis=1).max() > DISTINCT_M for a, b in combinations(outlines, 2))


def test_what_lies_on_another_is_its_own_only_where_the_other_does_not_reach() -> None:
    other = Standing(near_triangles(FLAT.triangles(), 0.03), at(0.0, 0.0, 0.0))
    points = np.column_stack([np.linspace(0.01, 2.99, 150), np.full(150, 0.04), np.full(150, 0.01)])
    assert of_others(points, [other], 0.006).mean() == pytest.approx(0.5, abs=0.01)
    assert not of_others(points, [other], 0.001).any()
    assert not of_others(points, [], 0.006).any()


@pytest.mark.parametrize("wall", [False, True])
def test_a_thin_bar_that_was_moved_is_found_and_none_that_is_missing(wall: bool) -> None:
    # Side by side the first two, of which the first was left out; the third was moved by seven times its thickness. A
    # wall of 8 mm that is not in the design looks like a bar wherever one stands on it.
    places = [at(0.0, 0.0, 0.5), at(0.0, 0.08, 0.5), at(0.0, 1.0, 0.5)]
    design = replace(
        FLAT, placements=tuple(Placement(f"id-{k}", "IfcPlate", f"P{k}", each) for k, each in enumerate(places))
    )
    built = [SceneObject("P1", FLAT, places[1]), SceneObject("P2", FLAT, at(0.0, 1.02, 0.556))]
    if wall:
        built[1] = SceneObject("wall", box(3.0, 0.6, 0.008), at(-0.7, 0.7, 0.54))
    cloud = scan(Scene((FLOOR, *built), STATIONS), scanner=Scanner(step=0.003), seed=3).stations
    told = scanfind.find(cloud, design, parameters=QUICK, at_design=True).elements
    assert told[0].status != INSTALLED
    assert told[1].status == INSTALLED
    assert told[1].shift_m == pytest.approx((0.0, 0.0, 0.0), abs=0.002)
    if wall:
        assert told[2].status != INSTALLED
    else:
        assert told[2].status == INSTALLED
        assert told[2].shift_m == pytest.approx((0.0, 0.02, 0.056), abs=0.002)
