"""What stands beside its place: found where ICP does not lead, and never taken for it where it is another's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import scanfind
from scanfind.design.elements import INSTALLED
from scanfind.library.near_surface import near_triangles
from scanfind.mesh import Placement
from scanfind.parameters import PRESETS
from scanfind.pose import Pose, random_rotation
from scanfind.recognition.around import MOST_PEAKS, STEPS_M, beside, of_others, peaks
from scanfind.recognition.candidate import Standing
from scanfind.simulate.parts import blocks, box
from scanfind.simulate.scanner import Scanner, scan
from scanfind.simulate.scene import Scene, SceneObject

FLAT = replace(box(1.5, 0.08, 0.008), name="flat")
FLOOR = SceneObject("floor", blocks("floor", [((-4, -4, -0.3), (4, 4, -0.2))]), Pose.identity())
STATIONS = np.array([[-1.0, -3.0, 1.5], [2.0, -2.5, 1.8], [0.5, 3.0, 1.6]])

QUICK = replace(PRESETS["default"], search=replace(PRESETS["default"].search, time_limit_s=0.1))


def at(x: float, y: float, z: float) -> Pose:
    return Pose(np.eye(3), np.array([x, y, z]))


@given(st.integers(0, 2**32 - 1), st.integers(1, 9))
@settings(max_examples=50, deadline=None)
def test_the_highest_is_the_first_peak_and_no_neighbour_exceeds_one(seed: int, size: int) -> None:
    values = np.random.default_rng(seed).integers(0, 9, (size, size)).astype(np.float64)
    found = peaks(values)
    assert 1 <= len(found) <= MOST_PEAKS
    assert values.ravel()[found[0]] == values.max()
    for row, column in zip(*np.divmod(found, size), strict=True):
        assert values[row, column] == values[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2].max()


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_places_beside_a_pose_lie_across_its_length_and_turn_with_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose, points = Pose(random_rotation(rng), rng.normal(size=3)), FLAT.vertices
    shifts = np.array(
        [pose.inverse().turn((each.translation - pose.translation)[None])[0] for each in beside(pose, points)]
    )
    np.testing.assert_allclose(shifts[:, 0], 0.0, atol=1e-12)
    np.testing.assert_allclose(np.unique(shifts[:, 1:].round(9)), np.unique(STEPS_M.round(9)), atol=1e-9)


def test_what_lies_on_another_is_its_own_only_as_far_as_the_other_does_not_reach() -> None:
    other = Standing(near_triangles(FLAT.triangles(), 0.03), at(0.0, 0.0, 0.0))
    points = np.column_stack([np.linspace(0.01, 2.99, 150), np.full(150, 0.04), np.full(150, 0.01)])
    areas = np.ones(150)
    assert of_others(points, areas, [other], 0.006) == pytest.approx(0.5, abs=0.01)
    assert of_others(points, areas, [other], 0.001) == 0.0
    assert of_others(points, areas, [], 0.006) == 0.0


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
