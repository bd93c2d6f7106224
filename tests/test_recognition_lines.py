"""The lines of recognition: parts as symmetric as they say, twins that differ, answers judged, rows made a page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from benchmarks.page import recognition as page
from benchmarks.recognition import __main__ as command
from benchmarks.recognition import lines, scenes
from benchmarks.recognition.judge import OFF_M, matched, telling, turns_of
from benchmarks.recognition.parts import (
    TWINS,
    Part,
    box_frame_part,
    gate_valve,
    hundred,
    likenesses,
    mirrored,
    pipe_spool_part,
    ten,
    twins,
    weld_neck,
)
from benchmarks.recognition.trial import Instance, Row, Trial, right_deg
from benchmarks.recognition.why import ideal
from numpy.typing import NDArray

from scanfind.detection import Detection
from scanfind.errors import UsageError
from scanfind.library.model import build_model
from scanfind.library.near_surface import near_triangles, signed_distances
from scanfind.pose import Pose, rotation_from_vector
from scanfind.simulate.parts import SIDES, blocks, box
from scanfind.simulate.placement import surface_points
from scanfind.simulate.scene import Scene, SceneObject
from scanfind.symmetry import Axis

if TYPE_CHECKING:
    from scanfind.kernels.distance import NearSurface

Floats = NDArray[np.float64]

REACH_M = 0.05
SOMEWHERE = Pose.from_rotation_vector([0.3, -0.2, 0.9], [0.0, 0.0, 1.5])


@lru_cache(maxsize=1)
def surface(part: Part) -> NearSurface:
    return near_triangles(part.mesh.triangles(), REACH_M, signed=False)


def off(points: Floats, part: Part) -> Floats:
    """How far points (N, 3) are from a part's surface, in its frame, (N,); inf beyond REACH_M."""
    distance = signed_distances(surface(part), points)[0]
    return np.where(np.isnan(distance), np.inf, np.abs(distance).astype(np.float64))


def on_surface(part: Part, per_m2: float = 400.0) -> Floats:
    return surface_points(part.mesh, np.random.default_rng(0), per_m2)


def least_off(part: Part, other: Part, turns: Sequence[Pose]) -> float:
    """The share of a part's surface that lies off another part, in that of the other's turns where it is least."""
    points = on_surface(part, per_m2=100.0)
    return min(float(np.mean(off(turn.inverse().move(points), other) > OFF_M)) for turn in turns)


def in_the_open(part: Part) -> Scene:
    """A part above a plate, seen from two places."""
    ground = SceneObject("ground", blocks("ground", [((-6.0, -6.0, -1.1), (6.0, 6.0, -1.0))]), Pose.identity())
    thing = SceneObject(part.name, part.mesh, SOMEWHERE, 0.5, target=True)
    return Scene((ground, thing), np.array([[4.0, -3.0, 1.5], [-4.0, 2.0, 2.0]]))


# --- parts


@pytest.mark.parametrize("part", [gate_valve("valve", 0.1), weld_neck("flange", 0.1, 0.17, 0.03)], ids=lambda p: p.name)
def test_a_symmetric_part_looks_the_same_turned(part: Part) -> None:
    # As round as its facets: whole ones.
    facets = [rotation_from_vector(2 * np.pi / SIDES * 7 * axis) for axis in part.symmetry.free]
    centre = part.symmetry.centre
    for rotation in [*part.symmetry.turns, *facets]:
        turn = Pose(rotation, centre - rotation @ centre)
        assert off(turn.move(on_surface(part)), part).max() < 1e-5
        assert part.error(SOMEWHERE @ turn, SOMEWHERE).within(1e-3, 1e-3)
    slid = Pose(np.eye(3), np.array([0.0, 0.0, 0.02]))
    assert part.error(SOMEWHERE @ slid, SOMEWHERE).mm == pytest.approx(20.0)


