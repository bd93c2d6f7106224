"""Parts of a model: how it is cut, where the parts join, and that each is measured where it was built."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from scanfind.assembly import AssemblyParameters, assembly_of
from scanfind.assembly.explain import free_and_held, moved_by, without
from scanfind.assembly.fit import apart, placed
from scanfind.assembly.members import connected, members
from scanfind.assembly.parts import Assembly, first_cut, merged, told_apart
from scanfind.assembly.points import fitted_to_points
from scanfind.detection import Findings
from scanfind.find import find
from scanfind.grid.scene import GridParameters
from scanfind.library import ModelLibrary, ModelParameters
from scanfind.library.pairs import PairParameters
from scanfind.library.surface import SurfaceParameters, random_points
from scanfind.mesh import Mesh
from scanfind.models.parts import Part, join
from scanfind.parameters import PRESETS
from scanfind.pose import Pose, rotation_from_vector, rotation_vector
from scanfind.results.document import document, findings_of
from scanfind.simulate.furniture import hall
from scanfind.simulate.objects import RIGHT_ANGLE, Route
from scanfind.simulate.parts import assemble
from scanfind.simulate.scanner import Scanner, scan
from scanfind.simulate.scene import Scene, SceneObject
from scanfind.simulate.steel import hollow_beam

Floats = NDArray[np.float64]
SURFACE = SurfaceParameters(samples=1500)
small = st.floats(-0.1, 0.1).map(lambda x: round(x, 4))
vectors = st.tuples(small, small, small).map(np.array)


def angle_pipe() -> Mesh:
    """A flanged pipe along z, an elbow, and a flanged pipe along x: one closed surface."""
    back, line = Route(0.1, Pose.from_rotation_vector([np.pi, 0.0, 0.0])), Route(0.1, Pose.identity())
    back.flange()
    line.straight(1.0)
    line.bend(RIGHT_ANGLE)
    line.straight(0.7)
    line.flange()
    return assemble("angle", [*back.placed, *line.placed])


BARS = {
    "post": ([0.0, 0.0, 0.0], [0.0, 0.0, 1.2], 0.1),
    "arm": ([0.05, 0.0, 1.1], [0.9, 0.0, 1.1], 0.1),
    "foot": ([0.05, 0.0, 0.05], [0.9, 0.0, 0.05], 0.1),
    "side": ([0.0, 0.05, 0.6], [0.0, 0.8, 0.6], 0.08),
    "brace": ([0.5, 0.0, 0.1], [0.5, 0.0, 1.05], 0.04),
}


def bracket(name: str = "bracket", without: str = "", moved: dict[str, Pose] | None = None) -> Mesh:
    """A frame of five bars, each a part with a name; some left out or moved."""
    parts = []
    for bar, (start, end, side) in BARS.items():
        mesh, pose = hollow_beam(start, end, side)
        placed_so = (moved or {}).get(bar, Pose.identity()) @ pose
        if bar != without:
            parts.append(Part(bar, placed_so.move(mesh.vertices), mesh.faces.astype(np.int64)))
    return join(name, parts, "")


@cache
def cut() -> Assembly:
    assembly = assembly_of(bracket(), SURFACE)
    assert assembly is not None
    return assembly


def about(place: Floats, turn: Floats, shift: Floats) -> Pose:
    rotation = rotation_from_vector(turn)
    return Pose(rotation, place + shift - rotation @ place)


def test_one_surface_is_cut_into_its_pipes_and_bends() -> None:
    mesh = angle_pipe()
    part, names = members(mesh)
    assert names == ("pipe 1", "pipe 2", "bend 1")
    middle = mesh.triangles().mean(axis=1)
    # The first facets of the bend, at its sides, lie on the pipe as well.
    assert np.mean((part == 0) == (middle[:, 2] < 1.0)) > 0.99
    assert np.mean((part == 1) == (middle[:, 0] > 0.3)) > 0.99


@given(vectors.map(lambda v: 30.0 * v), vectors)
@settings(max_examples=5, deadline=None)
def test_the_cut_moves_with_the_mesh(turn: Floats, shift: Floats) -> None:
    mesh, pose = angle_pipe(), Pose.from_rotation_vector(turn, 100.0 * shift)
    moved = Mesh(mesh.name, pose.move(mesh.vertices), mesh.faces)
    np.testing.assert_array_equal(members(moved)[0], members(mesh)[0])


def test_parts_keep_the_names_of_their_file_through_a_library() -> None:
    with ModelLibrary.in_memory() as library:
        library.add(bracket(), ModelParameters(SurfaceParameters(samples=60), PairParameters(angle_cell_deg=30.0)))
        (model,) = library.models()
    assert model.mesh is not None
    assert first_cut(model.mesh)[1] == tuple(BARS)
    assert told_apart(["bolt", "plate", "bolt"]) == ("bolt #1", "plate", "bolt #2")


def test_joints_lie_where_parts_touch() -> None:
    joints = {
        (cut().names[joint.a], cut().names[joint.b]): joint.place for joint in cut().joints
    }  # fmt: skip
    assert set(joints) == {("post", "arm"), ("post", "foot"), ("post", "side"), ("arm", "brace"), ("foot", "brace")}
    for pair, place in {("post", "arm"): [0.05, 0.0, 1.1], ("post", "side"): [0.0, 0.05, 0.6]}.items():
        np.testing.assert_allclose(joints[pair], place, atol=0.02)


def test_what_is_too_small_joins_what_it_touches_most() -> None:
    touching = np.array([[0, 5, 9, 0], [5, 0, 0, 0], [9, 0, 0, 0], [0, 0, 0, 0]])
    kept, into = merged(np.array([500, 100, 3, 2]), touching)
    np.testing.assert_array_equal(kept, [0, 1])
    np.testing.assert_array_equal(into, [0, 1, 0, 0])


@given(st.integers(1, 12), st.lists(st.tuples(st.integers(0, 11), st.integers(0, 11)), max_size=20))
def test_connected_is_what_one_can_walk_to(count: int, edges: list[tuple[int, int]]) -> None:
    pairs = [(a % count, b % count) for a, b in edges]
    reached = [{k} for k in range(count)]
    for _ in range(count):
        for a, b in pairs:
            both = reached[a] | reached[b]
            reached[a] = reached[b] = both
    lowest = np.array([min(set().union(*(reached[j] for j in reached[k]))) for k in range(count)])
    np.testing.assert_array_equal(connected(count, np.array(pairs, np.int64).reshape(-1, 2)), lowest)


@given(vectors)
def test_rotation_vectors_there_and_back(vector: Floats) -> None:
    np.testing.assert_allclose(rotation_vector(rotation_from_vector(vector)), vector, atol=1e-12)


@given(st.floats(-0.2, 0.2), st.floats(-0.5, 0.5), vectors)
def test_a_pipe_rolls_and_slides_unnoticed_and_its_bend_is_what_remains(
    roll: float, slide: float, bend: Floats
) -> None:  # fmt: skip
    turn = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    normals = np.tile(np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1), (20, 1))
    arms = 0.1 * normals + np.repeat(np.linspace(-0.5, 0.5, 20), 48)[:, None] * [0.0, 0.0, 1.0]
    bent = rotation_from_vector([bend[0], bend[1], 0.0])
    arms, normals = arms @ bent.T, normals @ bent.T
    rows = np.hstack([np.cross(arms, normals) / 0.3, normals])
    free, _, fixed = free_and_held(rows.T @ rows, moved_by(arms, 0.3))
    assert free.shape == (6, 2)
    axis = bent[:, 2]
    motion = Pose(rotation_from_vector(roll * axis) @ bent, slide * axis)
    left = without(fixed, motion, np.zeros(3), 0.3)
    np.testing.assert_allclose(left.rotation, bent, atol=1e-6)
    np.testing.assert_allclose(left.translation, 0.0, atol=1e-6)


@given(vectors.map(lambda v: 0.5 * v), vectors.map(lambda v: 0.1 * v))
@settings(max_examples=8, deadline=None)
def test_a_part_is_found_where_its_points_are(turn: Floats, shift: Floats) -> None:
    mesh, assembly = bracket(), cut()
    at, poses = assembly.names.index("side"), [Pose.identity()] * len(assembly.names)
    joint = next(joint for joint in assembly.joints if at in (joint.a, joint.b))
    # Along its axis a bar is held by its end alone: enough, where all of it was scanned.
    built = about(joint.place, turn, shift)
    own, _ = random_points(bracket(moved={"side": built}), 20_000, np.random.default_rng(0))
    fitted = fitted_to_points(placed(np.arange(len(poses)), poses), mesh, assembly, own)
    gap, angle = apart(fitted.pose(at), built, assembly.arrays.centres[at])
    assert gap < 5e-4
    assert angle < 1e-3


def seek(built: Mesh) -> Findings:
    """Look for the bracket where `built` stands in a room of 4 × 4 × 2.5 m."""
    place = Pose.from_rotation_vector([0.0, 0.0, 0.6], [1.8, 1.7, 0.0])
    objects = (
        SceneObject("hall", hall(4.0, 4.0, 2.5), Pose.identity()),
        SceneObject("built", built, place, target=True),
    )
    room = Scene(objects, np.array([[0.5, 0.6, 1.6], [3.4, 1.0, 1.5], [2.0, 3.5, 1.6]]))
    quick = replace(
        PRESETS["default"],
        grid=GridParameters(cell_m=0.015),
        surface=SurfaceParameters(samples=1000),
        search=replace(PRESETS["default"].search, max_instances=1, pairs_a_round=20_000, hypotheses_a_round=60_000),
        assembly=AssemblyParameters(parts=True, samples=2000),
    )
    scanned = scan(room, seed=1, scanner=Scanner(step=0.007))
    found = find(scanned.stations, bracket(), parameters=quick, seed=1)
    for one in found:
        metres, radians = one.scene_from_model.difference(place)
        assert metres < 0.003
        assert radians < np.radians(0.1)
    return found


@pytest.mark.slow
def test_a_frame_without_its_brace_is_that_frame_and_says_so() -> None:
    (found,) = seek(bracket("built", without="brace"))
    told = {part.name: part for part in found.parts}
    assert {name for name, part in told.items() if part.status == "missing"} == {"brace"}
    assert not any(part.is_off() for part in found.parts)
    again = findings_of(document(Findings([found]), models=[], parameters={}, seed=0))
    assert [part.name for part in again[0].parts] == list(told)
    for one, other in zip(again[0].parts, found.parts, strict=True):
        np.testing.assert_array_equal(one.built_from_design.matrix(), other.built_from_design.matrix())
        assert repr(one.off_m) == repr(other.off_m)
        assert (one.shift_m, one.turn_rad, one.free) == (other.shift_m, other.turn_rad, other.free)


@pytest.mark.slow
def test_a_bar_that_is_bent_is_measured() -> None:
    truth = about(np.array([0.05, 0.0, 1.1]), np.radians([0.0, 0.0, 5.0]), np.zeros(3))
    (found,) = seek(bracket("built", moved={"arm": truth}))
    arm = next(part for part in found.parts if part.name == "arm")
    assert arm.is_off()
    gap, angle = apart(arm.built_from_design, truth, np.array([0.5, 0.0, 1.1]))
    assert gap < 0.002
    assert angle < np.radians(0.2)
    assert [part.name for part in found.parts if part.is_off()] == ["arm"]
