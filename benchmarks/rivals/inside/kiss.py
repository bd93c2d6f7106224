"""KISS-Matcher (Lim et al. 2025): its own pipeline, and its solver alone on Open3D's FPFH matches."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.rivals.inside.fpfh import feature_matches, features
from benchmarks.rivals.inside.matcher import Matcher, Model
from benchmarks.rivals.inside.windows import windows
from scanfind.cloud import OrientedCloud
from scanfind.errors import InvalidGeometryError
from scanfind.pose import Pose

# Its robust defaults cut at 0.75 voxels; features of a thinned frame are that far off themselves.
NOISE_GAIN = 1.0


def train_solver(model: Model) -> Matcher:
    """Its graph pruning and its solver on Open3D's FPFH matches, window by window."""
    import kiss_matcher

    source = model.cloud.points.astype(np.float32)
    described = features(model.cloud, model.voxel)[1].data.T
    config = kiss_matcher.KISSMatcherConfig(
        voxel_size=model.voxel, robin_noise_bound_gain=NOISE_GAIN, solver_noise_bound_gain=NOISE_GAIN,
        enable_noise_bound_clamping=False,  # its clamp is at a metre's scale, of vehicles
    )  # fmt: skip

    def match(scene: OrientedCloud, seed: int) -> list[Pose]:
        target = features(scene, model.voxel)[1].data.T
        poses = []
        for rows in windows(scene.points, model.diameter):
            mine, theirs = feature_matches(described, target[rows])
            theirs_there = scene.points[rows[theirs]].astype(np.float32)
            found = kiss_matcher.KISSMatcher(config).prune_and_solve(list(source[mine]), list(theirs_there))
            poses.extend(_pose(found))
        return poses

    return match


def train_pipeline(model: Model) -> Matcher:
    """All of it: its own voxels, features, matches and solver, window by window."""
    import kiss_matcher

    source = list(model.cloud.points.astype(np.float32))
    config = kiss_matcher.KISSMatcherConfig(voxel_size=model.voxel)

    def match(scene: OrientedCloud, seed: int) -> list[Pose]:
        points = scene.points.astype(np.float32)
        found = [
            kiss_matcher.KISSMatcher(config).estimate(source, list(points[rows]))
            for rows in windows(scene.points, model.diameter)
        ]
        return [pose for one in found for pose in _pose(one)]

    return match


def _pose(found: Any) -> list[Pose]:
    """A solution as scene_from_model; none where it is no rigid motion. Its own `valid` is not asked: the check is."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = found.rotation, np.ravel(found.translation)
    try:
        return [Pose.from_matrix(matrix)]
    except InvalidGeometryError:
        return []
