"""Where a design lies in the frame of a scan, found from its elements themselves.

Each instance found, taken for each place that the design has for its model, says where the design may lie. Most say
wrong: of one steel section every piece looks like part of every longer one. So each is asked how much of the whole
design would then lie on the scan, and the one that explains the most elements holds. A design that lies equally well
in two ways, such as a symmetric building, is refused rather than guessed. What the elements then found in their places
share is fitted to all of them at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.design.elements import information_of, placements_of
from scanfind.errors import AlignmentError
from scanfind.fit.refine import believed
from scanfind.pose import Pose, rotation_from_vector

if TYPE_CHECKING:
    from scanfind.design.thinned import Thinned
    from scanfind.detection import Detection
    from scanfind.library.model import Model

Floats = NDArray[np.float64]

CELL_M = 0.08  # of the thinned scan: a design that lies so well on it has its elements found in their places
SAMPLES, FEW = 40, 8  # of an element's surface, evenly over it; to begin with
ACROSS_M = 0.03  # from the design's surface: what lies flat on a floor has only its underside there
EXPLAINED = 0.5  # of its samples on the scan: others may hide the rest
GATES_M = np.geomspace(0.16, 0.08, 12)  # how far from the design the scan may be that it is drawn to, step by step
# Two elements lie somewhere by chance; of three, each could still be off by what the others are.
LEAST = 3
# By so many elements, and by such a share of those it explains, the best must be better than the next.
BETTER_BY, BETTER_SHARE = 2, 0.1
WORTH = 0.6  # of what the best explains to begin with: what explains less comes no nearer to it than that
MOST_CLAIMS, MOST_TRIED, REFINED = 10_000, 1_000, 12
UPRIGHT = np.cos(np.radians(2.0))
# Elements agree that lie so near to their places, and are turned by less; beams that slid along themselves count.
FIRST_M, AGREE_M, AGREE_RAD = 0.3, 0.1, np.radians(5.0)
STEPS = 12  # of the fit, from FIRST_M to AGREE_M; half as many at the end


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


class Drawn(NamedTuple):
    """The surface of a design: points and normals (S, 3), evenly over each element; of which element each is, (S,)."""

    points: Floats
    normals: Floats
    element: NDArray[np.intp]


class Lying(NamedTuple):
    """A place of the design in the scan, and how many elements lie on the scan then."""

    pose: Pose
    explained: int


def lies_at(models: Sequence[Model], detections: Sequence[Detection], scan: Thinned, *, upright: bool = False) -> Pose:
    """scene_from_design, to a few centimetres, of a design whose models have their placements.

    detections : instances of some of the models, found anywhere
    upright : up is the same in design and scan: what leans by more than 2° is not thought of

    Raises AlignmentError, one line, where fewer than three elements lie on the scan, or two ways explain as many.
    """
    found = lyings(models, detections, scan, upright=upright)
    if not found or found[0].explained < LEAST:
        msg = (
            f"the design cannot be aligned: wherever the {len(detections)} instances found put it, at most "
            f"{found[0].explained if found else 0} elements lie on the scan, and {LEAST} must: search longer, or bring "
            "the scan into its frame"
        )
        raise AlignmentError(msg)
    best = found[0]
    for rival in found[1:]:
        if best.explained - rival.explained < max(BETTER_BY, BETTER_SHARE * best.explained):
            _, angle = best.pose.difference(rival.pose)
            msg = (
                f"the design can be aligned in two ways: {best.explained} elements lie on the scan in one, "
                f"{rival.explained} in one turned by {np.degrees(angle):.0f}° against it: give more of the design, "
                "or bring the scan into its frame"
            )
            raise AlignmentError(msg)
    return best.pose


def lyings(models: Sequence[Model], detections: Sequence[Detection], scan: Thinned, *, upright: bool) -> list[Lying]:
    """The places of the design that instances tell of, drawn onto the scan, those that explain most first."""
    if not detections:
        return []
    claims, drawn = claims_of(models, detections), drawn_of(models)
    first = np.arange(len(drawn.element)) % SAMPLES < FEW
    few = Drawn(drawn.points[first], drawn.normals[first], drawn.element[first])
    tried = np.arange(min(len(claims.found), MOST_TRIED))
    if upright:
        tried = tried[claims.rotation[tried, 2, 2] > UPRIGHT]
    starts = [
        Pose(rotation, seen - rotation @ place)
        for rotation, seen, place in zip(claims.rotation[tried], claims.seen[tried], claims.drawn[tried], strict=True)
    ]
    counts = np.array([explained(few, scan, start) for start in starts], np.int64)
    kept: list[Lying] = []
    for k in np.argsort(-counts, kind="stable"):
        if len(kept) == REFINED or counts[k] < WORTH * counts.max():
            break
        if not any(_near(starts[k], one.pose, drawn.points) for one in kept):
            pose = settled(drawn, scan, starts[k])
            kept.append(Lying(pose, explained(drawn, scan, pose, ACROSS_M)))
    kept.sort(key=lambda one: -one.explained)
    apart: list[Lying] = []
    for one in kept:
        if not any(_near(one.pose, other.pose, drawn.points) for other in apart):
            apart.append(one)
    return apart


def drawn_of(models: Sequence[Model]) -> Drawn:
    """The surface of all elements; SAMPLES of each, fewer of models that have no more."""
    points, normals, element, number = [], [], [], 0
    for model in models:
        some = np.resize(np.arange(min(SAMPLES, len(model.samples))), SAMPLES)
        for place in placements_of(model):
            points.append(place.design_from_model.move(model.samples.points[some]))
            normals.append(place.design_from_model.turn(model.samples.normals[some]))
            element.append(np.full(SAMPLES, number))
            number += 1
    return Drawn(np.concatenate(points), np.concatenate(normals), np.concatenate(element))


def explained(drawn: Drawn, scan: Thinned, pose: Pose, within: float = np.inf) -> int:
    """How many elements lie on the scan, by half of their surface or more; `within` metres across that surface."""
    at = pose.move(drawn.points)
    distance, which = scan.nearest(at)
    across = np.abs(np.einsum("si,si->s", scan.means[which] - at, pose.turn(drawn.normals)))
    on = np.bincount(drawn.element, (distance < scan.cell) & (across < within))
    return int((on >= EXPLAINED * np.bincount(drawn.element)).sum())


def settled(drawn: Drawn, scan: Thinned, pose: Pose) -> Pose:
    """A place of the design drawn onto the scan: ICP, point to the plane of the design, with Tukey's weights."""
    for gate in GATES_M:
        at, normals = pose.move(drawn.points), pose.turn(drawn.normals)
        distance, which = scan.nearest(at)
        near = distance < gate
        if near.sum() < 6:
            return pose
        middle = at[near].mean(axis=0)
        off = np.einsum("si,si->s", scan.means[which[near]] - at[near], normals[near])
        weight = (1.0 - np.minimum(np.abs(off) / gate, 1.0) ** 2) ** 2
        rows = np.concatenate([np.cross(at[near] - middle, normals[near]), normals[near]], axis=1)
        step = np.linalg.lstsq((rows * weight[:, None]).T @ rows, (rows * weight[:, None]).T @ off, rcond=1e-9)[0]
        turn = rotation_from_vector(step[:3])
        pose = Pose(turn, middle - turn @ middle + step[3:]) @ pose
    return pose


