"""What a model could be taken for: motions after which much of it lies on itself, though it is not where it was.

The paper's box frame, turned over, still covers nine tenths of itself. Such poses are the ones a search is most likely
to take for the right one; they are tried against the best pose before it is believed. True symmetries are none of them:
no scan can tell these apart.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations, product
from math import ceil
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.library.onto_itself import OVERLAP_SAMPLES, OntoItself, any_across, unit
from scanfind.pose import Pose
from scanfind.symmetry import Symmetry, pose_error

Floats = NDArray[np.float64]

# Below this a motion leads to another pose altogether, which the search would find by itself.
LEAST_OVERLAP = 0.35
MOST_SIMILAR = 12
SQUARE = np.cos(np.radians(4.0))  # faces turned less than this off the model's axes propose the same turns
# Motions that differ by less than this share of the diameter lead to one pose: ICP draws them together.
ALIKE = 1.0 / 15.0
# The table of shifts: samples paired, its cell in spacings of these, and most cells to either side of none.
SHIFT_SAMPLES, SHIFT_CELL, SHIFT_CELLS = 1500, 2.0, 50
MOST_SHIFTS = 20
PEAK = 0.05  # cells with less than this share of what the fullest holds are no peaks
# After a turn: samples paired, shifts tried, and the least overlap (with less, each spool had five more, none of which
# is a pose that anything was taken for); samples that show what is hopeless.
TURNED_SAMPLES, MOST_TURNED, LEAST_TURNED, TURNED_DIP = 800, 6, 0.5, 0.93
FEW = 60
# A repetition: so many spacings to either side of it, the model lies on itself clearly less.
SHIFT_FLANK, SHIFT_DIP = 4.0, 0.9


class Similar(NamedTuple):
    """A motion model_from_model that is no symmetry, and the share of the model's samples it brings onto samples."""

    overlap: float
    motion: Pose


def find_similar(model: OntoItself, symmetry: Symmetry) -> tuple[Similar, ...]:
    """Motions that bring at least `LEAST_OVERLAP` of the samples onto samples and are no symmetry, best first.

    Tried are the turns of a cube about the middle of the model's box, along its own axes, its largest plane faces and
    its principal axes; the shifts by which the model repeats itself (the bays of a rack); and both together.
    """
    kept = [Similar(1.0, Pose.identity())]

    def is_new(motion: Pose) -> bool:
        return all(_differ(model, motion, other.motion, symmetry) for other in kept)

    motions = list(_shifted(model))
    for axes in _drawn_along(model):
        motions += _turned_and_shifted(model, axes)
    motions += _turned(model, _principal(model))
    proposed = [Similar(model.overlap(motion), motion) for motion in motions]
    for rough in sorted(proposed, key=lambda each: -each.overlap):
        if rough.overlap >= LEAST_OVERLAP and is_new(rough.motion):
            motion = model.settled(rough.motion)
            if is_new(motion):
                kept.append(Similar(model.overlap(motion), motion))
    best = sorted(kept[1:], key=lambda each: -each.overlap)
    return tuple(each for each in best if each.overlap >= LEAST_OVERLAP)[:MOST_SIMILAR]


def _differ(model: OntoItself, one: Pose, other: Pose, symmetry: Symmetry) -> bool:
    error = pose_error(one, other, symmetry)
    return error.translation_m + model.radius * error.rotation_rad > ALIKE * model.diameter


def _turned(model: OntoItself, axes: Floats) -> Iterator[Pose]:
    """Turns of a cube along axes (3, 3), as rows, about the middle of the model's box along these."""
    along = model.points @ axes.T
    middle = 0.5 * (along.min(axis=0) + along.max(axis=0)) @ axes
    for turn in cube_turns()[1:]:
        rotation = axes.T @ turn @ axes
        yield Pose(rotation, middle - rotation @ middle)


def _drawn_along(model: OntoItself) -> list[Floats]:
    """The model's own axes, and those of its largest plane faces where these are others: (3, 3) each, as rows."""
    faced = _faced(model)
    square = (np.abs(faced) > SQUARE).any(axis=1).all()  # to the model's own axes
    return [np.eye(3)] if square else [np.eye(3), faced]


def _principal(model: OntoItself) -> Floats:
    """The principal axes, (3, 3), as rows."""
    axes = np.linalg.svd(model.points - model.centre, full_matrices=False)[2]
    axes[2] = np.cross(axes[0], axes[1])
    return np.asarray(axes)


def _faced(model: OntoItself) -> Floats:
    """Axes (3, 3), as rows, along the largest plane faces; the coordinate axes where there are none."""
    facets = model.facets
    if not facets:
        return np.eye(3)
    beside = next((b for b in facets[1:] if abs(b @ facets[0]) < 0.1), any_across(facets[0]))
    beside = unit(beside - (beside @ facets[0]) * facets[0])
    return np.array([facets[0], beside, np.cross(facets[0], beside)])