def test_a_flange_turned_over_is_wrong() -> None:
    part = weld_neck("flange", 0.1, 0.17, 0.03)
    centre = 0.5 * np.array([0.0, 0.0, part.mesh.vertices[:, 2].max()])
    over = Pose.from_rotation_vector([np.pi, 0.0, 0.0], 2 * centre)
    assert part.error(SOMEWHERE @ over, SOMEWHERE).deg == pytest.approx(180.0)


@pytest.mark.parametrize("kind", TWINS)
def test_twins_differ_somewhere_and_only_there(kind: str) -> None:
    one, other = twins(kind)
    either = np.concatenate([off(on_surface(one), other), off(on_surface(other), one)])
    if kind != "mirrored":
        assert 0.002 < np.mean(either > OFF_M) < 0.2


def test_no_turn_brings_a_part_onto_its_mirror_image() -> None:
    for part in (pipe_spool_part(), box_frame_part()):
        image = Part.of(mirrored(part.mesh))
        assert (
            min(np.mean(off(turn.inverse().move(on_surface(part)), image) > 0.015) for turn in turns_of(image)) > 0.02
        )


def test_likenesses_are_alike_turned_but_not_the_same() -> None:
    for part in likenesses():
        others = [t for t in turns_of(part) if not part.error(t, Pose.identity()).within(10.0, right_deg(part))]
        assert 0.01 < least_off(part, part, others) < 0.3


def test_a_hundred_and_ten_have_their_own_names_and_shapes() -> None:
    for parts in (hundred(), ten()):
        assert len({part.name for part in parts}) == len(parts)
    assert len(hundred()) == 100
    assert len(ten()) == 10
    assert len({part.mesh.vertices.tobytes() for part in hundred()}) == 100


# --- scenes


@pytest.mark.parametrize("asked", [0.7, 0.9, 0.98])
def test_boards_hide_what_they_are_to_hide(asked: float) -> None:
    hidden = scenes.behind_boards(in_the_open(pipe_spool_part()), asked, seed=5)
    assert hidden is not None
    assert 1.0 - hidden.visible_share(1) == pytest.approx(asked, abs=0.01)


def test_what_is_hidden_more_already_is_left_out() -> None:
    assert scenes.behind_boards(in_the_open(pipe_spool_part()), 0.1, seed=5) is None


def test_who_is_meant_and_who_is_left_out() -> None:
    scene = in_the_open(pipe_spool_part())
    assert scenes.meant(scene, []).target_ids() == []
    assert len(scenes.meant(scene, [], ["pipe_spool"]).objects) == 1
    assert scenes.meant(scene, ["pipe_spool"]).target_ids() == [1]


@pytest.mark.parametrize("name", ["pose", "likeness"])
def test_a_line_asks_only_what_is_wanted(name: str) -> None:
    assert not list(lines.LINES[name](0, lambda key: False))


# --- judging


def detection(number: int, model: str, pose: Pose) -> Detection:
    return Detection(number, model, pose, 0.95, 0.5, 0.99, 0.0, 0.5, 0.001)


def test_each_instance_is_found_once_and_by_its_name() -> None:
    part = Part.of(box(1.0, 0.6, 0.4))
    there = [Instance(part, k, Pose(np.eye(3), np.array([3.0 * k, 0.0, 0.0])), 0.5) for k in range(3)]
    aside = Pose(np.eye(3), np.array([0.0, 0.011, 0.0]))
    said = [
        detection(1, "box", there[1].pose),
        detection(2, "box", there[1].pose),
        detection(3, "other", there[2].pose),
        detection(4, "box", there[2].pose @ aside),
        detection(5, "box", there[0].pose),
    ]
    judged = matched(said, there)
    assert judged.pairs == [(0, 1), (4, 0)]
    assert (judged.false, judged.missed) == ([1, 2, 3], [2])


