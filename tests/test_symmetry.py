"""Laws of symmetries: groups, what is found of known bodies wherever they lie, and errors that no symmetry changes."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from scanfind.cloud import CloudModel
from scanfind.errors import UsageError
from scanfind.library.cloud_surface import sample_cloud
from scanfind.library.model import ModelParameters, build_model
from scanfind.library.onto_itself import OntoItself
from scanfind.library.self_similar import LEAST_OVERLAP, Similar, find_similar
from scanfind.library.surface import SurfaceParameters, sample_mesh
from scanfind.library.symmetries import declared_symmetry, find_symmetry
from scanfind.mesh import Mesh
from scanfind.pose import Pose, random_rotation
from scanfind.simulate.objects import box_frame
from scanfind.simulate.parts import blocks, box, cylinder, flange, pipe, revolve, tee
from scanfind.simulate.placement import surface_points
from scanfind.symmetry import Symmetry, parse_axes, pose_error

Floats = NDArray[np.float64]

SOMEWHERE = Pose(random_rotation(np.random.default_rng(1)), np.array([1.0, 2.0, 3.0]))
BRACKET = blocks("bracket", [((0, 0, 0), (1, 0.3, 0.1)), ((0, 0, 0), (0.1, 0.3, 0.7))])
GROUPS = {
    "none": 1, "x2": 2, "z5": 5, "z24": 24, "x2,y2,z2": 4, "z4,x2": 8, "z3,y2": 6, "x4,z4": 24, "z*": 1, "z*,x2": 2,
    "x*,z*": 1,
}  # fmt: skip

poses = st.integers(0, 2**32 - 1).map(lambda seed: pose_of(np.random.default_rng(seed)))
groups = st.sampled_from(list(GROUPS))


def pose_of(rng: np.random.Generator) -> Pose:
    return Pose(random_rotation(rng), rng.normal(size=3))


def symmetry_of(axes: str, turned: Pose) -> Symmetry:
    """About a centre that is not the origin, along axes that are not the coordinate axes."""
    return Symmetry(np.array([0.3, -0.2, 0.5]), parse_axes(axes)).moved(turned)


def member_of(symmetry: Symmetry, rng: np.random.Generator) -> Pose:
    """Any of its motions, not only those in steps."""
    turn = symmetry.turns[rng.integers(len(symmetry.turns))]
    if symmetry.sphere:
        turn = random_rotation(rng)
    elif len(symmetry.free):
        turn = turn @ Pose.from_rotation_vector(symmetry.free[0] * rng.uniform(0, 7)).rotation
    return Pose(turn, symmetry.centre - turn @ symmetry.centre)


# ── the group ─────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("axes", GROUPS)
def test_the_turns_are_a_group(axes: str) -> None:
    turns = symmetry_of(axes, SOMEWHERE).turns

    def is_one(turn: Floats) -> bool:
        return bool(np.abs(turns - turn).max(axis=(1, 2)).min() < 1e-9)

    assert len(turns) == GROUPS[axes]
    np.testing.assert_array_equal(turns[0], np.eye(3))
    for one in turns:
        assert np.linalg.det(one) == pytest.approx(1.0)
        assert is_one(one.T)
        assert all(is_one(one @ other) for other in turns)


@given(axes=groups, turned=poses, seed=st.integers(0, 1000))
@settings(max_examples=50, deadline=None)
def test_of_places_alike_one_stands_for_all(axes: str, turned: Pose, seed: int) -> None:
    symmetry = symmetry_of(axes, turned)
    points = np.random.default_rng(seed).normal(size=(20, 3))
    alike = np.array([symmetry.stands_for_its_like(motion.move(points)) for motion in symmetry.motions()])
    np.testing.assert_array_equal(alike.sum(axis=0), 1)


def test_on_an_axis_and_in_the_centre_every_place_stands_for_itself() -> None:
    about_z = Symmetry(np.ones(3), parse_axes("z4"))
    assert about_z.stands_for_its_like(np.array([[1.0, 1.0, 1.0], [1.0, 1.0, 7.0]])).all()


@given(axes=groups, turned=poses, found=poses, truth=poses, seed=st.integers(0, 1000))
@settings(max_examples=100, deadline=None)
def test_no_symmetry_changes_an_error(axes: str, turned: Pose, found: Pose, truth: Pose, seed: int) -> None:
    rng, symmetry = np.random.default_rng(seed), symmetry_of(axes, turned)
    error = pose_error(found, truth, symmetry)
    again = pose_error(found @ member_of(symmetry, rng), truth @ member_of(symmetry, rng), symmetry)
    assert again == pytest.approx(error, abs=1e-6)
    assert pose_error(truth @ member_of(symmetry, rng), truth, symmetry) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert pose_error(truth, found, symmetry) == pytest.approx(error, abs=1e-6)
    assert error.rotation_rad <= found.difference(truth)[1] + 1e-9
    moved = pose_error(turned @ found, turned @ truth, symmetry)
    assert moved == pytest.approx(error, abs=1e-6)


def test_without_symmetry_the_error_is_that_of_the_poses() -> None:
    centre = np.array([0.3, -0.2, 0.5])
    found = SOMEWHERE @ Pose.from_rotation_vector([0.0, 0.2, 0.0], [0.01, 0.0, 0.0])
    error = pose_error(found, SOMEWHERE, Symmetry(centre))
    assert error.rotation_rad == pytest.approx(0.2)
    assert error.translation_m == pytest.approx(np.linalg.norm(found.move(centre) - SOMEWHERE.move(centre)))


def test_a_turn_across_a_free_axis_is_an_error_and_one_about_it_is_none() -> None:
    symmetry = Symmetry(np.zeros(3), parse_axes("z*"))
    assert pose_error(Pose.from_rotation_vector([0, 0.3, 0]), Pose.identity(), symmetry)[1] == pytest.approx(0.3)
    assert pose_error(Pose.from_rotation_vector([np.pi, 0, 0]), Pose.identity(), symmetry)[1] == pytest.approx(np.pi)
    either_end = Symmetry(np.zeros(3), parse_axes("z*,x2"))
    assert pose_error(Pose.from_rotation_vector([0, np.pi, 0]), Pose.identity(), either_end)[1] < 1e-9


# ── one pose of those that look the same ──────────────────────────────────────────────────────────────────────────


@given(axes=groups, turned=poses, pose=poses, seed=st.integers(0, 1000))
@settings(max_examples=100, deadline=None)
def test_equivalent_poses_have_one_canonical(axes: str, turned: Pose, pose: Pose, seed: int) -> None:
    symmetry = symmetry_of(axes, turned)
    one = symmetry.canonical(pose)
    assert pose_error(one, pose, symmetry) == pytest.approx((0.0, 0.0), abs=1e-6)
    other = symmetry.canonical(pose @ member_of(symmetry, np.random.default_rng(seed)))
    assert one.difference(other) == pytest.approx((0.0, 0.0), abs=1e-6)


@pytest.mark.parametrize("axes", GROUPS)
def test_what_stands_as_drawn_stays_so(axes: str) -> None:
    symmetry = Symmetry(np.array([0.3, -0.2, 0.5]), parse_axes(axes))
    for motion in symmetry.motions():
        assert symmetry.canonical(motion).difference(Pose.identity()) == pytest.approx((0.0, 0.0), abs=1e-6)


@pytest.mark.parametrize("axes", GROUPS)
@pytest.mark.parametrize("quarters", [(0, 0, 1), (0, 0, 2), (0, 1, 0), (2, 0, 0), (1, 0, 0)])
def test_what_stands_square_is_reported_alike_whatever_the_noise(axes: str, quarters: tuple[int, int, int]) -> None:
    """Half way between two equivalent poses the last digit would choose, if the nearest to none were taken."""
    symmetry, rng = Symmetry(np.array([0.3, -0.2, 0.5]), parse_axes(axes)), np.random.default_rng(0)
    square = Pose.from_rotation_vector(np.pi / 2 * np.array(quarters))
    shaken = [square @ Pose.from_rotation_vector(rng.normal(0, 2e-3, 3)) @ member_of(symmetry, rng) for _ in range(8)]
    told = [symmetry.canonical(pose) for pose in shaken]
    assert max(told[0].difference(pose)[1] for pose in told) < 0.15


# ── as people say it ──────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("axes", "words"),
    [
        ("none", "none"),
        ("x2", "2-fold about x"),
        ("x2, Y2, z2", "2-fold about x, y and z"),
        ("z4,x2", "4-fold about z; 2-fold about x"),
        ("x*", "free to roll about x"),
        ("z*,x2", "free to roll about z; 2-fold about x"),
        ("x*,y*", "free to turn about every axis"),
    ],
)
def test_in_words(axes: str, words: str) -> None:
    assert Symmetry(np.zeros(3), parse_axes(axes)).words() == words


@pytest.mark.parametrize(
    "text", ["", "w2", "x", "2x", "x2 z4", "x1", "x0", "z61", "x**", "none,x2", "x-2", "z5,x4", "z*,x3"]
)
def test_what_is_no_symmetry_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(UsageError) as caught:
        ModelParameters(symmetry=text)
    assert "\n" not in str(caught.value)


# ── what is found ─────────────────────────────────────────────────────────────────────────────────────────────────


def drilled(holes: int, radius: float, at: float = 0.14, inner: float = 0.05, outer: float = 0.17) -> Mesh:
    """A ring 22 mm thick with holes through it: of each sector, strips lead from the hole's rim to the border."""
    go = np.linspace(-1, 1, 16, endpoint=False)
    stay = np.ones(16)
    square = np.concatenate([np.c_[go, -stay], np.c_[stay, go], np.c_[-go, stay], np.c_[-stay, -go]])
    border_radius, border_turn = (inner + outer) / 2 + square[:, 0] * (outer - inner) / 2, square[:, 1] * np.pi / holes
    way = np.arctan2(square[:, 1], square[:, 0])
    border = np.c_[border_radius * np.cos(border_turn), border_radius * np.sin(border_turn)]
    rim = np.c_[at + radius * np.cos(way), radius * np.sin(way)]
    turns = 2 * np.pi * np.arange(4 * 16) / (4 * 16)
    circles = [np.c_[r * np.cos(turns), r * np.sin(turns)] for r in (inner, outer)]
    strips = [(circle, 0.0, circle, 0.022) for circle in circles]
    for k in range(holes):
        turn = Pose.from_rotation_vector([0, 0, 2 * np.pi * k / holes + 0.1]).rotation[:2, :2].T
        b, r = border @ turn, rim @ turn
        strips += [(b, 0.022, r, 0.022), (r, 0.0, b, 0.0), (r, 0.022, r, 0.0)]
    here = np.arange(64)
    on = np.roll(here, -1)
    quads = np.concatenate([np.c_[here, on, on + 64], np.c_[here, on + 64, here + 64]])
    corners = [np.c_[line, np.full(64, z)] for a, low, b, high in strips for line, z in ((a, low), (b, high))]
    return Mesh.of("drilled", np.concatenate(corners), np.concatenate([quads + 128 * k for k in range(len(strips))]))


