"""Which dimensions a drawing of some features would give, and what each is of where the features are."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import combinations
from math import cos, radians
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.detection import ANGLE, FACE, LINEAR, PLACE, RADIUS
from scanfind.dimensions.features import FLANGE, PIPE, SIDE, Feature
from scanfind.dimensions.fits import State

Floats = NDArray[np.float64]

PARALLEL = cos(radians(0.5))  # as designed
SQUARE = radians(0.5)
COPLANAR_M = 1e-3
ALL_PAIRS = 3  # flanges: of more, each is held against the first
MOST_ANGLES = 4  # pipes between which angles are given


class Wanted(NamedTuple):
    """A dimension: its name, kind, the features it is of, by number, and what it is of their states.

    by_pose : it is measured from the design's place, so that the pose's uncertainty is its own too
    rim : features of which the place of the centre counts: without it it cannot be told
    """

    name: str
    kind: str
    of: tuple[int, ...]
    value: Callable[..., float]
    by_pose: bool = False
    rim: tuple[int, ...] = ()


def wanted_of(features: Sequence[Feature]) -> list[Wanted]:
    """The dimensions of a model with these features."""
    flanges = [k for k, each in enumerate(features) if each.kind == FLANGE]
    pipes = [k for k, each in enumerate(features) if each.kind == PIPE]
    sides = [k for k, each in enumerate(features) if each.kind == SIDE]
    pairs = list(combinations(flanges, 2))
    if len(flanges) > ALL_PAIRS:
        pairs = [(flanges[0], other) for other in flanges[1:]]
    told = [one for a, b in pairs for one in between_flanges(features, a, b)]
    for k in flanges:
        told += of_flange(features[k], k)
    for k in pipes:
        told += of_pipe(features[k], k)
    if len(flanges) < 2:
        told += between_pipes(features, pipes[:MOST_ANGLES])
    return [*told, *between_sides(features, sides)]


def of_flange(flange: Feature, k: int) -> Iterator[Wanted]:
    """Where a flange's face is, and how it looks."""
    # A plain end has no rim: where it is aside, its pipe tells.
    if flange.has_rim:
        yield Wanted(f"{flange.name} centre, off the design", PLACE, (k,), off(flange.centre), True, (k,))
    leans = tilt(flange.axis, 2.0 * flange.radius)
    yield Wanted(f"{flange.name} face, tilt across its diameter", FACE, (k,), leans, by_pose=True)


def of_pipe(pipe: Feature, k: int) -> Iterator[Wanted]:
    """How thick a pipe is, and where its axis runs."""
    yield Wanted(f"{pipe.name} radius", RADIUS, (k,), lambda state: state.radius)
    yield Wanted(f"{pipe.name} axis, off the design", PLACE, (k,), ends_off(pipe), by_pose=True)


def between_flanges(features: Sequence[Feature], a: int, b: int) -> Iterator[Wanted]:
    """Face to face, or face to centre, and the angle between two flanges."""
    one, other = features[a], features[b]
    names = f"{one.name} – {other.name}"
    cosine = float(one.axis @ other.axis)
    if abs(cosine) > PARALLEL and abs(float((other.centre - one.centre) @ one.axis)) < COPLANAR_M:
        return
    if abs(cosine) > PARALLEL:
        yield Wanted(f"{names}, face to face", LINEAR, (a, b), face_to_face)
        yield Wanted(f"{names}, out of parallel", ANGLE, (a, b), out_of_parallel)
        return
    if abs(cosine) < np.sin(SQUARE):
        if other.has_rim:
            yield Wanted(f"{one.name} face – {other.name} centre", LINEAR, (a, b), face_to_centre, rim=(b,))
        if one.has_rim:
            yield Wanted(f"{other.name} face – {one.name} centre", LINEAR, (b, a), face_to_centre, rim=(a,))
    elif one.has_rim and other.has_rim:
        yield Wanted(f"{names}, centre to centre", LINEAR, (a, b), centre_to_centre, rim=(a, b))
    yield Wanted(f"{names}, angle", ANGLE, (a, b), angle)


def between_pipes(features: Sequence[Feature], pipes: Sequence[int]) -> Iterator[Wanted]:
    """The angles between pipes that are not parallel."""
    for a, b in combinations(pipes, 2):
        if abs(float(features[a].axis @ features[b].axis)) < PARALLEL:
            yield Wanted(f"{features[a].name} – {features[b].name}, angle", ANGLE, (a, b), angle)


def between_sides(features: Sequence[Feature], sides: Sequence[int]) -> Iterator[Wanted]:
    """The extents between opposite sides, and how square these are to one another."""
    pairs = [(a, b) for a, b in zip(sides[::2], sides[1::2], strict=True)]
    for a, b in pairs:
        # From the larger one: the other may be the end of a single bar, and askew.
        datum, other = sorted((a, b), key=lambda k: -features[k].surfaces[0].width)
        yield Wanted(features[a].name.partition(" side")[0], LINEAR, (datum, other), face_to_centre)
    for (a, _), (b, _) in combinations(pairs, 2):
        what = f"{features[a].name} – {features[b].name}"
        yield Wanted(f"{what}, angle", ANGLE, (a, b), angle)


def off(point: Floats) -> Callable[[State], float]:
    """How far a centre is from a point (3,), metres."""
    return lambda state: float(np.linalg.norm(state.centre - point))


def tilt(axis: Floats, width: float) -> Callable[[State], float]:
    """By how much a face leans from a direction (3,), across a width, metres."""
    return lambda state: width * between(axis, state.axis)


def ends_off(pipe: Feature) -> Callable[[State], float]:
    """How far an axis passes from the ends of the designed one, at the end where it is farther, metres."""
    ends = [pipe.centre - pipe.half * pipe.axis, pipe.centre + pipe.half * pipe.axis]
    return lambda state: max(float(np.linalg.norm(np.cross(end - state.centre, state.axis))) for end in ends)


def face_to_face(one: State, other: State) -> float:
    """How far two parallel faces are apart, along what is square to both."""
    sign = 1.0 if float(one.axis @ other.axis) > 0 else -1.0
    normal = one.axis + sign * other.axis
    return abs(float((other.centre - one.centre) @ normal)) / float(np.linalg.norm(normal))


def face_to_centre(one: State, other: State) -> float:
    """How far the centre of one is from the face of the other."""
    return abs(float((other.centre - one.centre) @ one.axis))


def centre_to_centre(one: State, other: State) -> float:
    """How far two centres are apart."""
    return float(np.linalg.norm(other.centre - one.centre))


def out_of_parallel(one: State, other: State) -> float:
    """The angle by which two axes are not parallel."""
    turn = between(one.axis, other.axis)
    return min(turn, np.pi - turn)


def angle(one: State, other: State) -> float:
    """The angle between two axes."""
    return between(one.axis, other.axis)


def between(one: Floats, other: Floats) -> float:
    """The angle between two unit directions; by atan2, since arccos has no digits near 0 and 180°."""
    return float(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other))
