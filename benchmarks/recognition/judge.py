"""An answer against the truth: what is right, what is false, and of what is wrong why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from benchmarks.common import STAGES, Floats, median
from benchmarks.recognition.parts import Part, library_of
from benchmarks.recognition.trial import Instance, Row, Trial, right_deg
from benchmarks.recognition.why import Ideal, ideal, weighed
from scanfind.detection import Detection, Findings
from scanfind.find import find
from scanfind.library.near_surface import near_triangles, signed_distances
from scanfind.library.self_similar import cube_turns
from scanfind.parameters import PRESETS
from scanfind.pose import Pose

NAN = float("nan")
# The default but for its time limit of 60 s: what is found should not hang on how busy the machine is.
TIME_LIMIT_S = 300.0
PATIENT = replace(PRESETS["default"], search=replace(PRESETS["default"].search, time_limit_s=TIME_LIMIT_S))
# A point this far from a rival's surface is not on it: seven times the noise.
OFF_M = 0.015
# A false detection with so much of its surface on an instance is that instance in a wrong pose, or by a wrong name.
LIKENESS = 0.35


class Judged(NamedTuple):
    """Detections and instances that belong together (by index), and what is left of each."""

    pairs: list[tuple[int, int]]
    false: list[int]
    missed: list[int]


def answer(trial: Trial) -> Row:
    """Search a trial's scene, once, and judge what is said."""
    library = library_of(trial.sought)
    found = find(trial.scanned.stations, library, parameters=PATIENT, seed=trial.seed)
    return row_of(trial, found)


def row_of(trial: Trial, found: Findings) -> Row:
    """What an answer is worth."""
    instances, judged = trial.instances, matched(found, trial.instances)
    errors = [instances[i].error(found[d].scene_from_model) for d, i in judged.pairs]
    likenesses = [d for d in judged.false if likeness_of(trial, found[d]) is not None]
    timings = {stage: found.timings_s.get(stage, 0.0) for stage in (*STAGES, "library", "total")}
    return Row(
        line=trial.line,
        case=trial.case,
        seed=trial.seed,
        points=len(trial.scanned),
        models=len(trial.sought),
        instances=len(instances),
        object_points=min((len(trial.points_on(one)) for one in instances), default=0),
        occlusion=max((1.0 - one.visible for one in instances), default=NAN),
        telling=float(min((telling(trial, one) for one in instances), default=NAN)) if trial.rivals else NAN,
        right=len(judged.pairs),
        false=len(judged.false),
        likeness=len(likenesses),
        false_on="+".join(lies_on(trial, found[d]).object_name for d in judged.false),
        error_mm=median([error.mm for error in errors]),
        error_deg=median([error.deg for error in errors]),
        score=min((found[d].score for d, _ in judged.pairs), default=NAN),
        false_score=max((found[d].score for d in judged.false), default=NAN),
        grid_s=timings["grid"],
        search_s=timings["search"],
        refine_s=timings["refine"],
        verify_s=timings["verify"],
        total_s=timings["total"] - timings["library"],
        note="; ".join([*missed_why(trial, found, judged), *false_why(trial, found, judged), *found.notes]),
    )


def matched(found: Sequence[Detection], instances: Sequence[Instance]) -> Judged:
    """Each detection is right of at most one instance, each instance found at most once: a second time is false."""
    pairs: list[tuple[int, int]] = []
    false, free = [], set(range(len(instances)))
    for d, one in enumerate(found):
        own = [i for i in free if instances[i].part.name == one.model and instances[i].is_right(one.scene_from_model)]
        if own:
            pairs.append((d, own[0]))
            free.remove(own[0])
        else:
            false.append(d)
    return Judged(pairs, false, sorted(free))


def telling(trial: Trial, instance: Instance) -> int:
    """How many scanned points of an instance lie off the rival that fits them best, in its best turn.

    Tried are the 24 turns of a cube about the rival's box and about its origin; where the rival is the part itself,
    those that leave the part as it is do not count.
    """
    points = instance.pose.inverse().move(trial.points_on(instance))
    least = len(points)
    for rival in trial.rivals:
        surface = near_triangles(rival.mesh.triangles(), 2 * OFF_M, signed=False)
        for turn in turns_of(rival):
            if rival is instance.part and instance.part.error(turn, Pose.identity()).within(10.0, right_deg(rival)):
                continue
            distance = signed_distances(surface, turn.inverse().move(points))[0]
            least = min(least, int(np.count_nonzero(~(np.abs(distance) <= OFF_M))))
    return least


def turns_of(part: Part) -> list[Pose]:
    """The turns of a cube about the middle of a part's box and about its origin."""
    low, high = part.mesh.vertices.min(axis=0), part.mesh.vertices.max(axis=0)
    centres: list[Floats] = [0.5 * (low + high), np.zeros(3)]
    return [Pose(turn, centre - turn @ centre) for centre in centres for turn in cube_turns()]


def likeness_of(trial: Trial, one: Detection) -> Instance | None:
    """The instance a detection mostly lies on."""
    samples = library_of(trial.sought).get(one.model).samples.points
    placed = one.scene_from_model.move(samples)
    for instance in trial.instances:
        surface = near_triangles(instance.part.mesh.triangles(), 2 * OFF_M, signed=False)
        distance = signed_distances(surface, instance.pose.inverse().move(placed))[0]
        if np.mean(np.abs(distance) <= OFF_M) >= LIKENESS:
            return instance
    return None


def lies_on(trial: Trial, one: Detection) -> Ideal:
    """What a detection lies on, and what a perfect scan would say of it."""
    return ideal(trial, library_of(trial.sought).get(one.model), one.scene_from_model)


def missed_why(trial: Trial, found: Findings, judged: Judged) -> list[str]:
    """Of each instance missed: was its pose refused, or never met, and what would it have scored?"""
    told = []
    for i in judged.missed:
        one = trial.instances[i]
        own = [r for r in found.refused if r.model == one.part.name and one.is_right(r.scene_from_model)]
        if own:
            why = f"refused at {own[0].score:.2f}, {own[0].reason}"
        else:
            why = f"not among the refused: {weighed(trial, one.part, one.pose).told()}"
        points = len(trial.points_on(one))
        told.append(f"missed {one.part.name} ({one.visible:.0%} in sight, {points} points): {why}")
    return told


def false_why(trial: Trial, found: Findings, judged: Judged) -> list[str]:
    """Of each false detection: what it lies on, and what a perfect scan would say of it."""
    told = []
    for d in judged.false:
        one, like = found[d], likeness_of(trial, found[d])
        seen = lies_on(trial, one)
        if like is not None:
            error = like.error(one.scene_from_model)
            where = f"on {like.part.name}, off by {error.mm:.0f} mm {error.deg:.1f} deg"
        else:
            where = f"on {seen.object_name}"
        told.append(
            f"false {one.model} at {one.score:.2f} {where} (support {one.support:.0%}, seen through {one.penalty:.1%}; "
            f"truly {seen.told()})"
        )
    return told
