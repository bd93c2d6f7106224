"""Pose and scale at once: a placed surface fitted to points whose unit is not quite a metre, seven unknowns.

The fit of `polish` with one motion more: all of the surface away from its middle.
"""

from __future__ import annotations

from math import sqrt
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.fit.patches import patches_of, touching
from scanfind.fit.polish import LEAST_NOISE, LEAST_PATCHES, MOST_POINTS, PATCHES_ACROSS, informed, solved
from scanfind.pose import Pose, rotation_from_vector

if TYPE_CHECKING:
    from collections.abc import Sequence

    from scanfind.kernels.distance import NearSurface

Floats = NDArray[np.float64]

# Growing is no motion that data leave open where this much of it, in one unit with the others, is (the sine of 6°).
OPEN = 0.1


class Similarity(NamedTuple):
    """A surface fitted with its scale.

    scale : metres a unit of the points; sigma : its standard deviation
    pose : scene_from_model, of the points times `scale`, metres
    """

    scale: float
    sigma: float
    pose: Pose


def similarity(
    near: NearSurface, start: Similarity, xyz: Floats, scan_id: NDArray[np.integer], gates: Sequence[float],
    below: float, jobs: int = 1,
) -> Similarity | None:  # fmt: skip
    """Fit pose and scale to points around a placed model; None where they do not tell its size.

    near : the model's surface, metres, with a reach of the largest gate or more
    start : from where, as near as a gate; xyz : (N, 3) in the scan's own unit; scan_id : (N,) whose they are
    gates : of each step, metres: how far a point may be from the surface. There should be points as far as that
    below : share of the mean information under which a motion is left open
    """
    some = slice(None, None, max(1, -(-len(xyz) // MOST_POINTS)))
    xyz, scan_id = np.ascontiguousarray(xyz[some]), scan_id[some]
    low, high = near.boxes[1].reshape(2, 3)
    centre, size = 0.5 * (low + high), float(np.linalg.norm(high - low))
    radius, at = 0.5 * size, start
    for gate in gates:
        gated = near._replace(reach=gate)
        on = touching(gated, at.pose, at.pose, at.scale * xyz, scan_id, jobs)
        patches = patches_of(on, centre, radius, size / PATCHES_ACROSS, LEAST_NOISE * size, growing=True)
        if len(patches.off) < LEAST_PATCHES:
            return None
        shares, motions = informed(patches)
        if (np.abs(motions[6, shares <= below]) > OPEN).any():
            return None
        step, covariance = solved(patches, motions[:, shares > below])
        at = grown(at, step, centre, radius, sqrt(covariance[6, 6]))
    return at


def grown(at: Similarity, step: Floats, centre: Floats, radius: float, sigma: float) -> Similarity:
    """The surface after a step (7,) of (rotation × radius, translation, growth × radius) about its centre (3,).

    centre : model frame; sigma : of the last of the seven, metres. Where the surface should be larger, the points have
    fewer metres a unit.
    """
    turned, growth = rotation_from_vector(step[:3] / radius), 1.0 + step[6] / radius
    rotation = at.pose.rotation @ turned
    middle = at.pose.move((centre + step[3:6])[None])[0] / growth
    scale = at.scale / growth
    return Similarity(scale, scale * sigma / radius, Pose(rotation, middle - rotation @ centre))


def agreed(fits: Sequence[Similarity]) -> tuple[float, float]:
    """The one scale of several instances, and its standard deviation.

    Instances share no other unknown, so that least squares of all of them at once has the mean of their scales, each
    weighted by how well it is known, for its own. Where they disagree by more than that, it is known as much worse
    (Birge's ratio).
    """
    scales, weights = np.array([fit.scale for fit in fits]), np.array([1.0 / fit.sigma**2 for fit in fits])
    mean = float(weights @ scales / weights.sum())
    disagreement = float(weights @ (scales - mean) ** 2) / max(len(fits) - 1, 1)
    return mean, sqrt(max(disagreement, 1.0) / float(weights.sum()))
