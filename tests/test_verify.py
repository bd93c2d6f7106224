"""Evidence, case by case as it was built: on the scene, seen through, hidden, never looked at; and how it is judged."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from math import comb

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import naive
from scanfind.cloud import CloudModel, PointChunk
from scanfind.evidence.free_space import Limits, Spoken, beams_to, caster_of, covers_of, spoken_by_each, spoken_of
from scanfind.evidence.verify import distinct, gather_support, spread
from scanfind.fit.refine import Refined
from scanfind.grid.depth import LEAST_FILLED, LEAST_SPOKEN, Beams, DepthMap, joined_until_spoken
from scanfind.grid.moments import MomentGrid
from scanfind.grid.scene import GridParameters, Scene, build_scene
from scanfind.kernels.beams import SHORT_STEP_M
from scanfind.kernels.grid import AIM_UNITS, NO_BEAM, RANGE_UNITS, cube_pixel, cube_place, pack_beam, unpack_beam
from scanfind.library.model import Model, ModelParameters, build_model
from scanfind.library.surface import SurfaceParameters
from scanfind.parameters import PRESETS
from scanfind.pose import Pose, random_rotation
from scanfind.recognition.candidate import Candidate
from scanfind.recognition.recognise import Recognition
from scanfind.search.hypotheses import Hypotheses, model_arrays
from scanfind.simulate.parts import blocks
from seen import beams_about

Floats = NDArray[np.float64]

CELL = 0.02
PARAMETERS = replace(PRESETS["default"], grid=GridParameters(cell_m=CELL))
BOX_M, BOX_AT, WALL_AT = 0.4, 2.0, 4.0
# The scanner is at zero and looks along x, ± 30 degrees both ways, at a beam every 0.15 degrees.
HALF_VIEW = np.tan(np.radians(30.0))


@cache
def box() -> Model:
    """A cube about its own origin."""
    half = BOX_M / 2
    mesh = blocks("box", [((-half, -half, -half), (half, half, half))])
    return build_model(mesh, ModelParameters(SurfaceParameters(samples=600)))


def points_seen(noise: float = 0.0) -> Floats:
    """(N, 3) on a box in front of a wall."""
    v, w = (side.ravel() for side in np.meshgrid(*[np.linspace(-HALF_VIEW, HALF_VIEW, 441)] * 2))
    face = BOX_AT - BOX_M / 2
    x = np.where((np.abs(v * face) <= BOX_M / 2) & (np.abs(w * face) <= BOX_M / 2), face, WALL_AT)
    x = x + np.random.default_rng(0).normal(scale=noise, size=len(x))
    return np.stack([x, v * x, w * x], axis=1)


@cache
def scene(known: bool = True) -> Scene:
    """A box in front of a wall; `known`: where the scanner stood."""
    points = points_seen()
    grid = MomentGrid(CELL, np.zeros(3))
    grid.add(PointChunk(points, {}, np.arange(len(points)), origin=np.zeros(3) if known else None))
    return build_scene(grid, box().diameter, PARAMETERS.grid, PARAMETERS.search.test_cells_across, 1)


def weigh(place: tuple[float, float, float], turn: Floats | None = None, known: bool = True) -> Candidate:
    """The evidence for a box at a place."""
    models = [box()]
    found = Recognition(scene(known), models, PARAMETERS, 0, 1)
    rotation = np.eye(3) if turn is None else turn
    pose = Hypotheses(np.zeros(1, np.int64), rotation[None], np.array([place]), np.ones(1))
    return found.weighing.candidates(Refined(pose, np.eye(6)[None], np.ones(1), np.zeros(1)))[0]


def facing_area(place: tuple[float, float, float]) -> float:
    """Surface of a box there that faces the scanner well enough to return a beam, m²."""
    points, normals = box().samples.points + np.array(place), box().samples.normals
    towards = -(points * normals).sum(axis=1) / np.linalg.norm(points, axis=1)
    return float((towards >= PARAMETERS.verify.least_facing).mean()) * 6.0 * BOX_M**2


ON_THE_BOX = (BOX_AT, 0.0, 0.0)
# A pixel on an outline counts whole or not at all, and a beam that passed near one says nothing.
NEARLY = 0.2


def test_on_the_box_its_front_is_supported_and_nothing_seen_through() -> None:
    seen = weigh(ON_THE_BOX).evidence
    front = np.count_nonzero(box().samples.normals[:, 0] < -0.9)
    assert seen.samples == len(box().samples)
    # The outermost cells have too few neighbours for a normal.
    assert 0.85 * front <= seen.supported <= front
    assert seen.spoken.on == pytest.approx(BOX_M**2, rel=0.02)
    assert seen.spoken.beside == seen.spoken.through == seen.spoken.hidden == 0.0
    assert seen.rms < 1e-4
    assert (seen.visible_support(), seen.penalty()) == (1.0, 0.0)
    assert seen.support() == seen.supported / seen.samples
    assert (np.diff(seen.claims) > 0).all()
    claimed = scene(True).fine.means[seen.claims]
    np.testing.assert_allclose(claimed[:, 0], BOX_AT - BOX_M / 2, rtol=0, atol=1e-4)


@pytest.mark.parametrize("place", [(2.0, 0.7, 0.0), (2.5, -0.9, 0.5), (1.0, 0.0, 0.0), (3.2, 1.0, -1.0)])
def test_in_free_space_all_that_faces_the_scanner_is_seen_through(place: tuple[float, float, float]) -> None:
    seen = weigh(place).evidence
    assert seen.spoken.through == pytest.approx(facing_area(place), rel=NEARLY)
    assert (seen.supported, seen.spoken.on, seen.spoken.beside, seen.spoken.hidden) == (0, 0.0, 0.0, 0.0)
    assert (seen.visible_support(), seen.penalty()) == (0.0, 1.0)


@pytest.mark.parametrize("place", [(5.0, 0.0, 0.0), (6.0, 1.0, -1.0), (2.6, 0.0, 0.0)])
def test_behind_something_it_is_hidden(place: tuple[float, float, float]) -> None:
    # The last is behind the box, in its shadow as seen from the scanner.
    seen = weigh(place).evidence
    assert seen.spoken.hidden == pytest.approx(facing_area(place), rel=NEARLY)
    assert (seen.supported, seen.spoken.on, seen.spoken.beside, seen.spoken.through) == (0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("off", [0.015, -0.015])
def test_a_little_before_or_behind_what_is_there_it_is_beside(off: float) -> None:
    # Farther off than noise, nearer than what a beam must go on to have passed through.
    seen = weigh((BOX_AT + off, 0.0, 0.0)).evidence
    assert seen.spoken.beside == pytest.approx(BOX_M**2, rel=0.05)
    assert (seen.spoken.on, seen.spoken.through, seen.spoken.hidden) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("place", [(2.0, 3.0, 0.0), (-3.0, 0.0, 0.0), (0.5, 0.0, 5.0)])
def test_where_nobody_looked_there_is_no_evidence(place: tuple[float, float, float]) -> None:
    seen = weigh(place).evidence
    assert (seen.supported, sum(seen.spoken)) == (0, 0.0)
    assert (seen.visible_support(), seen.penalty()) == (0.0, 0.0)


@pytest.mark.parametrize("place", [ON_THE_BOX, (2.0, 0.7, 0.0), (5.0, 0.0, 0.0)])
def test_without_a_scanner_beams_say_nothing(place: tuple[float, float, float]) -> None:
    blind, known = weigh(place, known=False), weigh(place)
    assert sum(blind.evidence.spoken) == 0.0
    # Sides nobody knows: a back may lie on the scene as well, never fewer samples.
    assert blind.evidence.supported >= known.evidence.supported


def test_flush_with_the_wall_its_front_is_supported() -> None:
    seen = weigh((WALL_AT + BOX_M / 2, 0.8, 0.3)).evidence
    front = np.count_nonzero(box().samples.normals[:, 0] < -0.9)
    assert seen.supported == front
    assert seen.spoken.on == pytest.approx(BOX_M**2, rel=0.02)
    assert seen.spoken.beside == seen.spoken.through == 0.0


# ── beams ──


@settings(deadline=None, max_examples=25)
@given(
    *[st.floats(-1.0, 1.0)] * 3, st.floats(0.01, 1e4), st.sampled_from([45, 360]), st.sampled_from([0, 1, 2]),
    st.booleans(),
)  # fmt: skip
def test_a_beam_is_kept_to_a_hair(
    x: float, y: float, z: float, distance: float, edge: int, major: int, back: bool
) -> None:
    way = np.array([x, y, z])
    way[major] = -1.0 if back else 1.0
    way /= np.linalg.norm(way)
    pixel, packed = pack_beam(*cube_place(*way), edge, distance)
    assert pixel == cube_pixel(*way, edge)
    assert 0 <= packed < NO_BEAM
    *kept, far, angle = unpack_beam(pixel, packed, edge)
    assert abs(far - distance) <= 1.0 / RANGE_UNITS
    assert np.linalg.norm(kept - way) <= 2.0 / edge / AIM_UNITS
    assert np.linalg.norm(kept) == pytest.approx(1.0)
    assert 0.0 < angle <= 4.0 / edge**2
    nearer = pack_beam(*cube_place(*way), edge, distance - 0.01 * distance - 1e-3)[1]
    assert nearer < packed or distance < 1e-3


def test_the_pixels_of_a_map_fill_the_sphere() -> None:
    angles = [unpack_beam(pixel, 0, 45)[4] for pixel in range(6 * 45**2)]
    assert sum(angles) == pytest.approx(4.0 * np.pi, rel=1e-3)


@settings(deadline=None, max_examples=5)
@given(st.integers(0, 2**32))
def test_what_beams_say_is_what_plain_rays_say(seed: int) -> None:
    rng = np.random.default_rng(seed)
    centre = np.array([2.0, 0.0, 0.0]) + rng.uniform(-0.6, 0.6, 3)
    placed = Pose(random_rotation(rng), centre)
    limits = Limits(0.01, 0.05, 0.25)
    beams = beams_about(rng.permutation(points_seen())[:600], np.zeros(3))
    told = spoken_of(box(), caster_of(box()), placed, [beams], limits)
    expected, doubtful = naive.spoken(placed.move(corners_of(box())), points_of(beams), limits)
    each_stands_for = 1.0 / max(beams.filled, LEAST_FILLED)
    said = Spoken(*np.array(told) / each_stands_for)
    np.testing.assert_allclose(said._replace(through=0.0), expected._replace(through=0.0), rtol=0, atol=1e-6)
    assert -1e-6 <= said.through - expected.through <= doubtful + 1e-6
    assert sum(expected) > 0.0


@pytest.mark.parametrize("short", [0.0, 0.05, 0.4, np.inf])
@pytest.mark.parametrize("reach", [0.02, 0.1])  # less and more than a block of pixels
def test_beams_that_fall_short_of_all_points_are_left_out_and_no_others(short: float, reach: float) -> None:
    beams, rng = beams_about(points_seen(), np.zeros(3)), np.random.default_rng(0)
    points = np.array([2.0, 0.0, 0.0]) + rng.uniform(-1.0, 1.0, (60, 3))
    needed, allowed = set[int](), set[int]()
    for point in points:
        about, farther = beams.towards(point[None], reach), beams.towards(point[None], reach + 0.1)
        least = max(0.0, float(np.linalg.norm(point)) - short - 1e-3)
        needed |= set(about[beams.beams_in(about)[1] > least + 2e-3])
        allowed |= set(farther[beams.beams_in(farther)[1] > least - SHORT_STEP_M])
    found = set(beams.towards(points, reach, short))
    assert needed <= found <= allowed
    assert short == np.inf or len(found) < len(beams.towards(points, reach))


@pytest.mark.parametrize("edge", [45, 360, 1800])
def test_few_samples_or_many_every_beam_that_meets_a_model_is_asked(edge: int) -> None:
    points = np.random.default_rng(0).normal(size=(20_000, 3)) * [1.0, 0.3, 0.3] + [6.0, 0.0, 0.0]
    beams, placed = (
        beams_about(points, np.zeros(3), edge),
        Pose(random_rotation(np.random.default_rng(1)), np.array([3.0, 0.0, 0.0])),
    )
    covers = covers_of(box(), placed)
    assert [len(cover.points) for cover in covers] == [600, 75]
    pixels = np.flatnonzero(beams.nearest < NO_BEAM)
    back = placed.inverse()
    hits = caster_of(box()).shoot(back.move(np.zeros((1, 3)))[0], beams.beams_in(pixels)[0] @ placed.rotation)
    meeting = set(pixels[np.isfinite(hits.distance)])
    assert len(meeting) > 10
    for cover in covers:
        assert meeting <= set(beams.towards(*cover))
    asked = len(beams_to(covers, [beams]).ranges)
    assert min(len(beams.towards(*cover)) for cover in covers) <= asked <= len(beams.towards(*covers[-1]))


def test_moving_everything_changes_nothing_a_beam_says() -> None:
    moved = Pose.from_rotation_vector(np.array([0.3, -1.0, 2.0]), np.array([10.0, -7.0, 3.0]))
    placed, limits = Pose(np.eye(3), np.array([2.1, 0.15, 0.1])), Limits(0.01, 0.05, 0.25)
    points = points_seen()
    here = spoken_of(box(), caster_of(box()), placed, [beams_about(points, np.zeros(3))], limits)
    there = beams_about(moved.move(points), moved.translation)
    told = spoken_of(box(), caster_of(box()), moved @ placed, [there], limits)
    # Other pixels hold other beams.
    np.testing.assert_allclose(told, here, rtol=0.15, atol=0.006)
    assert min(here.hidden, here.through) > 0.01


def test_what_all_scanners_say_is_what_each_says_summed() -> None:
    placed, limits, points = Pose(np.eye(3), np.array([2.1, 0.15, 0.1])), Limits(0.01, 0.05, 0.25), points_seen()
    scanners = [beams_about(points[::2], np.zeros(3)), beams_about(points[1::2], np.array([0.1, 0.4, 0.0]))]
    each = spoken_by_each(box(), caster_of(box()), placed, scanners, limits)
    np.testing.assert_allclose(spoken_of(box(), caster_of(box()), placed, scanners, limits), each.sum(axis=0))
    for row, scanner in zip(each, scanners, strict=True):
        np.testing.assert_allclose(row, spoken_of(box(), caster_of(box()), placed, [scanner], limits))
        assert row.sum() > 0.0


def test_of_more_beams_than_needed_a_share_says_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    placed, limits = Pose(np.eye(3), np.array([2.1, 0.15, 0.1])), Limits(0.01, 0.05, 0.25)
    beams = [beams_about(points_seen(), np.zeros(3))]
    every = spoken_of(box(), caster_of(box()), placed, beams, limits)
    monkeypatch.setattr("scanfind.evidence.free_space.MOST_BEAMS", 500)
    some = spoken_of(box(), caster_of(box()), placed, beams, limits)
    assert some != every
    np.testing.assert_allclose(some, every, rtol=0, atol=0.1 * sum(every))


def test_a_piece_of_scan_is_met_as_the_surface_it_was_cut_from() -> None:
    rng = np.random.default_rng(0)
    sphere = rng.normal(size=(40_000, 3))
    sphere *= 0.5 / np.linalg.norm(sphere, axis=1, keepdims=True)
    model = build_model(CloudModel("ball", sphere, "", np.array([9.0, 0.0, 0.0])), ModelParameters())
    ways = rng.normal(size=(2000, 3))
    hits = caster_of(model).shoot(np.zeros(3), ways / np.linalg.norm(ways, axis=1, keepdims=True))
    met = np.isfinite(hits.distance)
    assert met.mean() > 0.35  # between the squares there is nothing to meet
    np.testing.assert_allclose(hits.distance[met], 0.5, rtol=0, atol=0.5 * model.spacing)


def points_of(beams: Beams) -> tuple[Floats, Floats]:
    """Where beams ended, (B, 3), and the solid angles of their pixels (B,)."""
    found = [unpack_beam(k, beams.nearest[k], beams.edge) for k in np.flatnonzero(beams.nearest < NO_BEAM)]
    return np.array([np.array(way) * far for *way, far, _ in found]), np.array([angle for *_, angle in found])


def corners_of(model: Model) -> Floats:
    """(F, 3, 3)."""
    assert model.mesh is not None
    return model.mesh.triangles()


def test_evidence_is_each_pose_s_own() -> None:
    models, places = [box()], [ON_THE_BOX, (2.0, 0.7, 0.0), (5.0, 0.0, 0.0), (2.0, 3.0, 0.0)]
    found = Recognition(scene(), models, PARAMETERS, 0, 2)
    poses = Hypotheses(np.zeros(4, np.int64), np.tile(np.eye(3), (4, 1, 1)), np.array(places), np.ones(4))
    together = found.weighing.candidates(Refined(poses, np.zeros((4, 6, 6)), np.ones(4), np.zeros(4)))
    for one, place in zip(together, places, strict=True):
        alone = weigh(place).evidence
        assert one.evidence._replace(claims=alone.claims) == alone
        np.testing.assert_array_equal(one.evidence.claims, alone.claims)


def test_what_is_there_scores_above_what_is_not() -> None:
    there, hidden, missing = (weigh(p).score for p in (ON_THE_BOX, (5.0, 0.0, 0.0), (2.0, 0.7, 0.0)))
    assert 0.0 <= missing <= hidden < there <= 1.0
    assert weigh(ON_THE_BOX, known=False).score <= 1.0


# ── sparse scans ──


@given(*[st.integers(0, 3000)] * 3)
def test_silent_samples_are_like_those_that_spoke(through: int, hidden: int, silent: int) -> None:
    told = spread(through, hidden, silent)
    assert through <= told <= through + silent
    if not through:
        assert told == 0
    elif not hidden:
        assert told == through + silent
    else:
        assert abs(told / (through + hidden + silent) - through / (through + hidden)) <= 0.5 / (through + hidden)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 1.0])
def test_a_depth_map_speaks_where_its_pixels_are_filled(share: float) -> None:
    rng = np.random.default_rng(3)
    filled = rng.random(6 * 360**2) < share
    depth = DepthMap(np.zeros(3), np.where(filled, 5.0, np.inf).astype(np.float32), 360)
    # Three of five by chance; at the borders of a face a pixel has fewer beside it.
    expected = sum(comb(5, k) * share**k * (1.0 - share) ** (5 - k) for k in (3, 4, 5))
    assert depth.spoken() == pytest.approx(1.0 if share == 0.0 else expected, abs=0.01)
    (joined,) = joined_until_spoken([depth])
    assert joined.edge == 360 or depth.spoken() < LEAST_SPOKEN
    assert joined.edge == 45 or joined.spoken() >= LEAST_SPOKEN


def test_thin_places_are_asked_on_the_coarse_level() -> None:
    # A tenth of the beams: most fine cells on the box are empty, the coarse ones hold a point or two.
    sparse, dense = (weigh_in(Recognition(at, [box()], PARAMETERS, 0, 1)) for at in (thinned(0.04), scene(True)))
    assert dense[0] == dense[1]
    assert sparse[0] > 1.3 * sparse[1] > 0


def weigh_in(found: Recognition) -> tuple[float, float]:
    """Support of the box where it is, with and without the coarse level."""
    pose = Hypotheses(np.zeros(1, np.int64), np.eye(3)[None], np.array([ON_THE_BOX]), np.ones(1))
    ground, weighing = found.ground, found.weighing
    ground.fit_near(pose, 2)
    (both,), (fine,) = (
        gather_support(pose, ground.scene, weighing.fine, thin, ground.arrays, ground.signed, PARAMETERS.verify, 1)
        for thin in (weighing.thin, None)
    )
    return both.supported / both.samples, fine.supported / fine.samples


@cache
def thinned(share: float) -> Scene:
    """The box before the wall with a share of its beams."""
    points = points_seen()
    kept = points[np.random.default_rng(1).random(len(points)) < share]
    grid = MomentGrid(CELL, np.zeros(3))
    grid.add(PointChunk(kept, {}, np.arange(len(kept)), origin=np.zeros(3)))
    return build_scene(grid, box().diameter, PARAMETERS.grid, PARAMETERS.search.test_cells_across, 1)


# ── one pose of many alike ──


@given(st.integers(0, 2**32), st.integers(1, 30), st.integers(1, 8), st.integers(1, 20))
def test_distinct_poses_are_apart_and_the_first_of_their_group(seed: int, count: int, most: int, in_all: int) -> None:
    rng = np.random.default_rng(seed)
    turns = [
        Pose.from_rotation_vector(rng.normal(scale=0.1, size=3), rng.normal(scale=0.1, size=3)) for _ in range(count)
    ]
    arrays, apart = model_arrays([box()]), np.array([0.1])
    poses = Hypotheses(
        np.zeros(count, np.int64), np.array([p.rotation for p in turns]), np.array([p.translation for p in turns]),
        np.ones(count),
    )  # fmt: skip
    kept = distinct(poses, arrays, apart, most, in_all).tolist()
    assert kept == sorted(set(kept))
    assert 0 in kept
    assert len(kept) <= min(most, in_all)
    radius, centre = arrays.radii[0], arrays.centres[0]
    outline = centre + radius * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])

    def moved(a: int, b: int) -> float:
        return float(np.linalg.norm(turns[a].move(outline) - turns[b].move(outline), axis=1).max())

    assert all(moved(a, b) >= 0.1 for a in kept for b in kept if a < b)
    if len(kept) < min(most, in_all):
        assert all(any(moved(k, other) < 0.1 for other in kept if other <= k) for k in range(count))
