"""Open3D: FPFH features, matched by RANSAC or by fast global registration."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.rivals.inside.matcher import Matcher, Model
from scanfind.cloud import OrientedCloud
from scanfind.pose import Pose

Floats = NDArray[np.float64]

# Open3D's tutorial "Global registration": radius of the features 5 voxels of 100 neighbours, distance 1.5 voxels.
RADIUS_VOXELS, NEIGHBOURS = 5.0, 100
DISTANCE_VOXELS, EDGE_SIMILARITY = 1.5, 0.9
ITERATIONS, CONFIDENCE = 1_000_000, 0.999
DRAWN = 3
FGR_VOXELS = 1.5


def train_ransac(model: Model) -> Matcher:
    """FPFH + RANSAC."""
    import open3d as o3d

    registration = o3d.pipelines.registration
    source, distance = features(model.cloud, model.voxel), DISTANCE_VOXELS * model.voxel

    def match(scene: OrientedCloud, seed: int) -> list[Pose]:
        o3d.utility.random.seed(seed)
        target = features(scene, model.voxel)
        found = registration.registration_ransac_based_on_feature_matching(
            source[0], target[0], source[1], target[1], False, distance,
            registration.TransformationEstimationPointToPoint(False), DRAWN,
            [
                registration.CorrespondenceCheckerBasedOnEdgeLength(EDGE_SIMILARITY),
                registration.CorrespondenceCheckerBasedOnDistance(distance),
            ],
            registration.RANSACConvergenceCriteria(ITERATIONS, CONFIDENCE),
        )  # fmt: skip
        return [Pose.from_matrix(found.transformation)]

    return match


def train_fgr(model: Model) -> Matcher:
    """FPFH + fast global registration (Zhou, Park & Koltun 2016)."""
    import open3d as o3d

    registration = o3d.pipelines.registration
    source = features(model.cloud, model.voxel)
    option = registration.FastGlobalRegistrationOption(maximum_correspondence_distance=FGR_VOXELS * model.voxel)

    def match(scene: OrientedCloud, seed: int) -> list[Pose]:
        o3d.utility.random.seed(seed)
        target = features(scene, model.voxel)
        found = registration.registration_fgr_based_on_feature_matching(
            source[0], target[0], source[1], target[1], option
        )
        return [Pose.from_matrix(found.transformation)]

    return match


def features(cloud: OrientedCloud, voxel: float) -> tuple[Any, Any]:
    """A cloud of Open3D's and its FPFH features."""
    import open3d as o3d

    points = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points))
    points.normals = o3d.utility.Vector3dVector(cloud.normals)
    around = o3d.geometry.KDTreeSearchParamHybrid(radius=RADIUS_VOXELS * voxel, max_nn=NEIGHBOURS)
    return points, o3d.pipelines.registration.compute_fpfh_feature(points, around)


def feature_matches(model: Floats, scene: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of the model's and the scene's features (N, 33), each with its nearest of the other, both ways.

    Mutual ones alone leave a handful of a thousand right.
    """
    from scipy.spatial import cKDTree

    to_scene = cKDTree(scene).query(model, workers=-1)[1]
    to_model = cKDTree(model).query(scene, workers=-1)[1]
    mine = np.concatenate([np.arange(len(model)), to_model])
    return mine, np.concatenate([to_scene, np.arange(len(scene))])
