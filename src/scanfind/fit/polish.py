"""The last fit: a pose on its own raw points, and how uncertain it is (decisions/0012-what-the-data-fix.md).

The isolated points are held against the model's exact surface, patch by patch. A patch is as uncertain as the mean of
its points and, on top, as patches are found to disagree.
"""

from __future__ import annotations

from dataclasses import replace
from math import sqrt
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.detection import Motion
from scanfind.fit.patches import Patches, measured, patches_of, touching
from scanfind.fit.refine import RefineParameters, in_scene, motion_of, triple
from scanfind.isolation.deviation import deviation_of
from scanfind.library.onto_itself import about
from scanfind.pose import Pose, rotation_from_vector

if TYPE_CHECKING:
    from scanfind.detection import Detection
    from scanfind.kernels.distance import NearSurface

Floats = NDArray[np.float64]

# A scan of 10 M points has 200,000 on a frame: each costs 2 µs, and what more than these tell is lost in what patches
# disagree by (3 M points, 2 mm noise: 0.026 mm off with 30,000, 0.024 mm with 60,000).
MOST_POINTS = 30_000
# Along the diameter: 3 cm of a spool of 3.6 m. On tuning scenes the squared error is 1.00 of what is told with 144,
# 0.92 with 72, 0.75 with 36: larger patches hold several faces' edges and take them for disagreement.
PATCHES_ACROSS = 120.0
LEAST_NOISE = 1e-6  # of the diameter: exact points still have a rounding
TUKEY = 4.685  # patches off by more sigmas count for nothing; 95 % as efficient as least squares on clean ones
REWEIGHTINGS = 6
LEAST_PATCHES = 12  # twice the unknowns
# Raw points fix what surfels smooth away: a header's roll by 70 points on its branches, at 0.0007 to 0.003 of the mean.
# So much of what opens a motion among surfels does among raw points, of a roll that would take so many of them off the
# surface: what facets say of a tank's roll, wrongly, is as much, and rolled by as far it is where it was.
OPEN_SHARE, ROLLED, LEAVES = 0.125, 0.2, 0.01
# Further steps, as many times more, while they are as long as half a sigma: from surfels that roll came 2.5° off.
MORE_STEPS, SHORT = 3, 0.5


class Polished(NamedTuple):
    """A pose fitted to raw points.

    covariance : (6, 6) of (rotation, translation), scene axes, rad and m, about the pivot: zero along the motions of
        `unobservable` that have no sigma
    pivot : (3,) scene frame, metres: the middle of the model's box, placed
    unobservable : motions the data do not fix, or fix to no better than one point's noise
    """

    scene_from_model: Pose
    covariance: Floats
    pivot: Floats
    unobservable: tuple[Motion, ...]


