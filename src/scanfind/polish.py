"""The last fit: a pose on its own raw points, and how uncertain it is (decisions/0012-what-the-data-fix.md).

The isolated points are held against the model's exact surface. What counts as one measurement is not a point but a
patch: points a scanner saw of one small piece of surface, of one side, share whatever is wrong there (a dent, an edge,
a mixed pixel), so a patch is as uncertain as the mean of its points and, on top, as patches are found to disagree.
"""

from __future__ import annotations

from dataclasses import replace
from math import erf, pi, sqrt
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.detection import Motion
from scanfind.deviation import deviation_of
from scanfind.pose import Pose, rotation_from_vector
from scanfind.refine import RefineParameters, motion_of, triple
from scanfind.threads import in_threads

if TYPE_CHECKING:
    from scanfind.detection import Detection
    from scanfind.kernels.distance import NearSurface

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# A scan of 10 M points has 200,000 on a frame: each costs 2 µs, and what more than these tell is lost in what patches
# disagree by (3 M points, 2 mm noise: 0.026 mm off with 30,000, 0.024 mm with 60,000).
MOST_POINTS = 30_000
# Along the diameter: 3 cm of a spool of 3.6 m. On tuning scenes the squared error is 1.00 of what is told with 144,
# 0.92 with 72, 0.75 with 36: larger patches hold several faces' edges and take them for disagreement.
PATCHES_ACROSS = 120.0
# Points farther off than so many times the noise are something else's. At three the gate itself made errors a third
# larger than told.
GATE_NOISES = 4.0
NARROWEST = 1.0  # noises: where less than this is left of the gate, too little can be told from it
# How many points of the whole a group's noise is averaged with, so that a group of three has one.
PRIOR_POINTS = 12.0
LEAST_NOISE = 1e-6  # of the diameter: exact points still have a rounding
TUKEY = 4.685  # patches off by more sigmas count for nothing; 95 % as efficient as least squares on clean ones
REWEIGHTINGS = 6
NOISE_STEPS = 3
LEAST_PATCHES = 12  # twice the unknowns


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


class Touching(NamedTuple):
    """K points on faces of the placed model, in the model's frame.

    points, normals : (K, 3) metres, and of their faces; off : (K,) from the face's plane, metres
    gate : (K,) metres: a point as far off, on either side, would have been isolated as well
    group : (K,) numbers points of one scan on faces that look the same way, which have about the same noise
    """

    points: Floats
    normals: Floats
    off: Floats
    gate: Floats
    group: Ints


class Patches(NamedTuple):
    """P means of the points on a patch each.

    rows : (P, 6) how far the surface goes along its normal with each motion (rotation × radius, translation)
    off : (P,) of the points from the surface, metres; variance : (P,) of that by noise alone
    """

    rows: Floats
    off: Floats
    variance: Floats


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
    for _ in range(parameters.raw_steps):
        on = touching(near, pose, start, xyz, scan_id, jobs)
        patches = patches_of(on, centre, radius, size / PATCHES_ACROSS, LEAST_NOISE * size)
        if len(patches.off) < LEAST_PATCHES:
            return None
        step, covariance, free = solved(patches, parameters.unobservable_below)
        turned = rotation_from_vector(step[:3] / radius)
        # In the model's frame, about its centre: the true pose is pose @ motion.
        pose = pose @ Pose(turned, centre - turned @ centre + step[3:])
    variances, vectors = np.linalg.eigh(covariance)
    noise = float(np.median(on.off**2))
    loose = [motion_of(motion, centre, radius) for motion in free.T] + [
        motion_of(vector, centre, radius, sqrt(variance))
        for variance, vector in zip(variances, vectors.T, strict=True)
        if variance > noise
    ]
    return Polished(pose, in_scene(covariance, pose, radius), pose.move(centre[None])[0], tuple(loose))


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
    distance, _ = measured(near, fit.scene_from_model, cut.xyz, jobs)
    # The few that are out of reach by a tenth of a millimetre now keep the distance they were isolated by.
    off = np.where(np.isnan(distance), cut.deviation, distance)
    return replace(
        found, scene_from_model=fit.scene_from_model, covariance=fit.covariance, pivot=triple(fit.pivot),
        unobservable=fit.unobservable, isolated=replace(cut, deviation=off), deviation=deviation_of(off),
    )  # fmt: skip


