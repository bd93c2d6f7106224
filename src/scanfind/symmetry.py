"""Rigid motions that map a model onto itself, and how far apart two poses are when those do not count.

A symmetry is a group of proper rotations about one centre: a mirror image is another part. It is kept as the axes that
make it, each with its order; a free axis (a pipe's own) has every angle, and two free axes make a sphere.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.errors import UsageError
from scanfind.pose import Pose, rotation_from_vector

Floats = NDArray[np.float64]

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
FREE = 0  # the order of an axis of revolution
LARGEST_ORDER = 60
SAME = 1e-6  # rotations whose matrices differ by less are one; those of a group differ by more than 0.1
PARALLEL = 1e-6  # directions whose cross product is shorter are one
OWN_AXIS = np.cos(np.radians(0.5))  # nearer to a coordinate axis than this and an axis is called by its name
# Of poses that look the same the one nearest to a reference is reported. It leads to the pose as drawn but is not it:
# parts stand square to the axes, or upside down, and are then as far from it one way round as the other. It leans by
# half a radian across the axis of the highest order, and rolls about it by less than half the pitch of LARGEST_ORDER.
LEANING = rotation_from_vector([0.3, 0.2, 0.35])
ROLLED = 0.04
ASKEW = np.array([0.61, 0.43, 0.27])  # along no axis that a part is likely to have, and across none
ROLLS = 24  # a free axis in steps; half of one moves the end of a diameter by a fifteenth of it


class Axis(NamedTuple):
    """A unit direction, and the order of the turns about it: order n is 2π/n, FREE is every angle."""

    direction: tuple[float, float, float]
    order: int


class PoseError(NamedTuple):
    """How far a pose is from the truth: of the symmetry's centre in metres, and of the rotation in radians."""

    translation_m: float
    rotation_rad: float


@dataclass(frozen=True, eq=False)
class Symmetry:
    """The rotations about `centre` (3,), model frame, metres, that map a model onto itself.

    axes : they make the group: all their turns in any succession; empty where only standing still does. A free axis
        goes with 2-fold ones across it; two free axes mean every rotation.

    Raises UsageError for an order that is neither FREE nor 2 to 60, or axes that make no finite group.
    """

    centre: Floats
    axes: tuple[Axis, ...] = ()

    def __post_init__(self) -> None:
        if any(axis.order != FREE and not 2 <= axis.order <= LARGEST_ORDER for axis in self.axes):
            msg = f"the order of a symmetry's axis must be 2 to {LARGEST_ORDER}, got {[a.order for a in self.axes]}"
            raise UsageError(msg)
        free = self.free
        if len(free) == 1 and any(a.order > 2 or abs(free[0] @ a.direction) > 1e-3 for a in self.axes if a.order):
            msg = "beside a free axis there can only be 2-fold ones across it; a sphere has two free axes"
            raise UsageError(msg)
        _ = self.turns  # raises where the axes do not make a group

    @cached_property
    def free(self) -> Floats:
        """The free axes, (0, 3), (1, 3) or, for a sphere, (2, 3) and more."""
        return np.array([axis.direction for axis in self.axes if axis.order == FREE]).reshape(-1, 3)

    @property
    def sphere(self) -> bool:
        """Every rotation about the centre."""
        return any(np.linalg.norm(np.cross(a, b)) > PARALLEL for a, b in combinations(self.free, 2))

    @cached_property
    def turns(self) -> Floats:
        """The rotations (G, 3, 3) made by the axes of finite order, the first of them none."""
        generators = [turn_about(axis.direction, 2 * np.pi / axis.order) for axis in self.axes if axis.order]
        group = [np.eye(3)]
        for member in group:  # it grows while it is walked through
            for product in (member @ generator for generator in generators):
                if np.abs(np.array(group) - product).max(axis=(1, 2)).min() > SAME:
                    group.append(product)
                if len(group) > 2 * LARGEST_ORDER:
                    msg = f"the axes {self.words()} make no finite group: leave one out or correct its order"
                    raise UsageError(msg)
        return np.array(group)

    def motions(self) -> list[Pose]:
        """All of them, model_from_model, the first of them none; of a free axis 24 angles, of a sphere 24 rotations."""
        turns = self.turns
        if self.sphere:
            turns = Symmetry(self.centre, (Axis((1.0, 0.0, 0.0), 4), Axis((0.0, 0.0, 1.0), 4))).turns
        elif len(self.free):
            rolls = [turn_about(self.free[0], 2 * np.pi * k / ROLLS) for k in range(ROLLS)]
            turns = np.array([turn @ roll for turn in turns for roll in rolls])
        return [self._about_centre(turn) for turn in turns]

    def canonical(self, pose: Pose) -> Pose:
        """Of the poses that look the same as target_from_model, one: which, does not depend on the one given.

        A part that stands as it was drawn stays so; a sphere is not turned at all. Otherwise it is the one nearest to a
        rotation somewhat off none, see `LEANING`.
        """
        return self.nearest(pose, np.eye(3) if self.sphere else self._reference)

    def nearest(self, pose: Pose, rotation: Floats) -> Pose:
        """Of the poses that look the same as target_from_model the one that is turned the least from a rotation."""
        if self.sphere:
            return pose @ self._about_centre(pose.rotation.T @ rotation)
        turns = self.turns
        for axis in self.free[:1]:
            rolls = [roll_of(rotation.T @ pose.rotation @ turn, axis) for turn in turns]
            turns = np.array([turn @ turn_about(axis, -roll) for turn, roll in zip(turns, rolls, strict=True)])
        near = np.einsum("ij,ik,gkj->g", rotation, pose.rotation, turns)
        return pose @ self._about_centre(turns[int(np.argmax(near))])

    @cached_property
    def _reference(self) -> Floats:
        """The rotation (3, 3) that reported ones are nearest to; about a free axis it does not roll."""
        main = max(self.axes, key=lambda axis: axis.order or np.inf, default=Axis(AXES["z"], FREE))
        axis = np.array(main.direction)
        roll = 0.0 if main.order == FREE else ROLLED
        return LEANING @ turn_about(axis, roll - roll_of(LEANING, axis))

    def stands_for_its_like(self, points: Floats) -> NDArray[np.bool_]:
        """Of places that the motions make of one another, is this the one kept? (N,) for points (N, 3), model frame.

        Those nearest to a direction that no motion leaves where it is: a wedge of the model, the whole where there is
        no symmetry. On its borders, and in the centre, several are.
        """
        arms, turns = points - self.centre, np.array([motion.rotation for motion in self.motions()])
        reach = np.max(arms @ (turns @ ASKEW).T, axis=1)
        return np.asarray(arms @ ASKEW >= reach - SAME * np.linalg.norm(arms, axis=1))

    def moved(self, target_from_model: Pose) -> Symmetry:
        """The symmetry of the model where a pose puts it."""
        x, y, z = (target_from_model.turn(np.array([a.direction for a in self.axes]).reshape(-1, 3))).T.tolist()
        axes = [Axis(d, axis.order) for d, axis in zip(zip(x, y, z, strict=True), self.axes, strict=True)]
        return Symmetry(target_from_model.move(self.centre[None])[0], tuple(axes))

    def words(self) -> str:
        """As a person says it: "4-fold about z; 2-fold about x", "free to roll about x", "none"."""
        if self.sphere:
            return "free to turn about every axis"
        told: dict[int, list[str]] = {}
        for axis in self.axes:
            told.setdefault(axis.order, []).append(_called(axis.direction))
        whats = [(f"{order}-fold" if order else "free to roll") + f" about {_listed(told[order])}" for order in told]
        return "; ".join(whats) or "none"

    def _about_centre(self, turn: Floats) -> Pose:
        return Pose(turn, self.centre - turn @ self.centre)


