"""A feature fitted to points: a rigid motion of its planes and cylinders, and how much wider it is than designed.

Robust least squares (Gauss & Newton; Tukey's weights). The covariance is that of an M-estimator, widened by what small
patches of points disagree beyond the noise of their points: neighbouring points share whatever is wrong there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.dimensions.features import BAR, PIPE
from scanfind.dimensions.skin import across
from scanfind.pose import Pose, rotation_from_vector

if TYPE_CHECKING:
    from scanfind.dimensions.features import Feature, Surface

Floats = NDArray[np.float64]

STEPS = 20
STILL = 1e-9  # metres: no step is worth less
TUKEY = 4.685  # 95 % as efficient as least squares on clean points
MEDIAN = 1.4826  # times the median of absolute values is a standard deviation
PATCHES = 8  # along the diagonal of what is seen
LEAST_PATCHES = 8
LEAST_NOISE = 1e-6  # metres: exact points still have a rounding


class Seen(NamedTuple):
    """N points on one surface of a feature: (N, 3), the model's frame, metres."""

    surface: Surface
    points: Floats


@dataclass(frozen=True, eq=False)
class State:
    """Where a feature is: its centre and unit axis, model frame, and its radius, metres."""

    centre: Floats
    axis: Floats
    radius: float


@dataclass(frozen=True, eq=False)
class Fitted:
    """A feature as built.

    moved : what moves its design there, the model's frame; wider : by how much its radius is larger, metres
    directions : (7, K) what was fitted: turns (3) about its centre, shifts (3), radius; its own frame as built
    covariance : (K, K) of these, rad and m; noise : of a single point, metres
    """

    feature: Feature
    moved: Pose
    wider: float
    directions: Floats
    covariance: Floats
    noise: float

    def state(self, change: Floats | None = None) -> State:
        """Where it is, or would be after a change (K,) of what was fitted."""
        step = self.directions @ (np.zeros(self.directions.shape[1]) if change is None else change)
        feature, turn = self.feature, self.moved.rotation
        centre = self.moved.move(feature.centre[None])[0] + turn @ step[3:6]
        axis = turn @ rotation_from_vector(step[:3]) @ feature.axis
        # The radius of a flange is of its rim, which is not that of its face where the edge is bevelled.
        return State(centre, axis, feature.radius + self.wider + step[6])


def designed(feature: Feature) -> State:
    """Where a feature is in the design."""
    return State(feature.centre, feature.axis, feature.radius)


def directions_of(feature: Feature, *, rim: bool) -> Floats:
    """What can be fitted of a feature, (7, K): not its turn about its own axis, nor what slides in its surface.

    rim : is a cylinder about its axis seen?
    """
    u, v = across(feature.axis)
    if feature.kind == BAR:  # all but a slide along itself: its sides are seen or not, but they are of one piece
        return np.stack([np.r_[way, np.zeros(4)] for way in (u, v, feature.axis)]
                        + [np.r_[np.zeros(3), way, 0.0] for way in (u, v)], axis=1)  # fmt: skip
    turns = [np.r_[u, np.zeros(4)], np.r_[v, np.zeros(4)]]
    aside = [np.r_[np.zeros(3), u, 0.0], np.r_[np.zeros(3), v, 0.0], np.r_[np.zeros(6), 1.0]] if rim else []
    along = [np.r_[np.zeros(3), feature.axis, 0.0]] if feature.kind != PIPE else []
    return np.stack([*turns, *aside, *along], axis=1)


def fit(feature: Feature, seen: Sequence[Seen]) -> Fitted | None:
    """Fit a feature to points of its surfaces; None where they are too few, or too close together.

    Raises nothing: what is not fixed by the points shows in the covariance.
    """
    rim = any(each.surface.radius is not None for each in seen)
    directions = directions_of(feature, rim=rim)
    points = np.concatenate([each.points for each in seen])
    patch = patches_of(points)
    if patch.max(initial=0) + 1 < max(LEAST_PATCHES, directions.shape[1] + 2):
        return None
    moved, wider = Pose.identity(), 0.0
    off, rows = residuals(feature, seen, moved, wider)
    surface = np.repeat(np.arange(len(seen)), [len(each.points) for each in seen])
    noise = noise_of(off, surface)
    for _ in range(STEPS):
        weight = tukey(off, noise)
        j = rows @ directions
        normal = (j * weight[:, None]).T @ j
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        # Of a direction that the points hardly fix, the step is small, not wild: one millionth.
        damped = normal / np.outer(scale, scale) + 1e-9 * np.eye(len(normal))
        step = -np.linalg.solve(damped, (j * weight[:, None]).T @ off / scale) / scale
        motion = directions @ step
        turn = rotation_from_vector(motion[:3])
        c = feature.centre
        moved = moved @ Pose(turn, c - turn @ c + motion[3:6])
        wider += float(motion[6])
        off, rows = residuals(feature, seen, moved, wider)
        before, noise = noise, noise_of(off, surface)
        if np.abs(step).max() < STILL and np.abs(before - noise).max() < STILL:
            break
    covariance = covariance_of(rows @ directions, off, noise, patch)
    return (
        None if covariance is None else Fitted(feature, moved, wider, directions, covariance, float(np.median(noise)))
    )


