"""The symmetries of a model, found or declared: axes are proposed, settled on the model itself, and measured.

Only directions on which the surface itself insists are tried: those of its plane faces, with what lies between and
across them; the principal ones of three tensors that no symmetry changes; and every direction across an axis found.
Of an icosahedron's group, and of orders other than `ORDERS` and their factors, that finds a part.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.library.onto_itself import OVERLAP_SAMPLES, OntoItself, about, any_across, unit
from scanfind.pose import Pose
from scanfind.symmetry import FREE, Axis, Symmetry, turn_about

Floats = NDArray[np.float64]

ORDERS = (2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 16, 20, 24)
# Every order has one of these as a factor; who turns by all of FREE_ORDERS has no holes to be told apart by.
PRIMES, FREE_ORDERS = (2, 3, 5, 7, 11), (7, 11, 5, 9, 8)
ALIKE = np.cos(np.radians(4.0))  # axes nearer than this are tried once


class Line(NamedTuple):
    """An axis of symmetry: unit direction (3,), a point on it (3,), order (FREE: every angle)."""

    direction: Floats
    point: Floats
    order: int


def find_symmetry(model: OntoItself) -> Symmetry:
    """All rotations that bring a model onto itself, as `OntoItself.is_symmetry` measures it."""
    lines: list[Line] = []
    for direction in _directions(model):
        if any(abs(direction @ line.direction) > ALIKE for line in lines):
            continue
        line = _line(model, direction, PRIMES)
        if line is not None:
            lines.append(line)
            if line.order == FREE:
                return group_of([line, *_across_free(model, line)], model.centre)
    if len(lines) == 1:
        lines += _across(model, lines[0])
    return group_of(lines, model.centre)


def _directions(model: OntoItself) -> Iterator[Floats]:
    """Unit directions (3,) an axis of symmetry may have, no two nearly alike."""
    arms = model.points - model.centre
    tried: list[Floats] = []
    tensors = [np.linalg.eigh(each.T @ each)[1].T for each in (np.cross(arms, model.normals), arms, model.normals)]
    facets = model.facets
    pairs = [each for a, b in combinations(facets, 2) for each in (a + b, a - b, np.cross(a, b))]
    corners = [a + s * b + t * c for a, b, c in combinations(facets[:3], 3) for s in (1, -1) for t in (1, -1)]
    for direction in [*np.eye(3), *facets, *np.concatenate(tensors), *pairs, *corners]:
        length = float(np.linalg.norm(direction))
        if length > 0.05 and all(abs(direction @ other) < ALIKE * length for other in tried):
            tried.append(unit(direction))
            yield tried[-1]


def _line(model: OntoItself, direction: Floats, orders: Sequence[int]) -> Line | None:
    """The axis of symmetry near a direction through the centre, if turns of one of these orders are symmetries."""
    for order in orders:
        turn = about(direction, model.centre, 2 * np.pi / order)
        if model.is_hopeless(turn):
            continue
        axis, point = axis_of(model.settled(turn), direction, model.centre)
        if abs(axis @ direction) > ALIKE and model.is_symmetry(about(axis, point, 2 * np.pi / order)):
            return Line(axis, point, _order(model, axis, point))
    return None


def _order(model: OntoItself, direction: Floats, point: Floats) -> int:
    """FREE, or the highest order of the turns about a line that are symmetries."""

    def turns(order: int) -> bool:
        return model.is_symmetry(about(direction, point, 2 * np.pi / order))

    if all(turns(order) for order in FREE_ORDERS):
        return FREE
    return next((order for order in reversed(ORDERS) if turns(order)), 1)


def _across_free(model: OntoItself, line: Line) -> list[Line]:
    """Beside an axis of revolution: another one (a sphere), or half turns about any line across it."""
    across = _line(model, any_across(line.direction), (11, 2))
    return [] if across is None else [across]


def _across(model: OntoItself, line: Line) -> list[Line]:
    """Half turns about lines across the only axis found: round parts do not say where these are, so all are tried.

    With half turns an n-fold axis has n lines across it at equal angles: one lies in the first π/n.
    """
    start = any_across(line.direction)
    width = np.pi / line.order
    # As close as lets no sample come farther than a spacing from where it belongs.
    steps = int(np.ceil(width * model.radius / model.spacing))
    tried = [turn_about(line.direction, width * k / steps) @ start for k in range(steps)]
    off = [model.off(about(u, model.centre, np.pi), OVERLAP_SAMPLES).mean() for u in tried]
    across = _line(model, tried[int(np.argmin(off))], (2,))
    return [] if across is None else [across]


def declared_symmetry(model: OntoItself, axes: tuple[Axis, ...]) -> Symmetry:
    """A symmetry somebody vouches for, about the point where the surface comes nearest to having it.

    Tried are the middle of the surface, of its box, and the model's origin.
    """
    box = 0.5 * (model.points.min(axis=0) + model.points.max(axis=0))

    def off(symmetry: Symmetry) -> float:
        return float(np.mean([model.off(motion, OVERLAP_SAMPLES).mean() for motion in symmetry.motions()]))

    return min((Symmetry(centre, axes) for centre in (model.centre, box, np.zeros(3))), key=off)


def axis_of(motion: Pose, direction: Floats, near: Floats) -> tuple[Floats, Floats]:
    """The line about which a motion turns: unit direction, the way `direction` points; its point nearest to `near`."""
    values, vectors = np.linalg.eig(motion.rotation)
    axis: Floats = vectors[:, int(np.argmin(np.abs(values - 1.0)))].real
    axis = axis / np.linalg.norm(axis) * (1.0 if axis @ direction >= 0.0 else -1.0)
    aside = motion.move(near[None])[0] - near
    aside -= (aside @ axis) * axis
    return axis, near + np.linalg.lstsq(np.eye(3) - motion.rotation, aside, rcond=1e-6)[0]


def group_of(lines: Sequence[Line], centre: Floats) -> Symmetry:
    """The group that lines of symmetry make, each put where the others say it must be exactly.

    centre : the point of them all that is nearest to this one
    """
    if not lines:
        return Symmetry(centre)
    # Of lines that do not quite meet the point nearest to all; along a single one, the point nearest to `centre`.
    across = [np.eye(3) - np.outer(line.direction, line.direction) for line in lines]
    wanted = [each @ (line.point - centre) for each, line in zip(across, lines, strict=True)]
    meets = centre + np.linalg.lstsq(np.concatenate(across), np.concatenate(wanted), rcond=1e-3)[0]
    # FREE is the highest order of all.
    ranked = sorted(lines, key=lambda line: line.order or np.inf, reverse=True)
    main, others = ranked[0], ranked[1:]
    if any(line.order == FREE for line in others):
        return Symmetry(meets, tuple(Axis(triple(axis), FREE) for axis in np.eye(3)))
    z = main.direction
    # Of what nearly is a group (a ball of flat faces) only what is one: across an axis 2-fold ones or, of a cube, its
    # likes. To have too little does no harm.
    fitting = [line for line in others if line.order == 2 or line.order == main.order == 4]
    square = [line for line in fitting if abs(line.direction @ z) < 0.1]
    threes = [line for line in others if line.order == main.order == 3]
    if square:
        x = unit(square[0].direction - (square[0].direction @ z) * z)
        axes = [(z, main.order), (x, square[0].order)]
        if main.order == square[0].order:  # a box has three, and so has a cube
            axes.append((np.cross(z, x), main.order))
    elif threes:  # of a tetrahedron; between two corners lies a 2-fold axis, and from it to a corner it is acos √⅓
        other = -threes[0].direction * np.sign(threes[0].direction @ z)
        x, aside = unit(z + other), unit(z - other)
        axes = [(np.sqrt(1 / 3) * x + np.sqrt(2 / 3) * aside, 3), (x, 2)]
    else:
        axes = [(z, main.order)]
    return Symmetry(meets, tuple(Axis(triple(direction), order) for direction, order in axes))


def triple(vector: Floats) -> tuple[float, float, float]:
    """Three plain floats, the largest positive, since an axis has no sign."""
    x, y, z = (vector * np.sign(vector[int(np.argmax(np.abs(vector)))])).tolist()
    return x, y, z