def pose_error(found: Pose, truth: Pose, symmetry: Symmetry) -> PoseError:
    """How far a pose is from the truth where turning the model onto itself does not count.

    The translation is that of the symmetry's centre, which all its motions leave where it is; the rotation is the least
    that leads from one of the poses equivalent to `truth` to one of those equivalent to `found`.
    """
    centre = symmetry.centre[None]
    apart = float(np.linalg.norm(found.move(centre) - truth.move(centre)))
    if symmetry.sphere:
        return PoseError(apart, 0.0)
    equivalent = [Pose(found.rotation @ turn, found.translation) for turn in symmetry.turns]
    if len(symmetry.free):
        axis = symmetry.free[0]
        ends = [(truth.rotation @ axis, pose.rotation @ axis) for pose in equivalent]
        return PoseError(apart, min(float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)) for a, b in ends))
    return PoseError(apart, min(truth.difference(pose)[1] for pose in equivalent))


def parse_axes(text: str) -> tuple[Axis, ...]:
    """Axes as a person writes them: `x2`, `z4,x2`, `z*` (every angle), `none`. Raises UsageError for anything else."""
    words = [word.strip() for word in text.lower().split(",")]
    if words == ["none"]:
        return ()
    read = [re.fullmatch(r"([xyz])(\*|[1-9]\d?)", word) for word in words]
    if not all(read):
        msg = (
            f'a symmetry is axes of the model with their order, such as "x2", "z4,x2" or "z*", or "none", got {text!r}'
        )
        raise UsageError(msg)
    axes = tuple(Axis(AXES[word[1]], FREE if word[2] == "*" else int(word[2])) for word in read if word is not None)
    Symmetry(np.zeros(3), axes)
    return axes


def turn_about(direction: Floats | tuple[float, float, float], angle: float) -> Floats:
    """Rotation (3, 3) by `angle`, radians, about a unit direction (3,)."""
    return rotation_from_vector(np.asarray(direction) * angle)


def roll_of(rotation: Floats, axis: Floats) -> float:
    """The angle about `axis` (3,) that, taken off before a rotation, leaves the smallest one (swing and twist)."""
    quaternion = Pose(rotation, np.zeros(3)).quaternion()
    along = float(axis @ [quaternion[part] for part in "xyz"])
    return 2.0 * float(np.arctan2(along, quaternion["w"]))


def _listed(names: list[str]) -> str:
    *first, last = sorted(names)
    return f"{', '.join(first)} and {last}" if first else last


def _called(direction: tuple[float, float, float]) -> str:
    for name, axis in AXES.items():
        if abs(np.dot(axis, direction)) > OWN_AXIS:
            return name
    return "({:.2f}, {:.2f}, {:.2f})".format(*direction)
