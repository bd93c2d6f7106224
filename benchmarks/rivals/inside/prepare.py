"""The same preparation for every rival: even density, normals towards the scanner, floor and walls taken away."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.rivals.inside.neighbours import Grow, Neighbours, grow_tree
from scanfind.cloud import OrientedCloud

Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]

# Open3D's own registration tutorial and PCL's: features at one voxel, normals from within two, 30 neighbours at most.
NORMAL_VOXELS, NORMAL_NEIGHBOURS = 2.0, 30
# Planes, refinement and check see four times finer: a 9 cm voxel would blur a 15 cm steel section away.
FINE_SHARE, FINE_NEIGHBOURS = 0.25, 20
LEAST_NEIGHBOURS = 5

PLANE_TOLERANCE_M, PLANE_AREA_M2 = 0.03, 6.0
# Area is counted in cells on the plane, wide enough to be filled where the scan is thin.
PLANE_CELL_M = 0.1
PLANE_COSINE = 0.9
PLANE_DRAWS, PLANE_SAMPLE = 300, 5000
MOST_PLANES = 30


@dataclass(frozen=True)
class Prepared:
    """A scene without its large planes.

    fine : at a quarter of a voxel, for refinement and check; tree : over its points
    coarse : at one voxel, what the rival is given
    """

    fine: OrientedCloud
    tree: Neighbours
    coarse: OrientedCloud


def prepare_scene(
    points: Floats, viewpoints: Floats, signed: bool, voxel: float, seed: int, grow: Grow = grow_tree
) -> Prepared:
    """Thin, orient and clear a scene.

    points : (N, 3) metres; viewpoints : (N, 3) from where each was seen; signed : is that known?
    """
    cells, seen_from = thin(voxel * FINE_SHARE, points, viewpoints)
    fine = oriented(cells, seen_from, voxel, FINE_NEIGHBOURS, signed, grow)
    kept = without_planes(fine, np.random.default_rng(seed))
    if len(kept) < LEAST_NEIGHBOURS:
        msg = "nothing is left of the scene without its planes"
        raise ValueError(msg)
    fine = OrientedCloud(fine.points[kept], fine.normals[kept], signed)
    # A normal is as good a direction as any to turn the coarser ones by.
    means, outwards = thin(voxel, fine.points, fine.points + fine.normals)
    coarse = oriented(means, outwards, NORMAL_VOXELS * voxel, NORMAL_NEIGHBOURS, signed, grow)
    return Prepared(fine, grow(fine.points), coarse)


def prepare_model(samples: OrientedCloud, voxel: float, grow: Grow = grow_tree) -> OrientedCloud:
    """The model as the scene will look: at one voxel, its normals blurred alike, or features would not match."""
    means, outwards = thin(voxel, samples.points, samples.points + samples.normals)
    return oriented(means, outwards, NORMAL_VOXELS * voxel, NORMAL_NEIGHBOURS, True, grow)


def thin(cell: float, points: Floats, *others: Floats) -> tuple[Floats, ...]:
    """Means of points (N, 3), and of other rows (N, 3) that go with them, in cubic cells."""
    keys = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    extent = keys.max(axis=0) + 1
    packed = (keys[:, 0] * extent[1] + keys[:, 1]) * extent[2] + keys[:, 2]
    _, owner, counts = np.unique(packed, return_inverse=True, return_counts=True)
    return tuple(
        np.stack([np.bincount(owner, rows[:, k]) for k in range(3)], axis=1) / counts[:, None]
        for rows in (points, *others)
    )


def oriented(
    points: Floats, seen_from: Floats, radius: float, neighbours: int, signed: bool, grow: Grow
) -> OrientedCloud:
    """Normals by PCA, turned to where points were seen from; points with too few neighbours have none and go."""
    far, near = grow(points).query(points, k=min(neighbours, len(points)), distance_upper_bound=radius)
    there = np.isfinite(far)
    weights = there[..., None] / there.sum(axis=1)[:, None, None]
    around = points[np.where(there, near, 0)] - points[:, None]
    spread = (around - (around * weights).sum(axis=1)[:, None]) * np.sqrt(weights)
    normals = np.linalg.eigh(spread.transpose(0, 2, 1) @ spread)[1][:, :, 0]
    normals *= np.where(((seen_from - points) * normals).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    sound = there.sum(axis=1) >= LEAST_NEIGHBOURS
    return OrientedCloud(points[sound], normals[sound], signed)


def without_planes(cloud: OrientedCloud, rng: np.random.Generator) -> Numbers:
    """Rows of a cloud that lie on no plane of more than PLANE_AREA_M2: RANSAC, the largest first, again and again.

    One oriented point is a plane. Points whose normal is not the plane's stay: a pipe on the floor keeps its side.
    """
    left = np.arange(len(cloud))
    for _ in range(MOST_PLANES):
        if len(left) < LEAST_NEIGHBOURS:
            break
        on = _largest_plane(cloud.points[left], cloud.normals[left], rng)
        if len(on) == 0:
            break
        left = np.delete(left, on)
    return left


def _largest_plane(points: Floats, normals: Floats, rng: np.random.Generator) -> Numbers:
    """Rows on the largest plane found; none where it is too small."""
    drawn = rng.integers(len(points), size=PLANE_DRAWS)
    sample = rng.choice(len(points), min(PLANE_SAMPLE, len(points)), replace=False)
    offsets = (points[drawn] * normals[drawn]).sum(axis=1)
    near = np.abs(points[sample] @ normals[drawn].T - offsets) < PLANE_TOLERANCE_M
    alike = np.abs(normals[sample] @ normals[drawn].T) > PLANE_COSINE
    best = int((near & alike).sum(axis=0).argmax())
    normal, offset = normals[drawn[best]], offsets[best]
    for _ in range(3):
        on = _on_plane(points, normals, normal, offset)
        middle = points[on].mean(axis=0)
        spread = points[on] - middle
        normal = np.linalg.eigh(spread.T @ spread)[1][:, 0]
        offset = middle @ normal
    on = _on_plane(points, normals, normal, offset)
    along = np.linalg.svd(normal[None])[2][1:]
    filled = np.unique(np.floor(points[on] @ along.T / PLANE_CELL_M), axis=0)
    return on if len(filled) * PLANE_CELL_M**2 > PLANE_AREA_M2 else on[:0]


def _on_plane(points: Floats, normals: Floats, normal: Floats, offset: float) -> Numbers:
    near = np.abs(points @ normal - offset) < PLANE_TOLERANCE_M
    return np.flatnonzero(near & (np.abs(normals @ normal) > PLANE_COSINE))