def polish(
    near: NearSurface, pose: Pose, xyz: Floats, scan_id: NDArray[np.integer], parameters: RefineParameters,
    jobs: int = 1,
) -> Polished | None:  # fmt: skip
    """Fit a pose to raw points of its model; None where fewer than `LEAST_PATCHES` patches are seen.

    near : the model's surface; a point within its reach may count
    pose : scene_from_model, within the noise of the right one
    xyz : (N, 3) the isolated points, scene frame; scan_id : (N,) whose they are
    """
    if len(xyz) < LEAST_PATCHES:
        return None
    some = slice(None, None, max(1, -(-len(xyz) // MOST_POINTS)))
    xyz, scan_id = np.ascontiguousarray(xyz[some]), scan_id[some]
    low, high = near.boxes[1].reshape(2, 3)
    centre, size = 0.5 * (low + high), float(np.linalg.norm(high - low))
    start, radius = pose, 0.5 * size
    for number in range(MORE_STEPS * parameters.raw_steps):
        on = touching(near, pose, start, xyz, scan_id, jobs)
        patches = patches_of(on, centre, radius, size / PATCHES_ACROSS, LEAST_NOISE * size)
        if len(patches.off) < LEAST_PATCHES:
            return None
        shares, motions = informed(patches)
        below, least = parameters.unobservable_below, motion_of(motions[:, 0], centre, radius)
        if shares[0] <= below and rolls_off(near, least, on.points, jobs):
            below *= OPEN_SHARE
        free = motions[:, shares <= below]
        step, covariance = solved(patches, motions[:, shares > below])
        turned = rotation_from_vector(step[:3] / radius)
        # In the model's frame, about its centre: the true pose is pose @ motion.
        pose = pose @ Pose(turned, centre - turned @ centre + step[3:])
        variances, vectors = np.linalg.eigh(covariance)
        known = variances > 1e-9 * variances[-1]  # not along what is left open
        long = (vectors[:, known].T @ step) ** 2 > SHORT**2 * variances[known]
        if number + 1 >= parameters.raw_steps and not long.any():
            break
    noise = 1.4826**2 * float(np.median(on.off**2))
    loose = [motion_of(motion, centre, radius) for motion in free.T] + [
        motion_of(vector, centre, radius, sqrt(variance))
        for variance, vector in zip(variances, vectors.T, strict=True)
        if variance > noise
    ]
    return Polished(pose, in_scene(covariance, pose.rotation, radius), pose.move(centre[None])[0], tuple(loose))


def rolls_off(near: NearSurface, motion: Motion, points: Floats, jobs: int) -> bool:
    """Would a motion take points (K, 3) off their surface, were it a roll by ROLLED radians? Model frame."""
    if motion.kind != "roll":
        return False
    back = about(np.array(motion.axis), np.array(motion.through), -ROLLED)
    distance, _ = measured(near, back, points, jobs)
    return bool(np.isnan(distance).mean() > LEAVES)


def polished(found: Detection, near: NearSurface, parameters: RefineParameters, jobs: int = 1) -> Detection:
    """A detection fitted to its isolated points, with the distances of these from where it is now.

    As it was where it has no points, too few patches are seen, or no step is wanted.
    """
    cut = found.isolated
    if cut is None or not parameters.raw_steps:
        return found
    fit = polish(near, found.scene_from_model, cut.xyz, cut.scan_id, parameters, jobs)
    if fit is None:
        return found
    # A few are farther now, by a tenth of a millimetre, than they were cut out to: they are still measured.
    distance, _ = measured(near._replace(reach=2.0 * near.reach), fit.scene_from_model, cut.xyz, jobs)
    off = np.where(np.isnan(distance), cut.deviation, distance)
    return replace(
        found, scene_from_model=fit.scene_from_model, covariance=fit.covariance, pivot=triple(fit.pivot),
        unobservable=fit.unobservable, isolated=replace(cut, deviation=off), deviation=deviation_of(off),
    )  # fmt: skip


def informed(patches: Patches) -> tuple[Floats, Floats]:
    """What patches tell of each of as many motions as there are unknowns, least first: a share of the mean, (6,), and
    the unit motions, (6, 6), as columns.
    """
    values, motions = np.linalg.eigh((patches.rows / patches.variance[:, None]).T @ patches.rows)
    return values / values.mean(), motions


def solved(patches: Patches, fixed: Floats) -> tuple[Floats, Floats]:
    """The step (6,) to where patches are matched best, and its covariance (6, 6).

    fixed : (6, K) unit motions that the patches fix: no step along others, and no covariance

    Tukey's weights over each patch's sigma: its noise, and what all patches disagree by beyond theirs.
    """
    rows, weight, disagreement = patches.rows @ fixed, np.ones(len(patches.off)), 0.0
    for _ in range(REWEIGHTINGS):
        weighted = rows * (weight / (patches.variance + disagreement))[:, None]
        normal = weighted.T @ rows
        # A trillionth: where the weights leave nothing of a motion, it is left where it is.
        step = np.linalg.solve(normal + 1e-12 * np.trace(normal) * np.eye(len(normal)), weighted.T @ patches.off)
        squares, in_use = (patches.off - rows @ step) ** 2, weight > 0.0
        disagreement = disagreed(squares[in_use], patches.variance[in_use], len(normal))
        precision = 1.0 / (patches.variance + disagreement)
        share = squares * precision / TUKEY**2
        weight = np.where(share < 1.0, (1.0 - share) ** 2, 0.0)
    # An M-estimator's covariance: least squares' times E ψ² / (E ψ')² (Huber 1981, 7.6); 1.05 where all is normal.
    slope = np.where(share < 1.0, (1.0 - share) * (1.0 - 5.0 * share), 0.0)
    spread = float(np.mean(weight**2 * share)) * TUKEY**2 / max(float(slope.mean()), 0.1) ** 2
    covariance = np.linalg.inv((rows * precision[:, None]).T @ rows) * max(spread, 1.0)
    return fixed @ step, fixed @ covariance @ fixed.T


def disagreed(squares: Floats, variance: Floats, unknowns: int) -> float:
    """The variance that patches have beyond their noise: with it, the squares of what is left are as many as they are
    degrees of freedom (Paule & Mandel 1982, by bisection).
    """
    freedom = len(squares) - unknowns
    low, high = 0.0, float(squares.max())
    if float((squares / variance).sum()) <= freedom:
        return 0.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if float((squares / (variance + middle)).sum()) > freedom else (low, middle)
    return high
