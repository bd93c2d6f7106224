"""Refinement: ICP of the model on the scene's surfels, and which motions the data do not fix (paper 3.4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.detection import Motion
from scanfind.errors import require
from scanfind.pose import Pose, rotation_from_vector, rotation_vector
from scanfind.search.hypotheses import Hypotheses, ModelArrays
from scanfind.threads import in_threads

if TYPE_CHECKING:
    from scanfind.grid.surfels import Surfels

Floats = NDArray[np.float64]

# Share of what fixes a motion on average below which one is held at the design's.
HELD = 0.01


@dataclass(frozen=True)
class RefineParameters:
    """How poses are refined.

    coarse_iterations, fine_iterations : ICP steps on the coarse and on the fine surfels (the paper: 5 in all)
    coarse_samples, fine_samples : model samples used
    coarse_gates, fine_gates : first and last gate of each, in cells of that level; shrinking geometrically between
    normal_agreement : least cosine between a model's and a surfel's normal
    raw_steps : last steps, on the isolated raw points themselves, more where these are long; 0: none, and no covariance
        (see `polish`)
    unobservable_below : a motion is reported as not fixed by the data when its curvature is this share of the mean
    """

    coarse_iterations: int = 12
    fine_iterations: int = 10
    coarse_samples: int = 400
    fine_samples: int = 3000
    coarse_gates: tuple[float, float] = (1.5, 0.6)
    fine_gates: tuple[float, float] = (1.2, 0.5)
    normal_agreement: float = 0.7
    raw_steps: int = 2
    unobservable_below: float = 0.004

    def __post_init__(self) -> None:
        for name in ("coarse_iterations", "fine_iterations", "coarse_samples", "fine_samples"):
            require(getattr(self, name) >= 1, name, getattr(self, name), "1 or more")
        require(self.raw_steps >= 0, "raw_steps", self.raw_steps, "0 or more")
        for name in ("coarse_gates", "fine_gates"):
            require(min(getattr(self, name)) > 0.0, name, getattr(self, name), "two positive numbers of cells")
        require(0.0 <= self.normal_agreement <= 1.0, "normal_agreement", self.normal_agreement, "from 0 to 1")


class Refined(NamedTuple):
    """H refined poses: hessians (H, 6, 6) in (rotation × radius, translation), matched (H,) share, rms (H,) metres."""

    hypotheses: Hypotheses
    hessians: Floats
    matched: Floats
    rms: Floats

    def take(self, which: NDArray[np.intp]) -> Refined:
        """Some of them, in that order."""
        return Refined(self.hypotheses.take(which), self.hessians[which], self.matched[which], self.rms[which])


def as_they_are(hypotheses: Hypotheses) -> Refined:
    """Poses that no ICP was asked of."""
    count = len(hypotheses.models)
    return Refined(hypotheses, np.zeros((count, 6, 6)), np.zeros(count), np.full(count, np.inf))


def icp(
    hypotheses: Hypotheses, surfels: Surfels, arrays: ModelArrays, signed: bool, gates: Floats, most_samples: int,
    normal_agreement: float, jobs: int,
) -> Refined:  # fmt: skip
    """Point-to-plane ICP of each of H hypotheses on the surfels.

    gates : one step each, metres: how far a sample may be from its surfel
    most_samples : of each model; normal_agreement : see RefineParameters
    signed : both sides know which way their normals face
    """
    from scanfind.kernels.icp import refine_poses

    count, cells = len(hypotheses.models), surfels.cells
    rotations, translations = hypotheses.rotations.copy(), hypotheses.translations.copy()
    hessians, matched, rms = np.zeros((count, 6, 6)), np.zeros(count), np.full(count, np.inf)
    in_threads(
        jobs, count,
        lambda start, stop: refine_poses(
            start, stop, hypotheses.models, arrays.starts, arrays.points, arrays.normals, arrays.centres, arrays.radii,
            most_samples, gates, normal_agreement, signed, cells.cell, cells.hash_keys, cells.hash_values,
            cells.filled, cells.block_rows, surfels.first_surfel, surfels.sides, surfels.means, surfels.normals,
            rotations, translations, hessians, matched, rms,
        ),
    )  # fmt: skip
    return Refined(hypotheses._replace(rotations=rotations, translations=translations), hessians, matched, rms)


def shrinking(first_last: tuple[float, float], steps: int, cell: float) -> Floats:
    """Gates from first to last, geometric, in metres."""
    return cell * np.geomspace(*first_last, steps)


def held(design: Pose, found: Pose, information: Floats, middle: Floats, radius: float) -> Pose:
    """A pose drawn back to the design's along the motions that the data hardly fix, as far as they do not.

    A beam slides along itself to where its neighbours' surfaces begin, and nearly nothing says it should not.

    information : (6, 6), any unit, of rotation × radius and translation of the middle, scene axes
    middle : (3,) of the model, its own frame; radius : metres
    """
    if not np.trace(information) > 0.0:
        return design
    at, there = design.move(middle[None])[0], found.move(middle[None])[0]
    turn = rotation_vector(found.rotation @ design.rotation.T) * radius
    kept = believed(information) @ np.concatenate([turn, there - at])
    rotation = rotation_from_vector(kept[:3] / radius) @ design.rotation
    return Pose(rotation, at + kept[3:] - rotation @ middle)


def believed(information: Floats) -> Floats:
    """How far motions (6,) are believed that data fix by `information` (6, 6): a matrix to move them by, (6, 6).

    Of a motion fixed HELD times as well as others on average half is believed, of one fixed less hardly any.
    """
    values, motions = np.linalg.eigh(information)
    level = HELD * values.mean()
    share = values**2 / (values**2 + level**2) if level > 0.0 else np.zeros(6)
    return np.asarray((motions * share) @ motions.T)


def covariance_of(hessian: Floats, rms: float, radius: float, below: float) -> Floats:
    """The covariance (6, 6) of (rotation, translation), rad and m, about the centre, of a pose as ICP leaves it: each
    sample a measurement as uncertain as all are off. On simulated shops the squared error is 1.03 of it.

    hessian, radius : see `Refined`, and its axes; rms : of what is left, metres
    below : see `unobservable`: along those motions it is zero
    """
    values, vectors = np.linalg.eigh(hessian)
    fixed = values > below * values.mean()
    covariance = rms**2 * (vectors[:, fixed] / values[fixed]) @ vectors[:, fixed].T
    return in_scene(covariance, np.eye(3), radius)


def unobservable(hessian: Floats, centre: Floats, radius: float, below: float) -> tuple[Motion, ...]:
    """The motions a refined pose may still make without the data noticing, in the model's frame.

    hessian : (6, 6) in the model's axes, (rotation × radius, translation) about the centre
    below : share of the mean curvature under which a motion counts as free
    """
    values, vectors = np.linalg.eigh(hessian)
    mean = float(np.trace(hessian)) / 6.0
    return tuple(motion_of(vectors[:, k], centre, radius) for k in range(6) if values[k] < below * mean or mean <= 0.0)


def motion_of(vector: Floats, centre: Floats, radius: float, sigma: float | None = None) -> Motion:
    """A six-vector (rotation × radius, translation) of unit length as the slide or roll it mostly is.

    sigma : along the vector, metres; None where the data say nothing
    """
    turning, sliding = vector[:3] / radius, vector[3:]
    slides = np.linalg.norm(vector[:3]) < np.linalg.norm(sliding)
    of_kind = None if sigma is None else sigma * float(np.linalg.norm(sliding if slides else turning))
    if slides:
        return Motion("slide", triple(upright(sliding)), triple(centre), of_kind)
    # The line that a turn with this translation at the centre leaves where it is.
    through = centre + np.cross(turning, sliding) / (turning @ turning)
    return Motion("roll", triple(upright(turning)), triple(through), of_kind)


def in_scene(covariance: Floats, rotation: Floats, radius: float) -> Floats:
    """A covariance (6, 6) of (rotation × radius, translation) as one of radians and metres, symmetric to the last bit.

    rotation : (3, 3) from the axes it is in to the scene's
    """
    turn = np.zeros((6, 6))
    turn[:3, :3], turn[3:, 3:] = rotation / radius, rotation
    found = turn @ covariance @ turn.T
    return np.asarray(0.5 * (found + found.T))


def upright(direction: Floats) -> Floats:
    """Unit length; the largest part positive, since an axis has no sign."""
    return np.asarray(direction / np.linalg.norm(direction) * np.sign(direction[np.argmax(np.abs(direction))]))


def triple(vector: Floats) -> tuple[float, float, float]:
    """Three plain floats."""
    return float(vector[0]), float(vector[1]), float(vector[2])