def tetrahedron() -> Mesh:
    corners = 0.5 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]])
    return Mesh.of("tetrahedron", corners, [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])


def ball() -> Mesh:
    turns = np.linspace(0, np.pi, 49)
    return revolve("ball", [(abs(0.3 * np.sin(t)), -0.3 * np.cos(t)) for t in turns])


def moved(mesh: Mesh, pose: Pose) -> Mesh:
    return Mesh.of(mesh.name, pose.move(mesh.vertices), mesh.faces)


@cache
def itself(mesh: Mesh, samples: int = 1500) -> OntoItself:
    return OntoItself(sample_mesh(mesh, SurfaceParameters(samples=samples)), mesh)


def similar_to(model: OntoItself) -> tuple[Similar, ...]:
    return find_similar(model, find_symmetry(model))


KNOWN = [
    (box(1.0, 0.7, 0.4), "x2,y2,z2", (0.5, 0.35, 0.2)),
    (box(0.5, 0.5, 1.2), "z4,x2", (0.25, 0.25, 0.6)),
    (box(0.5, 0.5, 0.5), "x4,z4", (0.25, 0.25, 0.25)),
    (cylinder(0.1, 1.2), "z*,x2", (0, 0, 0.6)),
    (pipe(0.1, 1.2), "z*,x2", (0, 0, 0.6)),
    (flange(0.1, 0.17, 0.02), "z*", None),
    (tee(0.1, 0.1, 0.6, 0.3), "x2", None),
    (ball(), "x*,z*", (0, 0, 0)),
    (BRACKET, "none", None),
    (box_frame(), "none", None),
]


