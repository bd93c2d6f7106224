"""KISS-Matcher (Lim et al. 2025): its own pipeline, and its solver alone on Open3D's FPFH matches."""

from __future__ import annotations

import numpy as np

from benchmarks.rivals.inside.fpfh import feature_matches, features
from benchmarks.rivals.inside.matcher import Matcher, Model
from scanfind.cloud import OrientedCloud
from scanfind.errors import InvalidGeometryError
from scanfind.pose import Pose


def train_solver(model: Model) -> Matcher:
    """Mutual nearest FPFH features, pruned by its graph and solved by its graduated non-convexity."""
    import kiss_matcher

    _, source = features(model.cloud, model.voxel)

    def match(scene: OrientedCloud, seed: int) -> list[Pose]:
        _, target = features(scene, model.voxel)
        mine, theirs = feature_matches(source.data.T, target.data.T)
        solver = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(voxel_size=model.voxel))
        found = solver.solve(np.float64(model.cloud.points[mine].T), np.float64(scene.points[theirs].T))
        return _pose(found)

    return match


def train_pipeline(model: Model) -> Matcher:
    """All of it: its own voxels, features, matches and solver."""
    import kiss_matcher

    source = model.cloud.points.astype(np.float32)

    def match(scene: OrientedCloud, seed: int) -> list[Pose]:
        matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(voxel_size=model.voxel))
        return _pose(matcher.estimate(list(source), list(scene.points.astype(np.float32))))

    return match


def _pose(found: kiss_matcher.RegistrationSolution) -> list[Pose]:
    """A solution as scene_from_model; none where it says itself that it is none."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = found.rotation, np.ravel(found.translation)
    try:
        return [Pose.from_matrix(matrix)] if found.valid else []
    except InvalidGeometryError:
        return []
