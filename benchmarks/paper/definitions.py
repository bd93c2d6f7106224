"""What the paper measures, one function each, with its equation or section number (Sharif et al. 2017)."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from benchmarks.common import Floats, PoseError
from scanfind.cloud import CloudModel
from scanfind.library.cloud_surface import sample_cloud
from scanfind.library.near_surface import near_triangles, signed_distances
from scanfind.library.surface import SurfaceParameters, sample_mesh
from scanfind.mesh import Mesh
from scanfind.pose import Pose

if TYPE_CHECKING:
    from scanfind.kernels.distance import NearSurface

Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

# 4.2.1: "the constant number of points in the Model"; Tables 5 and 6: 20,000 points in the scene are a ratio of 2.
MODEL_POINTS = 10_000
# The paper calls a transformation correct without a number. Ours: the centre within 10 mm, the rotation within 0.5°.
# Neither object has a symmetry: the poses a frame is mistaken for are half a turn off.
RIGHT_MM, RIGHT_DEG = 10.0, 0.5
# Farther from everything than this and a point counts as this far.
FARTHEST_M = 1.0


def density_ratio(scene_points: int) -> float:
    """4.2.1: points in the scene over the constant number of points in the model."""
    return scene_points / MODEL_POINTS


def clutter_ratio(scene_points: int, object_points: int) -> float:
    """Equation 3: |S − (S ∩ s)| / |s|, points elsewhere for each point on the object."""
    return (scene_points - object_points) / object_points


def completeness_ratio(object_points: int, complete_points: int) -> float:
    """4.2.3: the object's points in the scene over those of its complete scan."""
    return object_points / complete_points


def recognition_rate(isolated: Ints, on_object: Mask) -> float:
    """Equation 2: RR = TP / |s|, the share of the object's points that were found.

    isolated : indices of the points given to the object; on_object : (N,) which points of the scene are on it
    NaN where nobody knows the object's points.
    """
    size = int(on_object.sum())
    return int(on_object[isolated].sum()) / size if size else float("nan")


def precision(isolated: Ints, on_object: Mask) -> float:
    """TP / (TP + FP), which the paper leaves out: of all points isolated, the share on the object; NaN as above."""
    return float(on_object[isolated].mean()) if len(isolated) and on_object.any() else float("nan")


def is_right(error: PoseError, right_mm: float = RIGHT_MM) -> bool:
    """4.2.1: an object is isolated where "the final transformation found" is correct; turned over, it is not."""
    return error.within(right_mm, RIGHT_DEG)


def effectiveness_ratio(isolated: int, isolated_at_all: int) -> float:
    """4.3: runs isolated with the proposed parameters over runs isolated at all, with others after a failure."""
    return isolated / isolated_at_all if isolated_at_all else float("nan")


def rms_paper(isolated: Floats, scene_from_model: Pose, model: Floats) -> float:
    """4.1 (2): RMS Euclidean distance between corresponding points of the transformed model and the scene, metres.

    isolated : (N, 3) the scene's points given to the object; model : (M, 3) the model's points, model frame

    A point of the scene corresponds to the nearest point of the model. Not the other way round, for a model point that
    no scanner saw corresponds to nothing; and only so does the figure stay as it is while the scene is thinned, as
    Tables 5 and 6 have it. So it measures mostly how far apart the model's points are: see `rms_floor` in README.md.
    """
    points = near_triangles(np.repeat(model[:, None, :], 3, axis=1), FARTHEST_M, signed=False)
    return _rms(signed_distances(points, scene_from_model.inverse().move(isolated))[0])


def rms_surface(on_object: Floats, scene_from_model: Pose, surface: NearSurface) -> float:
    """RMS distance of all of the object's own points (N, 3) to the surface of the placed model, metres.

    surface : of the model, with a reach of FARTHEST_M
    All of them, not those within the tolerance of isolation: what a wrong pose loses must count.
    """
    return _rms(signed_distances(surface, scene_from_model.inverse().move(on_object))[0])


@lru_cache(maxsize=4)
def model_points(model: Mesh | CloudModel) -> Floats:
    """3.1 (1): the model as MODEL_POINTS Poisson-disk samples of its surface, (MODEL_POINTS, 3), model frame."""
    wanted = SurfaceParameters(samples=MODEL_POINTS)
    surface = sample_mesh(model, wanted) if isinstance(model, Mesh) else sample_cloud(model, wanted)
    return surface.samples.points


def _rms(distances: NDArray[np.float32]) -> float:
    if not len(distances):
        return float("nan")
    far = np.where(np.isnan(distances), FARTHEST_M, distances).astype(np.float64)
    return float(np.sqrt(np.mean(far**2)))
