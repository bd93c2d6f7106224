"""OpenCV's surface matching, ppf_match_3d (Drost et al. 2010)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.rivals.inside.matcher import Matcher, Model
from scanfind.cloud import OrientedCloud
from scanfind.pose import Pose

# Its example has 0.05 of the diameter, `match` by default 0.03. Training grows with the fourth power of its inverse.
SAMPLING_STEP = 0.03
# Every fifth scene point votes: its default, as are angles in 30 bins.
SCENE_SHARE = 1.0 / 5.0
POSES = 300


def train(model: Model) -> Matcher:
    """Train the detector; it samples the model and the scene itself, at its own step."""
    import cv2

    detector = cv2.ppf_match_3d.PPF3DDetector(SAMPLING_STEP, SAMPLING_STEP)
    detector.trainModel(_rows(model.cloud))

    def match(scene: OrientedCloud, seed: int) -> list[Pose]:
        # Its poses come sorted by votes, already clustered.
        found = detector.match(_rows(scene), SCENE_SHARE, SAMPLING_STEP)
        return [Pose.from_matrix(one.pose) for one in found[:POSES]]

    return match


def _rows(cloud: OrientedCloud) -> NDArray[np.float32]:
    """Points and normals, (N, 6)."""
    return np.hstack([cloud.points, cloud.normals]).astype(np.float32)
