"""python -m benchmarks.rivals.trial [NAME...]: rivals on eight trial scenes, to see that they are set up well.

Two spools and two frames, seeds 1 and 2, 322,191 points: the whole shop, and the target with what is near it
(a margin that leaves a clutter ratio of at least 11). A row each; found: mean point error below 20 mm.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.rivals.runner import run
from benchmarks.rivals.table import RIVALS, available
from scanfind.mesh import Mesh
from scanfind.pose import Pose
from scanfind.simulate.objects import box_frame, pipe_spool
from scanfind.simulate.scanner import scan
from scanfind.simulate.scenes import shop

Floats = NDArray[np.float64]

POINTS, SEEDS, FOUND_M = 322_191, (1, 2), 0.02
NEAR_CLUTTER, MARGINS_M = 11.0, np.arange(0.1, 3.0, 0.1)


@dataclass(frozen=True)
class Trial:
    """A scene with one target: points (N, 3), who saw each (N,), scanners (S, 3), and the truth."""

    target: str
    seed: int
    kind: str
    mesh: Mesh
    points: Floats
    station: NDArray[np.int64]
    origins: Floats
    clutter: float
    truth: Pose


def trials() -> Iterator[Trial]:
    """The near scene and the whole shop of every target and seed."""
    for name, mesh in (("ps", pipe_spool()), ("bf", box_frame())):
        for seed in SEEDS:
            scene = shop(seed, mesh)
            scanned = scan(scene, seed=seed, points=POINTS)
            points = np.concatenate([cloud.xyz for cloud in scanned.stations])
            ids = np.concatenate([cloud.attributes["object_id"] for cloud in scanned.stations])
            station = np.repeat(np.arange(len(scanned.stations)), [len(cloud) for cloud in scanned.stations])
            on = ids == scene.target_ids()[0]
            truth = scanned.truth[mesh.name][0]
            for kind, rows in (("near", near(points, on)), ("shop", np.ones(len(points), dtype=bool))):
                clutter = float((rows.sum() - on.sum()) / on.sum())
                yield Trial(name, seed, kind, mesh, points[rows], station[rows], scene.stations, clutter, truth)


def near(points: Floats, on: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Rows in the smallest box around the target's points that has NEAR_CLUTTER others for each of them."""
    low, high = points[on].min(axis=0), points[on].max(axis=0)
    for margin in MARGINS_M:
        rows: NDArray[np.bool_] = ((points > low - margin) & (points < high + margin)).all(axis=1)
        if rows.sum() > (1.0 + NEAR_CLUTTER) * on.sum():
            break
    return rows


def error_of(pose: Pose, truth: Pose, mesh: Mesh) -> float:
    """Mean distance of the mesh's corners between two poses, metres."""
    return float(np.linalg.norm(pose.move(mesh.vertices) - truth.move(mesh.vertices), axis=1).mean())


def main(names: Sequence[str]) -> None:
    """Print a row for each scene and rival."""
    for trial in sorted(trials(), key=lambda trial: trial.kind):
        for name in names or available():
            answer = run(name, trial.points, trial.origins, trial.station, trial.mesh)
            errors = [1e3 * error_of(pose, trial.truth, trial.mesh) for pose in answer.poses]
            found = bool(errors) and errors[0] < 1e3 * FOUND_M
            spent = " ".join(f"{stage} {seconds:.1f}" for stage, seconds in answer.seconds.items())
            told = " ".join(f"{error:.1f}/{score:.3f}" for error, score in zip(errors, answer.scores, strict=True))
            scene = f"{trial.kind} {trial.target}{trial.seed} clutter {trial.clutter:4.0f}"
            verdict = "found" if found else "-"
            print(
                f"{scene} {RIVALS[name].title:24} {verdict:6} {spent} | mm/score {told} {answer.error}",
                flush=True,
            )


if __name__ == "__main__":
    main(sys.argv[1:])