@pytest.mark.parametrize("pose", [Pose.identity(), SOMEWHERE], ids=["as drawn", "moved"])
@pytest.mark.parametrize(("mesh", "axes", "centre"), KNOWN, ids=lambda value: getattr(value, "name", ""))
def test_what_is_known_is_found_and_moves_with_the_model(
    mesh: Mesh, axes: str, centre: tuple[float, float, float] | None, pose: Pose
) -> None:
    found = find_symmetry(itself(moved(mesh, pose))).moved(pose.inverse())
    expected = Symmetry(found.centre if centre is None else np.array(centre), parse_axes(axes))
    assert len(found.turns) == len(expected.turns)
    assert len(found.free) == len(expected.free) or found.sphere
    assert found.centre == pytest.approx(expected.centre, abs=2e-3)
    for motion in found.motions():
        assert pose_error(motion, Pose.identity(), expected) == pytest.approx((0.0, 0.0), abs=4e-3)


def test_a_tetrahedron_has_twelve_turns_and_no_more() -> None:
    found = find_symmetry(itself(moved(tetrahedron(), SOMEWHERE)))
    assert len(found.turns) == 12
    assert sorted(round(float(np.trace(turn))) for turn in found.turns) == [-1] * 3 + [0] * 8 + [3]


@pytest.mark.parametrize(
    ("holes", "radius", "says"),
    [
        (8, 0.011, "8-fold"),
        (8, 0.001, "free to roll"),  # of 3,000 samples fewer than one in two hundred lies where they are
        (5, 0.011, "5-fold"),
        (16, 0.009, "16-fold"),
    ],
)
def test_a_flange_turns_by_its_holes_where_the_samples_see_them(holes: int, radius: float, says: str) -> None:
    found = find_symmetry(itself(drilled(holes, radius), 3000))
    assert found.words().startswith(f"{says}"), found.words()
    axis = np.array(found.axes[0].direction)
    assert abs(axis[2]) == pytest.approx(1.0, abs=1e-5)