def test_a_perfect_scan_speaks_for_the_true_pose_and_against_another() -> None:
    part = pipe_spool_part()
    trial = Trial("x", "x", 0, in_the_open(part), (part,), 50_000)
    model = build_model(part.mesh)
    right = ideal(trial, model, SOMEWHERE)
    assert (right.through, right.object_name) == (0.0, "pipe_spool")
    # Samples are not spread as the surface is: 3,000 of them, only where a scanner can see.
    assert right.on == pytest.approx(trial.instances[0].visible, abs=0.03)
    wrong = ideal(trial, model, SOMEWHERE @ Pose(np.eye(3), np.array([0.0, 0.0, 0.2])))
    assert wrong.through > 0.2


def test_points_tell_a_part_from_its_twin_but_not_from_itself() -> None:
    one, other = twins("branch")
    seen = Trial("x", "x", 0, in_the_open(one), (one, other), 50_000)
    there = seen.instances[0]
    assert telling(replace(seen, rivals=(other,)), there) > 20
    # A turn that leaves the part as it is does not count, though nothing tells it: all others are a quarter turn.
    sides = Axis((1.0, 0.0, 0.0), 2), Axis((0.0, 0.0, 1.0), 2)
    round_box = Part.of(box(1.0, 0.6, 0.4), *sides)
    trial = Trial("x", "x", 0, in_the_open(round_box), (round_box,), 20_000, (round_box,))
    assert telling(trial, trial.instances[0]) > 0.3 * len(trial.points_on(trial.instances[0]))


# --- rows and the page


def row(line: str = "pose", case: str = "part", seed: int = 7400, **changed: object) -> Row:
    usual = Row(
        line, case, seed, 1000, 1, 1, 100, 0.4, math.nan, 1, 0, 0, "", 0.2, 0.005, 0.97, math.nan, 0.1, 0.2, 0.1, 0.1,
        0.5, "",
    )  # fmt: skip
    return replace(usual, **changed)  # type: ignore[arg-type]


def test_a_run_goes_on_where_it_was_interrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, int]] = []

    def answer(trial: Trial) -> Row:
        asked.append((trial.case, trial.seed))
        return row("pose", trial.case, trial.seed)

    monkeypatch.setattr(command, "answer", answer)
    monkeypatch.setattr(command, "warm_up", lambda: None)
    command.main(line="pose", seeds="0-1", out=tmp_path)
    command.main(line="pose", seeds="0-3", out=tmp_path)
    assert [seed for _, seed in asked] == [0, 1, 2, 3]
    with pytest.raises(UsageError, match="no line 'nothing'"):
        command.main(line="nothing", out=tmp_path)


def test_half_found_lies_between_the_cases() -> None:
    cases = [(0.5, 4), (0.8, 3), (0.9, 1), (0.95, 0)]
    rows = [
        row("occlusion", f"part {at}", seed, occlusion=at, right=int(seed - 7400 < found))
        for at, found in cases
        for seed in range(7400, 7404)
    ]
    # From 3 of 4 at 0.8 to 1 of 4 at 0.9.
    assert page.half_found(rows) == pytest.approx(0.85)
    assert math.isnan(page.half_found([replace(one, right=0) for one in rows]))


def test_recall_at_zero_false_alarms_asks_for_more_than_the_loudest() -> None:
    there = [row("alarms", "with", 7400 + k, score=0.91 + 0.02 * k) for k in range(4)]
    without = [row("alarms", "without", 7400, instances=0, right=0, false=1, false_score=0.94, score=math.nan)]
    claim = page.alarms([*there, *without])
    assert claim.measured.startswith("0.50 of 4 at a score above 0.94")
    assert not claim.held
    assert page.alarms(there).held


def test_few_scenes_may_miss_a_target_but_not_hold_it() -> None:
    held = [row("likeness", seed=k, telling=200.0) for k in range(5)]
    assert page.told("likeness", held)[-1] == "–"
    assert page.told("likeness", [replace(held[0], likeness=1)])[-1] == "**NOT held**"
    # Where nothing tells, nothing is asked.
    assert page.told("likeness", [replace(held[0], likeness=1, telling=3.0)])[-1] == "–"
