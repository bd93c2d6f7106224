"""A row of the results: one system's answer to one scene, judged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.common import PoseError, pose_error, symmetry_of
from benchmarks.paper.definitions import (
    FARTHEST_M,
    is_right,
    model_points,
    precision,
    recognition_rate,
    rms_paper,
    rms_surface,
)
from benchmarks.paper.experiments import Case, Key
from benchmarks.paper.systems import Answer, surface_of
from scanfind.pose import Pose

NAN = float("nan")


@dataclass(frozen=True)
class Row:
    """One answer; see benchmarks/README.md for the columns."""

    experiment: str
    target: str
    system: str
    row: str
    asked: float
    had: float
    scene_points: int
    object_points: int
    seed: int
    run: int
    success: int
    at_all: int
    false: int
    rr: float
    precision: float
    rms_cm: float
    rms_floor_cm: float
    rms_surface_mm: float
    error_mm: float
    error_deg: float
    grid_s: float
    search_s: float
    refine_s: float
    verify_s: float
    isolate_s: float
    total_s: float
    note: str

    def key(self) -> Key:
        """What it is about, within one system's file."""
        return (self.experiment, self.target, self.row, self.seed, self.run)


def judged(case: Case, system: str, answer: Answer) -> Row:
    """An answer against the truth.

    Its first pose is the answer; the nearest of its first K where the scene holds K instances. All points of all its
    poses count as isolated: what it found besides is not hidden.
    """
    cloud = case.cloud
    instances = 1 + len(case.others)
    poses = answer.poses[: instances if answer.ranked else None]
    cuts = answer.isolated[: len(poses)]
    errors = [error_of(pose, case) for pose in poses[:instances]]
    best = min(range(len(errors)), key=lambda k: errors[k].mm, default=-1)
    error = errors[best] if best >= 0 else PoseError(NAN, NAN)
    right = is_right(error, case.right_mm)
    isolated = cuts[best] if best >= 0 else np.zeros(0, np.int64)
    every = np.unique(np.concatenate(cuts)) if cuts and instances == 1 else isolated
    rms = floor = surface = NAN
    if right:
        pose, model, own = poses[best], model_points(case.model), cloud.xyz[cloud.on_object]
        rms = rms_paper(cloud.xyz[isolated], pose, model)
        floor = rms_paper(own, cloud.truth, model)
        surface = rms_surface(own, pose, surface_of(case.model, FARTHEST_M))
    return Row(
        experiment=case.experiment,
        target=case.target,
        system=system,
        row=case.row,
        asked=case.asked,
        had=case.had,
        scene_points=len(cloud),
        object_points=cloud.object_points(),
        seed=case.seed,
        run=case.run,
        success=int(right),
        at_all=int(right),
        false=max(0, len(poses) - instances) + int(best >= 0 and not right),
        rr=recognition_rate(isolated, cloud.on_object),
        precision=precision(every, cloud.on_object),
        rms_cm=1e2 * rms,
        rms_floor_cm=1e2 * floor,
        rms_surface_mm=1e3 * surface,
        error_mm=error.mm,
        error_deg=error.deg,
        grid_s=answer.seconds.get("grid", NAN),
        search_s=answer.seconds.get("search", NAN),
        refine_s=answer.seconds.get("refine", NAN),
        verify_s=answer.seconds.get("verify", NAN),
        isolate_s=answer.seconds.get("isolate", NAN),
        total_s=answer.seconds.get("total", NAN),
        note="" if right else why(case, answer),
    )


def error_of(pose: Pose, case: Case) -> PoseError:
    """How far a pose is from the truth, turning the model onto itself left out."""
    symmetry = symmetry_of(case.model)
    truth = case.cloud.truth
    truths = [truth] if case.turn is None else [truth, truth @ case.turn]
    return min((pose_error(pose, one, symmetry) for one in truths), key=lambda error: (error.deg, error.mm))


def why(case: Case, answer: Answer) -> str:
    """Why nothing right was found."""
    if answer.error:
        return answer.error
    refused = [reason for pose, reason in answer.refused if is_right(error_of(pose, case), case.right_mm)]
    if refused:
        return f"right pose refused: {refused[0]}"
    if any(is_right(error_of(pose, case), case.right_mm) for pose in answer.poses[1:]):
        return "right pose is not the first"
    return "a wrong pose only" if answer.poses else "nothing found"