def test_what_is_found_is_the_surface_itself() -> None:
    """All samples against all triangles, by another measure: the corners of the mesh come onto the mesh."""
    mesh = moved(box(0.5, 0.5, 1.2), SOMEWHERE)
    for motion in find_symmetry(itself(mesh)).motions():
        apart = np.linalg.norm(motion.move(mesh.vertices)[:, None] - mesh.vertices[None], axis=2).min(axis=1)
        assert apart.max() < 1e-5


def test_a_mirror_twin_is_another_part() -> None:
    """Mirror planes are no symmetries: of a gusset with one there is nothing to turn; of a channel's two, one axis."""
    gusset = blocks("gusset", [((0, 0, 0), (1, 0.3, 0.1)), ((0, 0.1, 0.1), (0.1, 0.2, 0.7))])
    assert find_symmetry(itself(gusset)).words() == "none"
    channel = blocks(
        "channel", [((0, 0, 0), (1, 0.3, 0.05)), ((0, 0, 0), (1, 0.05, 0.2)), ((0, 0.25, 0), (1, 0.3, 0.2))]
    )
    assert find_symmetry(itself(channel)).words() == "2-fold about z"


def test_a_piece_of_scan_has_symmetries_too() -> None:
    mesh = box(1.0, 0.7, 0.4)
    points = surface_points(mesh, np.random.default_rng(0), 100_000.0)
    surface = sample_cloud(CloudModel("piece", points), SurfaceParameters())
    assert len(find_symmetry(OntoItself(surface, None)).turns) == 4


# ── what it could be taken for ────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("pose", [Pose.identity(), SOMEWHERE], ids=["as drawn", "moved"])
def test_the_frame_could_be_taken_for_itself_turned_over_and_each_way_once(pose: Pose) -> None:
    frame = itself(moved(box_frame(), pose))
    found = similar_to(frame)
    assert len(found) == 7
    assert all(0.8 < each.overlap < 0.97 for each in found)
    assert [each.overlap for each in found] == sorted((each.overlap for each in found), reverse=True)


