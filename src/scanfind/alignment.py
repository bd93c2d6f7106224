"""Where a design lies in the frame of a scan, found from its elements themselves.

Each instance found, taken for each place that the design has for its model, says where the design lies. Most of them
are wrong: the right place is the one on which most instances agree. That they share is then fitted to all of them at
once. A design that lies equally well in two ways, such as a symmetric building, is refused rather than guessed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.elements import information_of, placements_of
from scanfind.errors import AlignmentError
from scanfind.pose import Pose, rotation_from_vector

if TYPE_CHECKING:
    from scanfind.detection import Detection
    from scanfind.model import Model

Floats = NDArray[np.float64]

# Elements agree that lie so near to their places, and are turned by less; beams that slid along themselves count.
AGREE_M, AGREE_RAD = 0.1, np.radians(5.0)
# Where one element says the design lies is off by what its own pose is off by, times how far away the others are.
FIRST_M, FIRST_RAD = 0.3, np.radians(1.5)
STEPS = 12  # of the fit, from there to AGREE_M; half as many at the end
# Two elements agree by chance; of three, each could still be off by what the others are.
LEAST = 3
# As much better as this (in elements, and as a share of those that agree) the best must be than the next.
BETTER_BY, BETTER_SHARE = 3, 0.1
HELD = 0.01  # see `refine.held`: of a motion fixed so many times as well as others on average half is believed
UPRIGHT = np.cos(np.radians(2.0))
WORTH = 0.5  # of the votes of the best: what has fewer comes no nearer to it than BETTER_SHARE
MOST_CLAIMS, MOST_TRIED, REFINED, BLOCK = 10_000, 1_000, 20, 1 << 20


@dataclass(frozen=True, eq=False)
class Alignment:
    """Where a design lies in the frame of the scans.

    covariance : (6, 6) of the error of `scene_from_design` in the scans' axes (rotation vector, translation of the
        pivot), rad and m, as of a Detection; from how far the elements are off one another, so that it holds what
        is built inexactly, too
    pivot : (3,) in the middle of the elements that agree, scan frame, metres
    agreeing, found : how many instances lie where it says, of how many
    rms_m : how far these are from where it says, root mean square of one coordinate, metres
    """

    scene_from_design: Pose
    covariance: Floats
    pivot: tuple[float, float, float]
    agreeing: int
    found: int
    rms_m: float

    @property
    def sigma_m(self) -> float:
        """How far the pivot may be off, root mean square, metres."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:])))

    @property
    def sigma_rad(self) -> float:
        """By what angle it may be turned, root mean square, radians."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3])))


class Claims(NamedTuple):
    """T times "this instance is the element at that place of the design".

    found, place : (T,) number of the instance, and of the place among all of the design
    rotation : (T, 3, 3) of scene_from_design, if it is so
    seen, drawn : (T, 3) a point of the instance in the scene, and where the design has it, metres
    radius : (T,) metres; fixed : (T, 6, 6) which motions (rotation × radius, translation) the scan fixes, 0 … 1 each
    """

    found: NDArray[np.intp]
    place: NDArray[np.intp]
    rotation: Floats
    seen: Floats
    drawn: Floats
    radius: Floats
    fixed: Floats

    def take(self, which: NDArray[np.intp]) -> Claims:
        """Some of them."""
        return Claims(
            self.found[which], self.place[which], self.rotation[which], self.seen[which], self.drawn[which],
            self.radius[which], self.fixed[which],
        )  # fmt: skip


class Fit(NamedTuple):
    """An alignment fitted to the claims that agree with it; see Alignment for what it says."""

    rotation: Floats
    translation: Floats
    agreeing: NDArray[np.intp]
    covariance: Floats
    pivot: Floats
    rms: float


def align(models: Sequence[Model], detections: Sequence[Detection], *, upright: bool = False) -> Alignment:
    """Where the design lies in which some models have their placements, by instances of them found anywhere.

    upright : up is the same in design and scan: what leans by more than 2° is not thought of

    Raises AlignmentError, one line, where fewer than three elements agree, or two alignments explain as much.
    """
    claims = claims_of(models, detections) if detections else None
    fits = distinct([fit(claims, *start) for start in starts(claims, upright=upright)], claims) if claims else []
    if not fits or len(fits[0].agreeing) < LEAST:
        most = len(fits[0].agreeing) if fits else 0
        msg = (
            f"the design cannot be aligned: of {len(detections)} instances found {most} agree on where it lies, and "
            f"{LEAST} must: search longer, give more of the design, or bring the scan into its frame"
        )
        raise AlignmentError(msg)
    best = fits[0]
    count = len(best.agreeing)
    for rival in fits[1:]:
        if count - len(rival.agreeing) < max(BETTER_BY, BETTER_SHARE * count):
            angle, far = apart(best, rival)
            msg = (
                f"the design can be aligned in two ways: {count} elements agree on one, {len(rival.agreeing)} on one "
                f"turned by {np.degrees(angle):.0f}° and {far:.1f} m away: give a part of it that is not alike, or "
                "bring the scan into its frame"
            )
            raise AlignmentError(msg)
    x, y, z = best.pivot.tolist()
    return Alignment(
        Pose(best.rotation, best.translation), best.covariance, (x, y, z), count, len(detections), best.rms
    )


def claims_of(models: Sequence[Model], detections: Sequence[Detection]) -> Claims:
    """Each instance with each place of its model, in each way round that looks the same; the most telling first.

    An instance of which there are few places tells more; of what tells least not all is taken.
    """
    by_name, first = {}, 0
    for model in models:
        by_name[model.name] = (model, first)
        first += len(placements_of(model))
    rows = []
    for number, found in enumerate(detections):
        model, first = by_name[found.model]
        radius = 0.5 * model.diameter
        pivot = found.scene_from_model.move(model.symmetry.centre[None])[0] if found.pivot is None else found.pivot
        seen = np.asarray(pivot, np.float64)
        own = found.scene_from_model.inverse().move(seen[None])
        fixed = believed(information_of(found, radius))
        places = [(first + k, each.design_from_model) for k, each in enumerate(placements_of(model))]
        turns = model.symmetry.motions()
        rows.append([
            (number, place, found.scene_from_model.rotation @ (design.rotation @ turn.rotation).T, seen,
             (design @ turn).move(own)[0], radius, fixed)
            for place, design in places for turn in turns
        ])  # fmt: skip
    taken: list[tuple[int, int, Floats, Floats, Floats, float, Floats]] = []
    for some in sorted(rows, key=len):
        if taken and len(taken) + len(some) > MOST_CLAIMS:
            break
        taken += some
    found_, place_, rotation, seens, drawn, radii, fixed_ = zip(*taken, strict=True)
    return Claims(
        np.array(found_), np.array(place_), np.array(rotation), np.array(seens), np.array(drawn), np.array(radii),
        np.array(fixed_),
    )  # fmt: skip


def believed(information: Floats) -> Floats:
    """Which motions (6, 6) data fix, 1 for well, 0 for not at all: as `refine.held` believes them."""
    values, motions = np.linalg.eigh(information)
    level = HELD * values.mean()
    share = values**2 / (values**2 + level**2) if level > 0.0 else np.zeros(6)
    return np.asarray((motions * share) @ motions.T)


def starts(claims: Claims, *, upright: bool) -> list[tuple[Floats, Floats]]:
    """Where claims say the design lies, (3, 3) and (3,), those first with which most instances agree roughly."""
    tried = np.arange(min(len(claims.found), MOST_TRIED))
    if upright:
        tried = tried[claims.rotation[tried, 2, 2] > UPRIGHT]
    votes = np.zeros(len(tried), np.int64)
    if not len(tried):
        return []
    # About their middles: far from zero the differences of what follows would lose their digits.
    drawn, seen = claims.drawn - claims.drawn.mean(axis=0), claims.seen - claims.seen.mean(axis=0)
    turns = claims.rotation.reshape(-1, 9)
    first = np.flatnonzero(np.diff(claims.found, prepend=-1))  # claims of one instance lie side by side
    step = max(1, BLOCK // len(claims.found))
    for begin in range(0, len(tried), step):
        some = tried[begin : begin + step]
        # The angle between what two claims say is told by the trace of their quotient.
        cosine = 0.5 * (turns[some] @ turns.T - 1.0)
        moved = (drawn @ claims.rotation[some].transpose(0, 2, 1)) + (
            seen[some] - np.einsum("aij,aj->ai", claims.rotation[some], drawn[some])
        )[:, None]
        gate = FIRST_M + FIRST_RAD * np.linalg.norm(seen[None] - seen[some, None], axis=2)
        agree = (cosine > np.cos(AGREE_RAD)) & (np.linalg.norm(moved - seen, axis=2) < gate)
        votes[begin : begin + step] = np.logical_or.reduceat(agree, first, axis=1).sum(axis=1)
    found: list[tuple[Floats, Floats]] = []
    for k in np.argsort(-votes, kind="stable"):
        if len(found) == REFINED or votes[k] < max(LEAST, WORTH * votes.max()):
            break
        rotation = claims.rotation[tried[k]]
        start = rotation, claims.seen[tried[k]] - rotation @ claims.drawn[tried[k]]
        if not any(_near(start, other, claims.drawn) for other in found):
            found.append(start)
    return found


def fit(claims: Claims, rotation: Floats, translation: Floats) -> Fit:
    """The alignment near a start that all claims which agree with it share, each instance and each place once.

    Gauss–Newton on (rotation × radius, translation) of each instance, along what the scan fixes of it, with weights
    that let those which are far off say little (Geman & McClure 1987).
    """
    gates = np.concatenate([np.geomspace(FIRST_M * 2.0, AGREE_M, STEPS), np.full(STEPS // 2, AGREE_M)])
    covariance, pivot, rms = np.zeros((6, 6)), translation, 0.0
    for gate in gates:
        off, agreeing = agreement(claims, rotation, translation, float(gate))
        if len(agreeing) < LEAST:
            break
        some = claims.take(agreeing)
        residual, pivot = off[agreeing], some.seen.mean(axis=0)
        squared = np.einsum("ti,tij,tj->t", residual, some.fixed, residual)
        directions = np.einsum("tii->t", some.fixed)
        scale = max(float(np.median(squared / np.maximum(directions, 1e-9))), 1e-8) * 2.2
        weight = 1.0 / (1.0 + squared / np.maximum(directions, 1e-9) / (9.0 * scale)) ** 2
        lever = jacobian(some, pivot)
        information = np.einsum("t,tki,tkl,tlj->ij", weight, lever, some.fixed, lever)
        gradient = np.einsum("t,tki,tkl,tl->i", weight, lever, some.fixed, residual)
        values, vectors = np.linalg.eigh(information)
        fixed = values > 1e-6 * values.max()
        inverse = (vectors[:, fixed] / values[fixed]) @ vectors[:, fixed].T
        step = inverse @ gradient
        turn = rotation_from_vector(step[:3])
        rotation, translation = turn @ rotation, turn @ (translation - pivot) + pivot + step[3:]
        left = residual - np.einsum("tij,j->ti", lever, step)
        total = float(weight @ np.einsum("ti,tij,tj->t", left, some.fixed, left))
        rms = float(np.sqrt(total / max(weight @ directions - 6.0, 1.0)))
        covariance = rms**2 * inverse
    _, agreeing = agreement(claims, rotation, translation, AGREE_M)
    return Fit(rotation, translation, agreeing, covariance, pivot, rms)


def agreement(claims: Claims, rotation: Floats, translation: Floats, gate: float) -> tuple[Floats, NDArray[np.intp]]:
    """How far claims are from an alignment, (T, 6), and which agree, best first: of each instance and place one."""
    quotient = claims.rotation @ rotation.T
    cosine = np.clip(0.5 * (np.einsum("tii->t", quotient) - 1.0), -1.0, 1.0)
    odd = 0.5 * np.stack([quotient[:, 2, 1] - quotient[:, 1, 2], quotient[:, 0, 2] - quotient[:, 2, 0],
                          quotient[:, 1, 0] - quotient[:, 0, 1]], axis=1)  # fmt: skip
    moved = claims.drawn @ rotation.T + translation
    # Within AGREE_RAD the sine is the angle to a thousandth.
    off = np.concatenate([odd * claims.radius[:, None], claims.seen - moved], axis=1)
    far = np.sqrt(np.einsum("ti,tij,tj->t", off, claims.fixed, off))
    near = np.flatnonzero((far < gate) & (cosine > np.cos(AGREE_RAD)))
    # What slid along itself is no nearer than it is.
    near = near[np.linalg.norm(off[near, 3:], axis=1) < 2.0 * claims.radius[near]]
    taken, found, places = [], set(), set()
    for number in near[np.argsort(far[near], kind="stable")].tolist():
        one, place = int(claims.found[number]), int(claims.place[number])
        if one not in found and place not in places:
            taken.append(number)
            found.add(one)
            places.add(place)
    return off, np.array(taken, np.intp)


def jacobian(claims: Claims, pivot: Floats) -> Floats:
    """(T, 6, 6): how a turn about the pivot and a shift, of the whole design, move each (rotation × radius, point)."""
    arms = claims.seen - pivot
    x, y, z = arms.T
    zero = np.zeros_like(x)
    found = np.zeros((len(arms), 6, 6))
    found[:, :3, :3] = claims.radius[:, None, None] * np.eye(3)
    cross = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)  # ω × arm = cross @ ω
    found[:, 3:, :3], found[:, 3:, 3:] = cross, np.eye(3)
    return found


def distinct(fits: Sequence[Fit], claims: Claims) -> list[Fit]:
    """The fits that are not one another's likes, those on which most agree first."""
    kept: list[Fit] = []
    for one in sorted(fits, key=lambda each: (-len(each.agreeing), each.rms)):
        if not any(_near(one[:2], other[:2], claims.drawn) for other in kept):
            kept.append(one)
    return kept


def apart(one: Fit, other: Fit) -> tuple[float, float]:
    """By what angle, radians, and how far at the first's pivot, metres, two alignments differ."""
    _, angle = Pose(one.rotation, one.translation).difference(Pose(other.rotation, other.translation))
    drawn = one.rotation.T @ (one.pivot - one.translation)
    return angle, float(np.linalg.norm(other.rotation @ drawn + other.translation - one.pivot))


def _near(one: tuple[Floats, Floats], other: tuple[Floats, Floats], drawn: Floats) -> bool:
    """Do two alignments put all points of a design (N, 3) to nearly the same places, and turn it nearly alike?"""
    moved = drawn @ (one[0] - other[0]).T + (one[1] - other[1])
    cosine = 0.5 * (float(np.sum(one[0] * other[0])) - 1.0)  # a line of joists turned about itself is in place, too
    return cosine > np.cos(AGREE_RAD) and bool(np.linalg.norm(moved, axis=1).max() < 2.0 * FIRST_M)
