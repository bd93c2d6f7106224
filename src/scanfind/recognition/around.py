"""Where an element is looked for that is not in its place: beside it, across its length, by what beams say.

Of a flat bar of 8 mm that stands 60 mm off other surfaces are nearer to its place than its own: ICP goes to them. Beams
held against the bar itself, in one place after the other, are not drawn anywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.library.near_surface import signed_distances
from scanfind.pose import Pose

if TYPE_CHECKING:
    from scanfind.recognition.candidate import Standing

Floats = NDArray[np.float64]

# So far to either side, in steps from which a fit to beams leads on; and how many of the places that explain more than
# those about them are tried.
STEPS_M, MOST_PEAKS = np.linspace(-0.08, 0.08, 9), 5


def long_side(points: Floats) -> Floats:
    """The direction (3,) of the long side of the box about points (N, 3), in their own axes."""
    return np.asarray(np.eye(3)[np.argmax(np.ptp(points, axis=0))])


def across(pose: Pose, points: Floats) -> Floats:
    """Both ways across the long side of a placed model with points (N, 3): (4, 3) directions, scene axes."""
    two = pose.turn(np.eye(3)[np.argsort(np.ptp(points, axis=0), kind="stable")[:2]])
    return np.concatenate([two, -two])


def beside(pose: Pose, points: Floats) -> list[Pose]:
    """A pose of a model with points (N, 3), moved by each two of STEPS_M across its long side, row by row."""
    one, other = across(pose, points)[:2]
    return [Pose(pose.rotation, pose.translation + a * one + b * other) for a in STEPS_M for b in STEPS_M]


def peaks(values: Floats) -> NDArray[np.intp]:
    """Which of the values (K, K) no neighbour exceeds, by row and column in one, MOST_PEAKS of them, highest first."""
    framed = np.pad(values, 1, constant_values=-np.inf)
    about = np.lib.stride_tricks.sliding_window_view(framed, (3, 3)).max(axis=(2, 3))
    found = np.flatnonzero(values >= about)
    return found[np.argsort(-values.ravel()[found], kind="stable")][:MOST_PEAKS]


def of_others(points: Floats, areas: Floats, others: Sequence[Standing], within: float) -> float:
    """The share of surface that others explain as well.

    points, areas : (N, 3) scan frame, (N,) m²: where beams met it; within : metres from the surface of others
    """
    theirs = np.zeros(len(points), np.bool_)
    for one in others:
        some = np.flatnonzero(~theirs)
        off = signed_distances(one.surface, one.scene_from_model.inverse().move(points[some]))[0]
        theirs[some] = np.abs(off) <= within  # NaN where it is farther than the surface reaches
    return float(areas[theirs].sum() / max(areas.sum(), 1e-300))
