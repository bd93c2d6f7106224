"""Plain twins of the core method's kernels: numpy, one thing at a time, by another way where there is one."""

from __future__ import annotations

from collections import defaultdict
from itertools import product

import numpy as np
from numpy.typing import NDArray

from naive_simulate import first_hit
from scanfind.evidence.free_space import Limits, Spoken
from scanfind.pose import Pose

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def kabsch(source: Floats, target: Floats) -> tuple[Floats, Floats]:
    """Least-squares rotation (3, 3), det +1, and translation (3,) of matching points (N, 3), by SVD."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((target - b).T @ (source - a))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return rotation, b - rotation @ a


def four_points(p: Floats, n: Floats, q: Floats, m: Floats, length: float) -> Floats:
    """The paper's Figure 8: two points and the ends of their normals, (4, 3)."""
    return np.stack([p, q, p + length * n, q + length * m])


def feature(p: Floats, n: Floats, q: Floats, m: Floats) -> Floats:
    """F = (∠(n, d), ∠(m, d), ∠(n, m)) of a pair of oriented points, radians."""
    d = (q - p) / np.linalg.norm(q - p)
    angles: Floats = np.arccos(np.clip([n @ d, m @ d, n @ m], -1.0, 1.0))
    return angles


def surfels(
    points: Floats, origins: Floats, cell: float, least: int
) -> dict[tuple[int, ...], tuple[Floats, Floats, bool]]:
    """Each occupied cell's mean and normal by PCA over all points in its 3×3×3 cells, towards its points' scanner.

    origins : (N, 3) the scanner of each point. A cell with fewer than `least` occupied around it has normal zero. The
    third part tells whether the normal is well defined: a surface rather than a blob or a line, not seen edge on.
    """
    members: dict[tuple[int, ...], list[int]] = defaultdict(list)
    for k, where in enumerate(np.floor(points / cell).astype(int).tolist()):
        members[tuple(where)].append(k)
    found = {}
    for where, inside in members.items():
        around = [members[near] for step in product((-1, 0, 1), repeat=3)
                  if (near := (where[0] + step[0], where[1] + step[1], where[2] + step[2])) in members]  # fmt: skip
        normal, sure = np.zeros(3), False
        if len(around) >= least:
            pooled = points[np.concatenate(around)]
            values, vectors = np.linalg.eigh(np.cov(pooled.T, bias=True))
            towards = origins[inside] - points[inside]
            facing = (towards / np.linalg.norm(towards, axis=1)[:, None]).mean(axis=0) @ vectors[:, 0]
            normal = vectors[:, 0] * np.sign(facing)
            sure = bool(values[1] > 1.2 * values[0] + 1e-8 and abs(facing) > 1e-3)
        found[where] = points[inside].mean(axis=0), normal, sure
    return found


def nearest(
    point: Floats, normal: Floats, means: Floats, normals: Floats, gate: float, cosine: float, signed: bool
) -> int:
    """The nearest surfel closer than `gate` with a like normal, -1 where there is none."""
    alike = normals @ normal if signed else np.abs(normals @ normal)
    far = np.linalg.norm(means - point, axis=1)
    far[(alike < cosine) | (far >= gate)] = np.inf
    best = int(far.argmin())
    return best if far[best] < np.inf else -1


def self_overlap(points: Floats, normals: Floats, signed: bool, some: int, pose: Pose, reach: float) -> float:
    """Share of the first `some` samples (N, 3) that a motion brings near a sample with a like normal."""
    apart = np.linalg.norm(pose.move(points[:some])[:, None] - points[None], axis=2)
    along = pose.turn(normals[:some]) @ normals.T
    like = (along if signed else np.abs(along)) > 0.7
    return float(((apart <= reach) & like).any(axis=1).mean())


def shift_table(
    one: tuple[Floats, Floats], onto: tuple[Floats, Floats], signed: bool, per_metre: float, reach: Ints
) -> Ints:
    """How often each shift, in cells about the middle of the table, leads from a point to another of like normal."""
    table = np.zeros(2 * reach + 1, np.int64)
    for point, normal in zip(*one, strict=True):
        for other, facing in zip(*onto, strict=True):
            along = float(normal @ facing)
            if (along if signed else abs(along)) > 0.9:
                table[tuple(reach + np.round((other - point) * per_metre).astype(np.int64))] += 1
    return table


def spoken(triangles: Floats, ends: tuple[Floats, Floats], limits: Limits) -> tuple[Spoken, float]:
    """What beams from zero say of triangles (F, 3, 3), one by one; ends : of the beams (B, 3), solid angles (B,).

    And what those stand for that pass an edge so near that it depends on where about the beam one looks for it.
    """
    told, doubtful = dict.fromkeys(Spoken._fields, 0.0), 0.0
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    for end, angle in zip(*ends, strict=True):
        far = float(np.linalg.norm(end))
        way = end / far
        distance, face = first_hit(np.zeros(3), way, triangles)
        cosine = abs(float(normals[face] @ way))
        if face < 0 or cosine < limits.facing:
            continue
        if abs(far - distance) * cosine <= limits.inlier:
            what = "on"
        elif far > distance + limits.margin:
            side = np.cross(way, [1.0, 0.0, 0.0] if abs(way[0]) < 0.6 else [0.0, 1.0, 0.0])
            side *= limits.inlier / np.linalg.norm(side)
            turns = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
            about = np.outer(np.cos(turns), side) + np.outer(np.sin(turns), np.cross(way, side))
            past = [first_hit(start, way, triangles)[0] >= far - limits.margin for start in about]
            if any(past):
                doubtful += 0.0 if all(past) else angle * distance**2 / cosine
                continue
            what = "through"
        else:
            what = "hidden" if far < distance - limits.margin else "beside"
        told[what] += angle * distance**2 / cosine
    return Spoken(**told), doubtful