def measured(near: NearSurface, pose: Pose, xyz: Floats, jobs: int) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """How far N points (N, 3) are from the placed surface, (N,), metres, NaN beyond reach, and from which faces."""
    from scanfind.kernels.distance import distances

    shift, every = np.zeros(3), np.arange(len(xyz))
    parts = in_threads(
        jobs, len(xyz), lambda i, j: distances(near, pose.rotation, pose.translation, shift, xyz, every[i:j])
    )
    distance, face = (np.concatenate(column) for column in zip(*parts, strict=True))
    return distance, face


def touching(
    near: NearSurface, pose: Pose, start: Pose, xyz: Floats, scan_id: NDArray[np.integer], jobs: int
) -> Touching:
    """Those of N points (N, 3) whose nearest point of the placed model lies within a face, not on an edge.

    start : the pose by which they were isolated
    """
    distance, face = measured(near, pose, xyz, jobs)
    met = np.flatnonzero(face >= 0)
    row = np.empty(int(near.face.max()) + 1, np.int64)
    row[near.face] = np.arange(len(near.face))
    at = row[face[met]]
    points, normals = pose.inverse().move(xyz[met]), near.normals[at]
    off = ((points - near.corners[at, 0]) * normals).sum(axis=1)
    # At an edge the distance is longer than that from the plane; single precision tells 1 µm of it.
    within = np.abs(np.abs(off) - np.abs(distance[met])) < 1e-6
    met, points, normals, off = met[within], points[within], normals[within], off[within]
    # Isolated were the points about where the surface was then: of those farther off it now, one side is missing.
    moved = np.abs(((points - start.inverse().move(xyz[met])) * normals).sum(axis=1))
    facing = np.rint(normals).astype(np.int64)
    return Touching(points, normals, off, near.reach - moved, numbered(*facing.T, scan_id[met].astype(np.int64)))


def patches_of(on: Touching, centre: Floats, radius: float, patch: float, least_noise: float) -> Patches:
    """The patches of points: those of one group in one cube of edge `patch`, metres, of the model's frame."""
    if not len(on.off):
        return Patches(np.empty((0, 6)), np.empty(0), np.empty(0))
    noise = np.maximum(noise_of(on.off, on.group), least_noise)
    gate = np.minimum(on.gate, GATE_NOISES * noise)
    kept = (np.abs(on.off) < gate) & (gate > NARROWEST * noise)
    points, normals, off, group = on.points[kept], on.normals[kept], on.off[kept], on.group[kept]
    if not len(off):
        return Patches(np.empty((0, 6)), np.empty(0), np.empty(0))
    gate, noise = gate[kept], noise[kept]
    for _ in range(NOISE_STEPS):
        # Not the median alone: it takes a scan in steps (a Kinect's) for one without noise.
        noise = np.sqrt(np.maximum(pooled(off**2, followed(gate / noise), group), least_noise**2))
    follows = followed(gate / noise)
    cube = np.floor(points / patch).astype(np.int64)
    member = numbered(*cube.T, group)
    counts = np.bincount(member, follows)
    rows = np.concatenate([np.cross(points - centre, normals) / radius, normals], axis=1)
    return Patches(
        np.stack([np.bincount(member, follows * column) / counts for column in rows.T], axis=1),
        np.bincount(member, off) / counts,
        np.bincount(member, follows * noise**2) / counts**2,
    )