def test_turns_that_cannot_fit_are_left_out_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is found is found without that, too."""
    branches = [((0.5, 0, 0.2), (0.7, 0.2, 0.7)), ((2.2, 0, 0.2), (2.4, 0.2, 0.5))]
    run = blocks("run", [((0, 0, 0), (3, 0.2, 0.2)), *branches])
    for mesh in (run, moved(run, SOMEWHERE), box(1.0, 0.7, 0.4), BRACKET, tee(0.1, 0.1, 0.6, 0.3)):
        with_it = similar_to(itself(mesh))
        with monkeypatch.context() as patched:
            patched.setattr("scanfind.library.self_similar._fits", lambda *_: True)
            without = similar_to(itself(mesh))
        assert [each.overlap for each in with_it] == [each.overlap for each in without]


def test_a_symmetry_is_no_alternative() -> None:
    for mesh in (box(0.5, 0.5, 0.5), cylinder(0.1, 1.2), ball()):
        assert similar_to(itself(mesh)) == ()


def test_a_symmetry_that_somebody_forbids_is_one() -> None:
    forbidden = build_model(box(1.0, 0.7, 0.4), ModelParameters(SurfaceParameters(samples=1000), symmetry="none"))
    assert forbidden.symmetry.words() == "none"
    assert [each.overlap > 0.95 for each in forbidden.similar][:3] == [True] * 3


def test_a_rack_could_be_taken_for_itself_one_bay_on() -> None:
    bay, bays = 0.5, 4
    posts = [((bay * k, y, 0), (bay * k + 0.05, y + 0.05, 1)) for k in range(bays + 1) for y in (0, 0.4)]
    rungs = [((bay * k, 0, 0.5), (bay * k + 0.05, 0.45, 0.55)) for k in range(bays + 1)]
    rack = itself(moved(blocks("rack", [*posts, *rungs]), SOMEWHERE))
    found, symmetry = similar_to(rack), find_symmetry(rack)
    along = SOMEWHERE.turn(np.array([[1.0, 0, 0]]))[0]
    assert all(each.overlap >= LEAST_OVERLAP for each in found)
    for expected in (-2 * bay, -bay, bay, 2 * bay):
        # A half turn is a symmetry of it: what that leads to is the same.
        motion = Pose(np.eye(3), expected * along)
        assert min(pose_error(each.motion, motion, symmetry).translation_m for each in found) < 0.01


@pytest.mark.parametrize("pose", [Pose.identity(), SOMEWHERE], ids=["as drawn", "moved"])
def test_a_header_could_be_taken_for_itself_end_for_end_by_its_ends_or_by_its_branches(pose: Pose) -> None:
    length, off = 2.0, 0.15
    pieces = [((0.0, 0.0, 0.0), (length, 0.16, 0.16))]
    pieces += [((x, 0.03, 0.16), (x + 0.1, 0.13, 0.5)) for x in (0.5, length - off - 0.6)]
    found = similar_to(itself(moved(blocks("header", pieces), pose)))
    as_drawn = [pose.inverse() @ each.motion @ pose for each in found]
    ends = [motion.translation[0] for motion in as_drawn if motion.rotation[2, 2] > 0.99]  # where the near end goes
    for expected in (length, length - off):
        assert min(abs(end - expected) for end in ends) < 0.01, ends


def test_a_beam_that_slides_along_itself_repeats_nothing() -> None:
    beam = itself(box(3.0, 0.2, 0.3))
    assert all(each.motion.difference(Pose.identity())[1] > 0.1 for each in similar_to(beam))


def test_a_declared_axis_goes_where_the_part_nearly_has_it() -> None:
    nozzle = blocks("vessel", [((0, 0, 0), (0.4, 0.4, 1.0)), ((0.4, 0.15, 0.5), (0.5, 0.25, 0.6))])
    assert find_symmetry(itself(nozzle)).words() == "none"
    declared = declared_symmetry(itself(nozzle), parse_axes("z4"))
    assert declared.words() == "4-fold about z"
    assert declared.centre[:2] == pytest.approx([0.2, 0.2], abs=0.02)
