"""Where an element is looked for that is not in its place: at what stands about it and is no other element's.

Of a flat bar of 8 mm that stands 60 mm off other surfaces are nearer to its place than its own, and ICP goes to them.
Where beams ended on no element of the design there is little but what was moved: to that alone the element is drawn,
from all about its place. Where nothing of the kind stands, nothing is tried.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.fit.patches import measured
from scanfind.fit.pull import pulled
from scanfind.library.near_surface import signed_distances
from scanfind.pose import Pose

if TYPE_CHECKING:
    from scanfind.kernels.distance import NearSurface
    from scanfind.recognition.candidate import Standing

Floats = NDArray[np.float64]

FARTHEST_M = 0.12  # what was moved farther is looked for as one that stands anywhere
STARTS_M = (0.0, -0.05, 0.05)  # along each axis: from each of these poses it is drawn in …
GATES_M = np.geomspace(0.06, 0.015, 8)  # … to ends so near, step by step
MOST_ENDS = 3000
DISTINCT_M, MOST_TRIED = 0.01, 6  # of the poses that end so far from each other the best are weighed


def long_side(points: Floats) -> Floats:
    """The direction (3,) of the long side of the box about points (N, 3), in their own axes."""
    return np.asarray(np.eye(3)[np.argmax(np.ptp(points, axis=0))])


def across(pose: Pose, points: Floats) -> Floats:
    """Both ways across the long side of a placed model with points (N, 3): (4, 3) directions, scene axes."""
    two = pose.turn(np.eye(3)[np.argsort(np.ptp(points, axis=0), kind="stable")[:2]])
    return np.concatenate([two, -two])


def drawn_in(near: NearSurface, place: Pose, points: Floats, ends: Floats, within: float) -> list[Pose]:
    """Poses of a model beside its place that most of some ends of beams lie on, best first.

    near : its surface; place : scene_from_model; points : (N, 3) of it, model frame
    ends : (E, 3) scene frame; within : of its surface, metres
    """
    some = ends[:: max(1, -(-len(ends) // MOST_ENDS))]
    starts = [place @ Pose(np.eye(3), np.array(step)) for step in product(STARTS_M, repeat=3)]
    poses = [pulled(near, start, some, GATES_M) for start in starts]
    close = near._replace(reach=within)
    held = [np.count_nonzero(measured(close, pose, some, 1)[1] >= 0) for pose in poses]
    kept = list[Pose]()
    for k in np.argsort(np.negative(held), kind="stable"):
        moved = poses[k].move(points)
        if all(np.linalg.norm(other.move(points) - moved, axis=1).max() > DISTINCT_M for other in kept):
            kept.append(poses[k])
    return kept[:MOST_TRIED]


def of_others(points: Floats, others: Sequence[Standing], within: float) -> NDArray[np.bool_]:
    """Which of N points (N, 3), scans' own frame, lie on others, within so many metres."""
    theirs = np.zeros(len(points), np.bool_)
    for one in others:
        some = np.flatnonzero(~theirs)
        off = signed_distances(one.surface, one.scene_from_model.inverse().move(points[some]))[0]
        theirs[some] = np.abs(off) <= within  # NaN where it is farther than the surface reaches
    return theirs