def fitted(models: Sequence[Model], detections: Sequence[Detection], start: Pose) -> Alignment:
    """The alignment that all instances which agree with it share, each of them and each place of the design once.

    start : scene_from_design, to a few centimetres

    Gauss–Newton on (rotation × radius, translation) of each instance, along what the scan fixes of it, with weights
    that let those which are far off say little (Geman & McClure 1987). Raises AlignmentError for fewer than three.
    """
    rotation, translation = start.rotation, start.translation
    claims = claims_of(models, detections) if detections else None
    for gate in (*np.geomspace(FIRST_M, AGREE_M, STEPS), *[AGREE_M] * (STEPS // 2)):
        off, agreeing = (np.empty(0), np.empty(0, np.intp))
        if claims is not None:
            off, agreeing = agreement(claims, rotation, translation, gate)
        if claims is None or len(agreeing) < LEAST:
            msg = (
                f"the design cannot be aligned: {len(agreeing)} of {len(detections)} instances found agree on where it "
                f"lies, and {LEAST} must: search longer, give more of the design, or bring the scan into its frame"
            )
            raise AlignmentError(msg)
        some, residual = claims.take(agreeing), off[agreeing]
        pivot = some.seen.mean(axis=0)
        # Of each, per motion that the scan fixes.
        motions = np.maximum(np.einsum("tii->t", some.fixed), 1e-9)
        squared = np.einsum("ti,tij,tj->t", residual, some.fixed, residual) / motions
        weight = 1.0 / (1.0 + squared / (20.0 * max(float(np.median(squared)), 1e-9))) ** 2
        lever = jacobian(some, pivot)
        information = np.einsum("t,tki,tkl,tlj->ij", weight, lever, some.fixed, lever)
        values, vectors = np.linalg.eigh(information)
        fixed = values > 1e-6 * values.max()
        inverse = (vectors[:, fixed] / values[fixed]) @ vectors[:, fixed].T
        step = inverse @ np.einsum("t,tki,tkl,tl->i", weight, lever, some.fixed, residual)
        turn = rotation_from_vector(step[:3])
        rotation, translation = turn @ rotation, turn @ (translation - pivot) + pivot + step[3:]
        left = residual - np.einsum("tij,j->ti", lever, step)
        total = float(weight @ np.einsum("ti,tij,tj->t", left, some.fixed, left))
        rms = float(np.sqrt(total / max(weight @ motions - 6.0, 1.0)))
    x, y, z = pivot.tolist()
    return Alignment(Pose(rotation, translation), rms**2 * inverse, (x, y, z), len(agreeing), len(detections), rms)


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


def _near(one: Pose, other: Pose, drawn: Floats) -> bool:
    """Do two places put all points of a design (N, 3) to nearly the same spots, and turn it nearly alike?"""
    # A line of joists turned about itself is in place, too.
    _, angle = one.difference(other)
    moved = np.linalg.norm(one.move(drawn) - other.move(drawn), axis=1)
    return angle < AGREE_RAD and float(moved.max()) < FIRST_M