def _shifted(model: OntoItself) -> Iterator[Pose]:
    """Shifts at which the model lies on itself clearly better than a little farther or nearer, and no worse than a
    little aside: a beam slides along itself as well, and no place there is better than the next.
    """
    step = SHIFT_FLANK * model.spacing
    far = max(ALIKE * model.diameter, 2.0 * step)
    shifts = _shifts(model, np.eye(3), np.eye(3), SHIFT_SAMPLES)
    for shift in shifts[np.linalg.norm(shifts, axis=1) > far][:MOST_SHIFTS]:
        here = model.overlap(shifted(shift))
        if here < LEAST_OVERLAP:
            continue
        ends = [model.overlap(shifted(shift + side * step * unit(shift))) for side in (-1, 1)]
        if max(ends) < SHIFT_DIP * here and all(each <= here for each in _aside(model, shifted(shift), np.eye(3))):
            yield shifted(shift)
            yield shifted(-shift)


def _turned_and_shifted(model: OntoItself, axes: Floats) -> Iterator[Pose]:
    """Turns of a cube along axes (3, 3), as rows, about the middle of the box, and with shifts after which the model
    lies on itself clearly better than a little aside: a header turned end for end has its branches elsewhere, and lies
    on itself where these do as well as where its ends do.
    """
    for turned in _turned(model, axes):
        yield turned
        rotation = turned.rotation
        if not _fits(model, axes, rotation):
            continue
        for shift in _shifts(model, axes, axes @ rotation @ axes.T, TURNED_SAMPLES)[:MOST_TURNED]:
            motion = Pose(rotation, model.centre + shift - rotation @ model.centre)
            off = float(np.linalg.norm(motion.translation - turned.translation))
            # Most are hopeless, which few samples show before it is fitted.
            if off < 0.5 * ALIKE * model.diameter or model.overlap(motion, FEW) < 0.7 * LEAST_TURNED:
                continue
            motion = model.settled(motion)
            if (here := model.overlap(motion)) < LEAST_TURNED:
                continue
            if all(each < TURNED_DIP * here for each in _aside(model, motion, axes)):
                yield motion


def _fits(model: OntoItself, axes: Floats, rotation: Floats) -> bool:
    """Can enough of the model, turned, lie within the box along axes (3, 3) of what it was, wherever it is shifted to?
    A wall across itself cannot, and most of what is tried is of this kind.
    """
    moved = np.sort(model.points[:OVERLAP_SAMPLES] @ rotation.T @ axes.T, axis=0)
    asked = ceil(LEAST_TURNED * len(moved))
    room = np.ptp(model.points @ axes.T, axis=0) + 4.0 * model.spacing  # that much off they lie on samples yet
    taken = (moved[asked - 1 :] - moved[: len(moved) - asked + 1]).min(axis=0)
    return bool((taken <= room).all())


def _aside(model: OntoItself, motion: Pose, axes: Floats) -> Iterator[float]:
    """How much of the model lies on itself a little to either side of a motion, along axes (3, 3), as rows."""
    step = SHIFT_FLANK * model.spacing
    return (model.overlap(shifted(side * step * axis) @ motion) for axis in axes for side in (-1, 1))


def _shifts(model: OntoItself, axes: Floats, turn: Floats, most: int) -> Floats:
    """The likeliest after a turn along axes (3, 3), about the model's middle, (K, 3), best first: peaks of how often
    each shift leads from a sample to one of like normal.

    turn : along the axes; most : samples paired
    """
    from scanfind.kernels.overlap import count_shifts

    count = min(most, len(model.points))
    onto, facing = (model.points[:count] - model.centre) @ axes.T, model.normals[:count] @ axes.T
    points, normals = onto @ turn.T, facing @ turn.T
    farthest = np.maximum(onto.max(axis=0) - points.min(axis=0), points.max(axis=0) - onto.min(axis=0))
    cell = max(SHIFT_CELL * model.spacing * np.sqrt(len(model.points) / count), farthest.max() / SHIFT_CELLS)
    reach = np.ceil(farthest / cell).astype(np.int64) + 1
    table = np.zeros(2 * (reach + 1) + 1, np.int32)  # and a border, for peaks
    count_shifts(points, normals, onto, facing, model.signed, 1.0 / cell, reach + 1, table)
    return np.asarray((peaks_of(table, PEAK) - reach - 1) * cell @ axes)


def peaks_of(table: NDArray[np.int32], least: float) -> NDArray[np.intp]:
    """The cells (K, 3) of a table with an empty border that no neighbour exceeds, the fullest first; of those that hold
    at least that share of what the fullest does.
    """
    at = np.argwhere(table >= max(least * table.max(), 1))
    here = table[tuple(at.T)]
    highest = here.copy()
    for step in product((-1, 0, 1), repeat=3):
        np.maximum(highest, table[tuple((at + step).T)], out=highest)
    at, here = at[here == highest], here[here == highest]
    return np.asarray(at[np.argsort(-here, kind="stable")])


def shifted(shift: Floats) -> Pose:
    """The motion by (3,) without a turn."""
    return Pose(np.eye(3), np.asarray(shift))


def cube_turns() -> list[Floats]:
    """The 24 rotations (3, 3) that map the coordinate axes onto each other."""
    turns = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        turn = np.zeros((3, 3))
        turn[np.arange(3), order] = signs
        if np.linalg.det(turn) > 0:
            turns.append(turn)
    return turns
