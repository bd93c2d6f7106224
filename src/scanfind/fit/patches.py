"""Raw points on a placed model, gathered into patches: what counts as one measurement of a pose.

Not a point: points a scanner saw of one small piece of surface, of one side, share whatever is wrong there (a dent, an
edge, a mixed pixel). What they share only shows between patches (decisions/0012-what-the-data-fix.md).
"""

from __future__ import annotations

from math import erf, pi, sqrt
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.threads import in_threads

if TYPE_CHECKING:
    from scanfind.kernels.distance import NearSurface
    from scanfind.pose import Pose

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Points farther off than so many times the noise are something else's. With three, cut off at three, the squared error
# was a fifth more than told.
GATE_NOISES = 4.0
NARROWEST = 1.0  # noises: where less than this is left of the gate, too little can be told from it
# How many points of the whole a group's noise is averaged with, so that a group of three has one.
PRIOR_POINTS = 12.0
NOISE_STEPS = 3  # from the median's noise to that of what the gate leaves


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

    rows : (P, 6) how far the surface goes along its normal with each motion (rotation × radius, translation); where it
        may grow (P, 7), the last with growth × radius
    off : (P,) of the points from the surface, metres; variance : (P,) of that by noise alone
    """

    rows: Floats
    off: Floats
    variance: Floats


def measured(near: NearSurface, pose: Pose, xyz: Floats, jobs: int) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """How far N points (N, 3) are from the placed surface, (N,), metres, NaN beyond reach, and from which faces."""
    from scanfind.kernels.distance import distances

    shift, every = np.zeros(3), np.arange(len(xyz))
    if not len(xyz):
        return np.empty(0, np.float32), np.empty(0, np.int32)
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


def patches_of(
    on: Touching, centre: Floats, radius: float, patch: float, least_noise: float, *, growing: bool = False
) -> Patches:
    """The patches of points: those of one group in one cube of edge `patch`, metres, of the model's frame.

    growing : the surface's size is unknown as well
    """
    nothing = Patches(np.empty((0, 6 + growing)), np.empty(0), np.empty(0))
    if not len(on.off):
        return nothing
    noise = np.maximum(noise_of(on.off, on.group), least_noise)
    gate = np.minimum(on.gate, GATE_NOISES * noise)
    kept = (np.abs(on.off) < gate) & (gate > NARROWEST * noise)
    points, normals, off, group = on.points[kept], on.normals[kept], on.off[kept], on.group[kept]
    if not len(off):
        return nothing
    gate, noise = gate[kept], noise[kept]
    for _ in range(NOISE_STEPS):
        # Not the median alone: it takes a scan in steps (a Kinect's) for one without noise.
        noise = np.sqrt(np.maximum(pooled(off**2, followed(gate / noise), group), least_noise**2))
    follows = followed(gate / noise)
    cube = np.floor(points / patch).astype(np.int64)
    member = numbered(*cube.T, group)
    counts = np.bincount(member, follows)
    rows = np.concatenate([np.cross(points - centre, normals) / radius, normals], axis=1)
    if growing:
        rows = np.concatenate([rows, ((points - centre) * normals).sum(axis=1, keepdims=True) / radius], axis=1)
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


def numbered(*columns: Ints) -> Ints:
    """Equal rows of some columns (N,) get equal numbers (N,), counted from 0."""
    packed = np.zeros(len(columns[0]), np.int64)
    for column in columns:
        if len(column):
            packed = packed * (np.ptp(column) + 1) + (column - column.min())
    return np.asarray(np.unique(packed, return_inverse=True)[1].ravel(), np.int64)
