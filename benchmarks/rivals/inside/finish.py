"""The same end for every rival: ICP with Tukey weights, a check, the best first."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from benchmarks.rivals.inside.prepare import Prepared
from scanfind.cloud import OrientedCloud
from scanfind.pose import Pose

Floats = NDArray[np.float64]

GATES_VOXELS = (2.0, 1.0, 0.5)
ITERATIONS = 15
CONVERGED = 1e-5  # metres and radians
# Pairs whose normals are more than 60° apart are of two surfaces; "like" to the check is within 25°.
PAIR_COSINE, LIKE_COSINE = 0.5, 0.9
LEAST_PAIRS = 10
# Of hundreds of proposals, those that look best already are refined, on few samples, and the best of these on all.
REFINED, ROUGH_SAMPLES, ANSWERED = 40, 750, 5


def finish(proposals: Sequence[Pose], model: OrientedCloud, scene: Prepared, voxel: float) -> list[tuple[float, Pose]]:
    """Refine what a rival proposes: (score, scene_from_model), best first, no pose twice, at most ANSWERED.

    model : samples of the surface, model frame, of which every prefix is evenly spread
    """
    few = OrientedCloud(model.points[:ROUGH_SAMPLES], model.normals[:ROUGH_SAMPLES])
    likely = [pose for _, pose in ranked(proposals, few, scene, voxel)[:REFINED]]
    rough = distinct(ranked([icp(pose, few, scene, voxel) for pose in likely], few, scene, voxel), few, voxel)
    refined = [icp(pose, model, scene, voxel) for _, pose in rough[:ANSWERED]]
    return distinct(ranked(refined, model, scene, voxel), model, voxel)


def ranked(poses: Sequence[Pose], model: OrientedCloud, scene: Prepared, voxel: float) -> list[tuple[float, Pose]]:
    """With what the check says, best first."""
    return sorted(((check(pose, model, scene, voxel), pose) for pose in poses), key=lambda one: -one[0])


def distinct(scored: Sequence[tuple[float, Pose]], model: OrientedCloud, voxel: float) -> list[tuple[float, Pose]]:
    """Without those within a voxel of a better one."""
    kept: list[tuple[float, Pose]] = []
    for score, pose in scored:
        if all(apart(pose, other, model.points) > voxel for _, other in kept):
            kept.append((score, pose))
    return kept


def icp(pose: Pose, model: OrientedCloud, scene: Prepared, voxel: float) -> Pose:
    """Point to plane, the planes those of the model, whose normals are exact; gates 2, 1 and 0.5 voxels."""
    for gate in (voxel * gate for gate in GATES_VOXELS):
        for _ in range(ITERATIONS):
            points, normals = pose.move(model.points), pose.turn(model.normals)
            paired, at = pairs(points, normals, scene, gate, PAIR_COSINE)
            if paired.sum() < LEAST_PAIRS:
                return pose
            step, about = tukey_step(points[paired], normals[paired], scene.fine.points[at[paired]], gate)
            turn = Pose.from_rotation_vector(step[:3])
            pose = Pose(turn.rotation, about + step[3:] - turn.rotation @ about) @ pose
            if np.abs(step).max() < CONVERGED:
                break
    return pose


def tukey_step(points: Floats, normals: Floats, targets: Floats, gate: float) -> tuple[Floats, Floats]:
    """One Gauss-Newton step of points (K, 3) to targets: rotation vector and translation (6,), and what it turns about.

    Weights are Tukey's biweight of the distance along the normal: nothing beyond the gate pulls.
    """
    about = points.mean(axis=0)
    residuals = ((targets - points) * normals).sum(axis=1)
    weights = np.clip(1.0 - (residuals / gate) ** 2, 0.0, None) ** 2
    jacobian = np.hstack([np.cross(points - about, normals), normals])
    weighted = jacobian.T * weights
    # What the pairs do not fix (a straight pipe slides) does not move.
    step: Floats = np.linalg.lstsq(weighted @ jacobian, weighted @ residuals, rcond=1e-9)[0]
    return step, about


def check(pose: Pose, model: OrientedCloud, scene: Prepared, voxel: float) -> float:
    """Share of the model's samples with a scene point of like normal within one voxel."""
    return float(pairs(pose.move(model.points), pose.turn(model.normals), scene, voxel, LIKE_COSINE)[0].mean())


def pairs(
    points: Floats, normals: Floats, scene: Prepared, gate: float, least_cosine: float
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Which of K points have their nearest scene point within the gate and of like normal, and that point's row."""
    far, at = scene.tree.query(points, distance_upper_bound=gate)
    there = np.isfinite(far)
    at = np.where(there, at, 0)
    cosines = (normals * scene.fine.normals[at]).sum(axis=1)
    return there & ((cosines if scene.fine.signed else np.abs(cosines)) > least_cosine), at


def apart(one: Pose, other: Pose, points: Floats) -> float:
    """Mean distance between points (N, 3) placed by two poses, metres."""
    return float(np.linalg.norm(one.move(points) - other.move(points), axis=1).mean())