def residuals(feature: Feature, seen: Sequence[Seen], moved: Pose, wider: float) -> tuple[Floats, Floats]:
    """How far points are from the feature where it is, (N,), and how that changes with turn, shift, radius, (N, 7)."""
    offs, rows = [], []
    back = moved.inverse()
    for surface, points in seen:
        at = back.move(points)
        out = at - surface.point
        if surface.radius is None:
            normals = np.broadcast_to(surface.direction, at.shape)
            off = out @ surface.direction
            radial = np.zeros(len(at))
        else:
            out = out - np.outer(out @ surface.direction, surface.direction)
            distance = np.linalg.norm(out, axis=1)
            normals = out / np.maximum(distance, 1e-12)[:, None]
            off, radial = distance - surface.radius - wider, np.full(len(at), -1.0)
        offs.append(off)
        rows.append(np.column_stack([-np.cross(at - feature.centre, normals), -normals, radial]))
    return np.concatenate(offs), np.concatenate(rows)


def noise_of(off: Floats, surface: NDArray[np.int64]) -> Floats:
    """The spread of each point's surface, (N,), from zero, not from the middle of its residuals.

    A feature may be off by many times the noise, and of a tilted bar two sides are off and two are not: were it that of
    all points together, those would count for nothing.
    """
    spread = [MEDIAN * float(np.median(np.abs(off[surface == k]))) for k in range(int(surface.max()) + 1)]
    return np.maximum(spread, LEAST_NOISE)[surface]


def tukey(off: Floats, noise: Floats) -> Floats:
    """Tukey's weights (N,) of residuals."""
    return np.maximum(1.0 - (off / (TUKEY * noise)) ** 2, 0.0) ** 2


def covariance_of(j: Floats, off: Floats, noise: Floats, patch: NDArray[np.int64]) -> Floats | None:
    """The covariance (K, K) of what was fitted (Huber 1981, 7.6), widened by what patches disagree by.

    j : (N, K) derivatives of the residuals off (N,); noise : (N,) of each point; patch : (N,) which patch each is in
    None where the points leave a direction open.
    """
    share = (off / (TUKEY * noise)) ** 2
    weight = np.maximum(1.0 - share, 0.0) ** 2
    slope = np.where(share < 1.0, (1.0 - share) * (1.0 - 5.0 * share), 0.0)
    scale = np.linalg.norm(j, axis=0)
    if not (scale > 0.0).all():
        return None
    scaled = j / scale
    bread = (scaled * max(float(slope.mean()), 0.1)).T @ scaled
    if np.linalg.cond(bread) > 1e10:
        return None
    inverse = np.linalg.inv(bread)
    score = scaled * (weight * off)[:, None]
    count = int(patch.max()) + 1
    told = inverse @ (scaled.T @ scaled * float(np.mean((weight * off) ** 2))) @ inverse
    summed = np.stack([np.bincount(patch, column, minlength=count) for column in score.T], axis=1)
    unknowns = j.shape[1]
    by_patch = inverse @ (summed.T @ summed) @ inverse * (count / (count - unknowns))
    # On average over what was fitted: each alone is too uncertain with a few dozen patches.
    widened = float(np.trace(np.linalg.solve(told, by_patch))) / unknowns
    covariance: Floats = told * max(widened, 1.0) / np.outer(scale, scale)
    return covariance


def patches_of(points: Floats) -> NDArray[np.int64]:
    """Which patch each of N points (N, 3) is in, (N,): cubes, an eighth of the diagonal of all."""
    low, high = points.min(axis=0), points.max(axis=0)
    edge = max(float(np.linalg.norm(high - low)) / PATCHES, 1e-9)
    cube = np.floor((points - low) / edge).astype(np.int64)
    return np.unique(cube @ [1, 1 << 20, 1 << 40], return_inverse=True)[1]
