"""Thin members as lines: what is fitted to a window, who has lines, and that a sparse frame is found by them."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from functools import cache
from itertools import pairwise, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from scanfind.cloud import OrientedCloud, PointChunk
from scanfind.evidence.verify import nearest, outlines
from scanfind.find import find
from scanfind.grid.moments import MomentGrid
from scanfind.grid.scene import Scene, build_scene
from scanfind.grid.surfels import number
from scanfind.kernels.blocks import unpack_block
from scanfind.kernels.lines import fit_lines, lines_of_samples
from scanfind.library.model import Model, ModelParameters, build_model
from scanfind.library.surface import SurfaceParameters
from scanfind.parameters import PRESETS, Parameters
from scanfind.pose import Pose, random_rotation
from scanfind.recognition.recognise import Recognition
from scanfind.search.hypotheses import Hypotheses
from scanfind.search.lines import LEAST_CELLS, REACH, LineSearch, beside, frames, level_of
from scanfind.simulate.instruments import Scanner
from scanfind.simulate.objects import FRAME_SIZE_M, box_frame
from scanfind.simulate.parts import blocks
from scanfind.simulate.scanner import SimulatedScan, scan
from scanfind.simulate.scene import Scene as SimulatedScene
from scanfind.simulate.scene import SceneObject

Floats = NDArray[np.float64]

TRUTH = Pose.from_rotation_vector([0.0, 0.0, 0.7], [1.0, 0.5, 0.02])
STATIONS = [[-3.0, -4.0, 1.6], [6.0, -3.0, 1.7]]
WITHOUT = replace(PRESETS["default"], search=replace(PRESETS["default"].search, by_lines=False))


@cache
def frame() -> Model:
    return build_model(box_frame())


@cache
def sparse_hall() -> SimulatedScan:
    """A frame with 300 points on it, on the floor of a room and among crates: 60 mm between them, 100 mm members."""
    crates = [((x, y, 0.0), (x + 0.8, y + 0.6, 0.7)) for x, y in ((-1.0, -3.0), (-3.0, 3.0), (6.0, -1.5))]
    room = blocks("room", [((-5.0, -6.0, -0.1), (9.0, 7.0, 0.0)), ((-5.0, 7.0, 0.0), (9.0, 7.1, 3.0)), *crates])
    things = (SceneObject("room", room, Pose.identity()), SceneObject("frame", box_frame(), TRUTH, target=True))
    return scan(SimulatedScene(things, np.array(STATIONS)), scanner=Scanner(), seed=3, points=40_000)


@cache
def hall_scene() -> Scene:
    grid = MomentGrid(frame().diameter / 180.0, np.zeros(3))
    for cloud in sparse_hall().stations:
        grid.add(PointChunk(cloud.xyz, {}, np.arange(len(cloud)), origin=cloud.origin))
    return build_scene(grid, frame().diameter, Parameters().grid, Parameters().search.test_cells_across, 1)


def by_eigh(points: Floats) -> tuple[Floats, Floats, float]:
    """Mean, direction of the largest spread, and one less second over largest, the plain way."""
    values, vectors = np.linalg.eigh(np.cov(points.T, bias=True))
    return points.mean(axis=0), vectors[:, 2], float(1.0 - values[1] / values[2])


@settings(deadline=None)
@given(st.integers(0, 2**31))
def test_the_line_of_a_window_is_what_eigenvectors_say(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(60, 3)) @ (random_rotation(rng) * [0.2, 0.05, 0.02]) + rng.uniform(-5, 5, 3)
    lines = np.empty((5, 7))
    lines_of_samples(points, 0.3, 5, lines)
    for at, line in zip(points, lines, strict=False):
        near = points[np.linalg.norm(points - at, axis=1) <= 0.3]
        if len(near) < 4:
            continue
        mean, along, linear = by_eigh(near)
        np.testing.assert_allclose(line[:3], mean, atol=1e-9)
        assert abs(line[3:6] @ along) == pytest.approx(1.0, abs=1e-6)
        assert line[6] == pytest.approx(linear, abs=1e-9)


@settings(deadline=None, max_examples=8)
@given(st.integers(0, 2**31))
def test_the_lines_of_a_grid_are_those_of_its_cells_each_counted_once(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cell, points = 0.25, rng.uniform(-1.5, 1.5, (150, 3))
    grid = MomentGrid(cell, np.zeros(3))
    grid.add(PointChunk(points, {}, np.arange(150), origin=None))
    cells = number(grid, 1)
    lines = np.empty((len(cells), 7))
    fit_lines(
        0, len(cells.order), cells.first_cell, cells.locals, cells.order, cells.block_keys, cells.hash_keys,
        cells.hash_values, cells.block_rows, grid.moments, grid.links, cell, grid.units, REACH, LEAST_CELLS, lines,
    )  # fmt: skip
    members: dict[tuple[int, ...], list[int]] = defaultdict(list)
    for k, where in enumerate(np.floor(points / cell).astype(int).tolist()):
        members[tuple(where)].append(k)
    steps = [step for step in product(range(-3, 4), repeat=3) if np.dot(step, step) <= REACH**2]
    for block, (first, end) in enumerate(pairwise(cells.first_cell.tolist())):
        corner = 8 * np.array(unpack_block(cells.block_keys[cells.order[block]]))
        for cell_at in range(first, end):
            local = int(cells.locals[cell_at])
            where = corner + np.array([local >> 6, local >> 3 & 7, local & 7])
            near = [points[members[to]] for step in steps if (to := tuple((where + step).tolist())) in members]
            if len(near) < LEAST_CELLS:
                assert not lines[cell_at].any()
                continue
            weights = np.concatenate([np.full(len(some), 1.0 / len(some)) for some in near])
            pooled = np.concatenate(near)
            values = np.linalg.eigvalsh(np.cov(pooled.T, bias=True, aweights=weights))
            # Points lie on a lattice of a 4096th of a cell.
            np.testing.assert_allclose(lines[cell_at, :3], np.average(pooled, axis=0, weights=weights), atol=1e-4)
            assert lines[cell_at, 6] == pytest.approx(1.0 - values[1] / values[2], abs=5e-3)


@given(st.integers(0, 2**31))
def test_frames_take_z_to_their_direction_and_lines_move_across_themselves(seed: int) -> None:
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(7, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    turned = frames(directions, rng.uniform(0, 7, 7))
    np.testing.assert_allclose(turned @ turned.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (7, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(turned[:, :, 2], directions, atol=1e-12)
    assert np.linalg.det(turned) == pytest.approx(1.0)
    lines = OrientedCloud(rng.normal(size=(7, 3)), directions, signed=False)
    moved = beside(lines, 0.3).points.reshape(5, 7, 3) - lines.points
    np.testing.assert_allclose(np.linalg.norm(moved, axis=2), np.outer([0, 0.3, 0.3, 0.3, 0.3], np.ones(7)), atol=1e-12)
    np.testing.assert_allclose((moved * directions).sum(axis=2), 0.0, atol=1e-12)


def test_a_frame_has_lines_and_a_block_has_none() -> None:
    level = level_of(frame(), frame().diameter / 180.0)
    assert level is not None
    # Of members of 100 mm: a window of two to five widths across.
    assert 0.1 < REACH * frame().diameter / 180.0 * 2.0**level < 0.25
    few = ModelParameters(SurfaceParameters(samples=600))
    block = build_model(blocks("block", [((0.0, 0.0, 0.0), (1.0, 0.7, 0.5))]), few)
    assert level_of(block, block.diameter / 180.0) is None


@pytest.mark.parametrize("jobs", [1, 2])
def test_lines_tell_the_right_pose_from_any_other_on_any_number_of_threads(jobs: int) -> None:
    scene, rng = hall_scene(), np.random.default_rng(0)
    lines = LineSearch(scene, [frame()], np.ones(1, np.bool_), Parameters().search, 0, jobs)
    offset = scene.fine.cells.offset
    turns = np.array([TRUTH.rotation, *(random_rotation(rng) for _ in range(50))])
    places = np.array([TRUTH.translation, *(rng.uniform(0, 4, (50, 3)))]) - offset
    told = lines.beyond_chance(Hypotheses(np.zeros(51, np.int64), turns, places, np.ones(51)))
    assert told[0] > 0.2
    assert told[1:].max() < 0.05
    first, again = lines.round(), LineSearch(scene, [frame()], np.ones(1, np.bool_), Parameters().search, 0, 1).round()
    np.testing.assert_array_equal(first.translations, again.translations)
    # Turned over, a frame's lines lie on one another but for its brace: one of the best is right.
    traces = np.einsum("kij,ij->k", first.rotations[:50], TRUTH.rotation)
    assert traces.max() > 1.0 + 2.0 * np.cos(np.radians(10.0))


def test_a_scene_without_lines_has_no_hypotheses_and_tells_nothing() -> None:
    x, y = np.meshgrid(np.linspace(-2, 2, 120), np.linspace(-2, 2, 120))
    wall = np.column_stack([np.full(x.size, 3.0), x.ravel(), y.ravel()])
    grid = MomentGrid(frame().diameter / 180.0, np.zeros(3))
    grid.add(PointChunk(wall, {}, np.arange(len(wall)), origin=np.zeros(3)))
    scene = build_scene(grid, frame().diameter, Parameters().grid, Parameters().search.test_cells_across, 1)
    lines = LineSearch(scene, [frame()], np.ones(1, np.bool_), Parameters().search, 0, 1)
    assert lines
    somewhere = Hypotheses(np.zeros(1, np.int64), np.eye(3)[None], np.array([[3.0, 0.0, 0.0]]), np.ones(1))
    assert lines.beyond_chance(somewhere).tolist() == [0.0]
    found = lines.round()
    assert lines.beyond_chance(found).max(initial=0.0) == 0.0


def test_what_is_found_already_is_not_looked_for_by_lines() -> None:
    assert not LineSearch(hall_scene(), [frame()], np.zeros(1, np.bool_), Parameters().search, 0, 1)


def test_a_frame_without_normals_is_found_by_its_lines_only() -> None:
    hall = sparse_hall().stations
    found = find(hall, box_frame(), isolate=False)
    assert len(found) == 1
    middle = np.array(FRAME_SIZE_M) / 2.0
    assert np.linalg.norm(found[0].scene_from_model.move(middle[None]) - TRUTH.move(middle[None])) < 0.01
    assert not find(hall, box_frame(), parameters=WITHOUT, isolate=False)


def test_three_hundred_points_of_a_frame_and_nothing_else_are_enough() -> None:
    far = blocks("far", [((30.0, 30.0, -0.1), (30.1, 30.1, 0.0))])
    things = (SceneObject("far", far, Pose.identity()), SceneObject("frame", box_frame(), TRUTH, target=True))
    alone = scan(SimulatedScene(things, np.array(STATIONS)), scanner=Scanner(), seed=3, points=300)
    found = find(alone.stations, box_frame(), isolate=False)
    assert len(found) == 1
    assert np.linalg.norm(found[0].scene_from_model.translation - TRUTH.translation) < 0.005


# ── what rounds of lines leave behind ──


def recognition() -> Recognition:
    return Recognition(hall_scene(), [frame()], Parameters(), 0, 1)


@pytest.mark.parametrize("by_lines", [True, False])
def test_what_was_found_makes_no_search_longer_and_lines_tell_nothing_of_surface(by_lines: bool) -> None:
    search = recognition().search
    search.round()
    before, tally = search.served.chance_missed(), search.tally()
    assert 0.0 < before < 1.0
    search.learn(0, 1, 1.0, by_lines=by_lines)  # all of it shown and hit but once: as hard to find as a thing can be
    assert search.served.chance_missed() <= before
    assert (search.tally().hits[0] == 0.0) == by_lines
    assert (search.tally().shown[0] == 0.0) == by_lines
    assert search.tally().tested[0] == tally.tested[0]
    search.learn(0, 50, 0.3, by_lines=by_lines)
    assert search.served.chance_missed() < before


def test_what_a_round_came_to_is_fitted_again_only_when_asked() -> None:
    found = recognition()
    hypotheses = LineSearch(hall_scene(), [frame()], np.ones(1, np.bool_), Parameters().search, 0, 1).round()
    first = found.refine(hypotheses)
    assert len(first.rms)
    assert not len(found.refine(hypotheses).rms)
    found.fitting.look_again()
    again = found.refine(hypotheses)
    np.testing.assert_array_equal(again.hypotheses.translations, first.hypotheses.translations)


def test_lines_are_asked_again_until_they_find_nothing_and_lead_to_nothing_known() -> None:
    found, at = recognition(), Pose(TRUTH.rotation, TRUTH.translation - hall_scene().fine.cells.offset)
    arrays = found.ground.arrays
    rounds: list[tuple[int, bool, float]] = []
    truth = outlines(found.ground.placements(0, [at]), arrays)
    while found.wants_more(0.0) and len(rounds) < 12:
        believed, asked = len(found.believed), found.weighing.lines is not None
        hypotheses = found.round()
        rounds.append((believed, asked, float(nearest(outlines(hypotheses, arrays), truth).min(initial=np.inf))))
        found.believe(hypotheses, found.refine(hypotheses))
    assert len(found.believed) == 1
    # Of the first round after it was found, which is of lines, nothing leads to it.
    after = next(off for believed, asked, off in rounds if believed and asked)
    assert after >= frame().diameter / 10.0
    assert min(off for _, _, off in rounds) < frame().diameter / 10.0
