"""What became of the design: each status where it belongs, displacements as they were made, sizes side by side."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import scanfind
from by_hand import folder_by_hand
from scanfind.again import isolate_again
from scanfind.design.elements import (
    IN_TOLERANCE,
    INSTALLED,
    NO_DATA,
    NOT_ENOUGH_DATA,
    NOT_FOUND,
    OCCLUDED,
    OUT_OF_TOLERANCE,
    UNCERTAIN,
    assigned,
    installed,
    off_by,
    status_at,
)
from scanfind.detection import Detection
from scanfind.evidence.free_space import Spoken
from scanfind.fit.refine import Refined, held
from scanfind.library import ModelLibrary
from scanfind.library.model import ModelParameters, build_model
from scanfind.library.surface import SurfaceParameters
from scanfind.mesh import Mesh, Placement
from scanfind.pose import Pose, random_rotation, rotation_from_vector, rotation_vector
from scanfind.recognition.in_place import InPlace
from scanfind.recognition.sizes import SPAN, by_size
from scanfind.results import MODELS, read_results
from scanfind.search.hypotheses import Hypotheses
from scanfind.simulate.parts import blocks, box, cylinder
from scanfind.simulate.scanner import Scanner, scan
from scanfind.simulate.scene import Scene, SceneObject
from scanfind.tolerances import allowed_off, judge_findings, profile_in

SMALL = ModelParameters(SurfaceParameters(samples=200))
BRACKET = blocks("bracket", [((0, 0, 0), (1, 0.3, 0.1)), ((0, 0, 0), (0.1, 0.3, 0.7))])


def at(x: float, y: float, z: float = 0.0, turn: float = 0.0) -> Pose:
    return Pose.from_rotation_vector((0.0, 0.0, turn), (x, y, z))


def placed(mesh: Mesh, *poses: Pose) -> Mesh:
    return replace(
        mesh, placements=tuple(Placement(f"gid{k}", "IfcPlate", f"plate {k}", pose) for k, pose in enumerate(poses))
    )


def detection(number: int, pose: Pose) -> Detection:
    return Detection(number, "bracket", pose, 0.95, 0.5, 0.9, 0.0, 0.5, 0.001)


# ── rules ─────────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("spoken", "status"),
    [
        (Spoken(0.0, 0.0, 0.001, 0.0), NO_DATA),
        (Spoken(0.01, 0.0, 0.01, 0.9), OCCLUDED),
        (Spoken(0.01, 0.0, 0.05, 0.01), NOT_ENOUGH_DATA),
        (Spoken(0.0, 0.1, 0.7, 0.0), NOT_FOUND),
        (Spoken(0.05, 0.7, 0.1, 0.0), NOT_FOUND),
        (Spoken(0.6, 0.2, 0.0, 0.0), UNCERTAIN),
        (Spoken(0.4, 0.3, 0.2, 0.0), UNCERTAIN),
        (None, UNCERTAIN),
    ],
)
def test_what_beams_say_of_a_place_makes_its_status(spoken: Spoken | None, status: str) -> None:
    told, why = status_at(spoken, 1.0)
    assert told == status
    assert why


def test_of_what_has_few_points_beams_say_why_it_is_believed() -> None:
    model = build_model(BRACKET, SMALL)
    (place,), one, spoken = placed(BRACKET, at(0, 0)).placements, detection(1, at(0, 0)), Spoken(0.09, 0.01, 0.0, 3.0)
    assert "50% of its surface lies on the scan" in installed(model, place, one, spoken).why
    thin = replace(one, coverage=0.0)
    assert "90% of what scanners looked at of it is there" in installed(model, place, thin, spoken).why
    assert "0% of its surface lies on the scan" in installed(model, place, thin, None).why


def test_each_detection_is_taken_for_the_place_nearest_to_it_and_once() -> None:
    model = build_model(BRACKET, SMALL)
    places = placed(BRACKET, at(0, 0), at(5, 0), at(10, 0)).placements
    found = [detection(1, at(5.02, 0)), detection(2, at(0.3, 0))]
    taken = assigned(model, places, found)
    assert {place: one.id for place, one in taken.items()} == {1: 1, 0: 2}


def test_what_was_swapped_is_taken_for_the_element_in_whose_place_another_stands() -> None:
    model = build_model(BRACKET, SMALL)
    places = placed(BRACKET, at(0, 0), at(5, 0)).placements
    away = replace(detection(1, at(-1, 0)), instead_of="another")  # nearer to the first, which is missing
    middle = model.symmetry.centre + np.array([5.0, 0.0, 0.0])
    other = replace(detection(2, at(5, 0)), model="another", instead_of="bracket", pivot=tuple(middle.tolist()))
    assert {place: one.id for place, one in assigned(model, places, [away, other]).items()} == {1: 1}
    assert {place: one.id for place, one in assigned(model, places, [away]).items()} == {0: 1}


@given(st.integers(0, 2**32 - 1), st.integers(0, 8), st.integers(1, 8))
@settings(max_examples=50, deadline=None)
def test_of_all_pairs_the_nearest_are_taken_first(seed: int, count: int, wanted: int) -> None:
    rng, model = np.random.default_rng(seed), build_model(BRACKET, SMALL)
    poses = [Pose(random_rotation(rng), rng.normal(size=3)) for _ in range(count + wanted)]
    places = placed(BRACKET, *poses[count:]).placements
    found = [detection(number, pose) for number, pose in enumerate(poses[:count])]
    some = model.samples.points[:50]
    pairs = sorted(
        (off_by(model, some, one.scene_from_model, place.design_from_model), k, one.id)
        for k, place in enumerate(places)
        for one in found
    )
    expected: dict[int, int] = {}
    for _, place, number in pairs:
        if place not in expected and number not in expected.values():
            expected[place] = number
    assert {place: one.id for place, one in assigned(model, places, found).items()} == expected


def test_a_turn_onto_itself_is_no_displacement() -> None:
    rod = build_model(cylinder(0.05, 1.0), SMALL)
    points = rod.samples.points
    middle = rod.symmetry.centre
    rolled = rotation_from_vector([0.0, 0.0, 1.234])
    pose = Pose(rolled, middle - rolled @ middle)
    assert off_by(rod, points, pose, Pose.identity()) < 1e-9
    assert off_by(rod, points, Pose(np.eye(3), np.array([0.02, 0.0, 0.0])), Pose.identity()) == pytest.approx(0.02)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=50, deadline=None)
def test_a_pose_is_held_only_along_what_the_data_leave_open(seed: int) -> None:
    rng = np.random.default_rng(seed)
    design, middle = Pose(random_rotation(rng), rng.normal(size=3)), rng.normal(size=3)
    step = rng.normal(size=6) * 0.01
    turn = rotation_from_vector(step[:3])
    moved = design.move(middle[None])[0] + step[3:]
    found = Pose(turn @ design.rotation, moved - turn @ design.rotation @ middle)
    everything = held(design, found, 1e6 * np.eye(6), middle, 1.0)
    assert np.abs(everything.matrix() - found.matrix()).max() < 0.03 * 0.05
    nothing = held(design, found, np.zeros((6, 6)), middle, 1.0)
    np.testing.assert_allclose(nothing.matrix(), design.matrix(), atol=1e-12)
    open_along = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 0.0])
    shift = held(design, found, open_along, middle, 1.0).move(middle[None])[0] - design.move(middle[None])[0]
    assert abs(shift[2]) < 1e-12
    np.testing.assert_allclose(shift[:2], step[3:5], rtol=0.01)


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 3.1))
@settings(max_examples=50, deadline=None)
def test_a_rotation_and_its_vector_are_one(seed: int, angle: float) -> None:
    axis = np.random.default_rng(seed).normal(size=3)
    vector = axis / np.linalg.norm(axis) * angle
    np.testing.assert_allclose(rotation_vector(rotation_from_vector(vector)), vector, atol=1e-7)


def test_models_of_like_size_are_searched_together_large_ones_first() -> None:
    models = [build_model(replace(box(s, s, s), name=f"{s}"), SMALL) for s in (0.1, 4.0, 0.3, 1.5, 0.11)]
    groups = [[model.name for model in group] for group in by_size(models)]
    assert groups == [["4.0", "1.5"], ["0.1", "0.3", "0.11"]]
    for group in by_size(models):
        diameters = [model.diameter for model in group]
        assert max(diameters) <= SPAN * min(diameters)


# ── a scene ───────────────────────────────────────────────────────────────────────────────────────────────────────

FLOOR = blocks("floor", [((-5, -5, -0.1), (5, 6, 0))])
SCREEN = blocks("screen", [((0, 0, 0), (1.8, 0.1, 1.8)), ((0, 0, 0), (0.1, 1.5, 1.8))])
DESIGN = placed(BRACKET, at(-2, 0), at(0, 0), at(2, 0), at(0, 3))


@pytest.fixture(scope="module")
def inspected() -> scanfind.Findings:
    """Of four plates one as designed, one 30 mm off, one missing, one behind a screen."""
    built = (
        SceneObject("floor", FLOOR, Pose.identity()),
        SceneObject("as designed", BRACKET, at(-2, 0), target=True),
        SceneObject("off", BRACKET, at(0.02, 0.02, 0.01), target=True),
        SceneObject("hidden", BRACKET, at(0, 3), target=True),
        SceneObject("screen", SCREEN, at(-0.4, 2.3)),
    )
    stations = scan(
        Scene(built, np.array([[0.3, -3.5, 1.5], [-3.5, -2.5, 1.5]])), scanner=Scanner(step=0.0015), seed=3
    ).stations
    return scanfind.find(stations, DESIGN, at_design=True)


def test_every_element_has_the_status_it_should(inspected: scanfind.Findings) -> None:
    assert [element.status for element in inspected.elements] == [INSTALLED, INSTALLED, NOT_FOUND, OCCLUDED]
    assert [element.placement.global_id for element in inspected.elements] == ["gid0", "gid1", "gid2", "gid3"]
    assert len(inspected) == 2


def test_however_long_places_take_what_is_elsewhere_is_looked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    built = (
        SceneObject("floor", FLOOR, Pose.identity()),
        SceneObject("as designed", BRACKET, at(-2, 0), target=True),
        SceneObject("elsewhere", BRACKET, at(1.0, 1.5, 0.0, 0.7), target=True),
    )
    stood = np.array([[0.3, -3.5, 1.5], [-3.5, 2.5, 1.5]])
    stations = scan(Scene(built, stood), scanner=Scanner(step=0.0015), seed=3).stations
    default, refine, limit = scanfind.PRESETS["default"], InPlace.refine, 1.0

    def slowly(self: InPlace, hypotheses: Hypotheses) -> Refined:
        time.sleep(1.1 * limit)
        return refine(self, hypotheses)

    monkeypatch.setattr(InPlace, "refine", slowly)
    short = replace(default, search=replace(default.search, time_limit_s=limit))
    found = scanfind.find(stations, placed(BRACKET, at(-2, 0), at(2, 0)), at_design=True, parameters=short)
    assert len(found) == 2
    assert found.timings_s["place"] > limit
    elsewhere = at(1.0, 1.5, 0.0, 0.7)
    assert min(one.scene_from_model.difference(elsewhere)[0] for one in found) < 0.005


def test_what_each_station_says_adds_up_to_what_all_say(inspected: scanfind.Findings) -> None:
    for element in inspected.elements:
        assert {each.station for each in element.stations} <= {1, 2}
        said = np.sum([each[1:] for each in element.stations], axis=0)
        # A station that speaks of less than a hundredth is left out.
        shares = (element.on, element.beside, element.through, element.hidden)
        np.testing.assert_allclose(said, np.array(shares, np.float64), atol=0.01)
    for found in inspected:
        assert sum(sum(each[1:]) for each in found.stations) == pytest.approx(1.0, abs=0.01)


def test_displacements_are_measured(inspected: scanfind.Findings) -> None:
    here, off = inspected.elements[:2]
    assert here.off_m is not None
    assert here.off_m < 0.002
    assert off.shift_m is not None
    np.testing.assert_allclose(off.shift_m, (0.02, 0.02, 0.01), atol=0.003)
    assert off.off_m == pytest.approx(0.03, abs=0.004)


def test_elements_survive_the_result_folder(inspected: scanfind.Findings) -> None:
    from scanfind.results.document import document, findings_of
    from scanfind.results.schema import Results

    with ModelLibrary.in_memory() as models:
        models.add(DESIGN)
        judge_findings(inspected, allowed_off(0.005), models)
    told = document(inspected, models=[], parameters=scanfind.PRESETS["default"], seed=0)
    assert [each.verdict for each in told.elements] == [IN_TOLERANCE, OUT_OF_TOLERANCE, None, None]
    again = findings_of(Results.model_validate_json(told.to_json()))
    assert profile_in(told) == allowed_off(0.005)
    for one, other in zip(again.elements, inspected.elements, strict=True):
        poses = {"placement": None, "built_from_design": None}  # those are not equal even to themselves
        assert replace(one, **poses) == replace(other, **poses)  # type: ignore[arg-type]
        assert (one.built_from_design is None) == (other.built_from_design is None) == (one.status != INSTALLED)
        if one.built_from_design is not None and other.built_from_design is not None:
            np.testing.assert_array_equal(one.built_from_design.matrix(), other.built_from_design.matrix())


def test_a_large_and_a_small_model_are_found_in_one_search() -> None:
    arms = [((0, 0, 0), (3.0, 0.4, 0.2)), ((0, 0, 0), (0.2, 0.4, 2.0)), ((2.0, 0, 0), (2.2, 1.4, 0.2))]
    large, small = blocks("large", arms), blocks("small", [np.array(arm) / 6.0 for arm in arms])
    built = (
        SceneObject("floor", FLOOR, Pose.identity()),
        SceneObject("large", large, at(-1.5, 0.5), target=True),
        SceneObject("small", small, at(0.3, -1.0, 0.0, 0.5), target=True),
    )
    stations = np.array([[0.3, -3.0, 1.5], [-1.0, 3.0, 1.5]])
    scanned = scan(Scene(built, stations), scanner=Scanner(step=0.002), seed=5).stations
    found = scanfind.find(scanned, [large, small], isolate=False)
    assert sorted(one.model for one in found) == ["large", "small"]
    assert [one.id for one in found] == [1, 2]
    for one in found:
        truth = at(-1.5, 0.5) if one.model == "large" else at(0.3, -1.0, 0.0, 0.5)
        assert one.scene_from_model.difference(truth)[0] < 0.005


def test_points_are_cut_again_without_losing_the_elements(tmp_path: Path) -> None:
    folder = folder_by_hand(tmp_path / "inspected", points=500)
    before = read_results(folder)
    scans = [folder / str(found.isolated) for found in before.detections]
    after = isolate_again(folder, scans, tolerance=0.003)
    assert after.elements == before.elements
    assert after.profile == before.profile is not None
    assert all(found.points < 500 for found in after.detections)
    with ModelLibrary.open(folder / MODELS) as kept:
        assert kept.names() == ["beam"]
