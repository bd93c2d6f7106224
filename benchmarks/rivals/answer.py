"""What a rival answers, and how it comes out of its child process."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

from scanfind.pose import Pose

TIME_LIMIT = "time limit"


@dataclass(frozen=True)
class Answer:
    """Where a rival says the model is.

    poses : scene_from_model, best first, at most a handful, refined and checked as every rival's are
    scores : share of the model with a scene point of like normal within a voxel, of each pose
    seconds : planes, match, refine and total of these, of the search alone; train, what was done before the scene was
        seen, is not in the total. Empty where the rival failed
    error : "" | "time limit" | what failed
    """

    poses: list[Pose] = field(default_factory=list)
    scores: list[float] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    error: str = ""


def write_answer(answer: Answer, path: Path) -> None:
    """As JSON; poses as 4×4 row-major."""
    poses = [pose.matrix().tolist() for pose in answer.poses]
    told = {"poses": poses, "scores": answer.scores, "seconds": answer.seconds, "error": answer.error}
    path.write_text(json.dumps(told), encoding="utf-8")


def read_answer(path: Path) -> Answer:
    """What write_answer wrote."""
    told = json.loads(path.read_text(encoding="utf-8"))
    poses = [Pose.from_matrix(matrix) for matrix in told["poses"]]
    return Answer(poses, told["scores"], told["seconds"], told["error"])