def followed(gate: Floats) -> Floats:
    """What share of a shift the mean of normal values follows that are cut off at ± gate sigmas; their variance has
    shrunk by the same.
    """
    sigmas = np.linspace(0.05, 6.0, 120)
    kept = np.array([erf(sigma / sqrt(2.0)) for sigma in sigmas])
    share = 1.0 - 2.0 * sigmas * np.exp(-0.5 * sigmas**2) / (sqrt(2.0 * pi) * kept)
    return np.interp(gate, sigmas, share)


def noise_of(off: Floats, group: Ints) -> Floats:
    """The noise of each of N points by its group, (N,), metres: 1.48 times the median of the absolute distance."""
    order = np.lexsort((np.abs(off), group))
    count = np.bincount(group)
    medians = np.abs(off)[order][np.cumsum(count) - count + count // 2]
    whole = float(np.median(np.abs(off)))
    shared = (count * medians**2 + PRIOR_POINTS * whole**2) / (count + PRIOR_POINTS)
    return np.asarray(1.4826 * np.sqrt(shared)[group])


def pooled(squares: Floats, counts: Floats, group: Ints) -> Floats:
    """Of each of N points its group's sum of squares over its sum of counts, (N,), with `PRIOR_POINTS` of all."""
    mean = squares.sum() / counts.sum()
    by_group = np.bincount(group, squares) + PRIOR_POINTS * mean
    return np.asarray((by_group / (np.bincount(group, counts) + PRIOR_POINTS))[group])


def solved(patches: Patches, below: float) -> tuple[Floats, Floats, Floats]:
    """The step (6,) to where patches are matched best, its covariance (6, 6), and the motions left open, (6, F).

    below : share of the mean information under which a motion is left open: no step along it, and no covariance

    Tukey's weights over each patch's sigma: its noise, and what all patches disagree by beyond theirs.
    """
    values, vectors = np.linalg.eigh((patches.rows / patches.variance[:, None]).T @ patches.rows)
    free = values <= below * values.mean()
    fixed = vectors[:, ~free]
    rows, disagreement = patches.rows @ fixed, 0.0
    step = np.zeros(rows.shape[1])
    for _ in range(REWEIGHTINGS):
        precision = 1.0 / (patches.variance + disagreement)
        share = (patches.off - rows @ step) ** 2 * precision / TUKEY**2
        weight = np.where(share < 1.0, (1.0 - share) ** 2, 0.0)
        weighted = rows * (weight * precision)[:, None]
        step = np.linalg.solve(weighted.T @ rows, weighted.T @ patches.off)
        in_use = weight > 0.0
        disagreement = disagreed((patches.off - rows @ step)[in_use] ** 2, patches.variance[in_use], rows.shape[1])
    # An M-estimator's covariance: least squares' times E ψ² / (E ψ')² (Huber 1981, 7.6).
    slope = np.where(share < 1.0, (1.0 - share) * (1.0 - 5.0 * share), 0.0)
    spread = float(np.mean(weight**2 * share)) * TUKEY**2 / float(slope.mean()) ** 2
    covariance = np.linalg.inv((rows * precision[:, None]).T @ rows) * spread
    return fixed @ step, fixed @ covariance @ fixed.T, vectors[:, free]


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


def in_scene(covariance: Floats, pose: Pose, radius: float) -> Floats:
    """From the model's axes and (rotation × radius, translation) to the scene's, radians and metres."""
    turn = np.zeros((6, 6))
    turn[:3, :3], turn[3:, 3:] = pose.rotation / radius, pose.rotation
    found = turn @ covariance @ turn.T
    return np.asarray(0.5 * (found + found.T))


def numbered(*columns: Ints) -> Ints:
    """Equal rows of some columns (N,) get equal numbers (N,), counted from 0."""
    packed = np.zeros(len(columns[0]), np.int64)
    for column in columns:
        if len(column):
            packed = packed * (np.ptp(column) + 1) + (column - column.min())
    return np.asarray(np.unique(packed, return_inverse=True)[1].ravel(), np.int64)
