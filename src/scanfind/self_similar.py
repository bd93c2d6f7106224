"""How a model resembles itself: its true symmetries, and the motions after which it could be taken for itself.

A true symmetry brings the surface onto the surface, and no scan can tell one such pose from another. After the others
(the paper's box frame, turned over, still covers nine tenths of itself) the pose is wrong, and the one a search is most
likely to take for the right one: those are tried against the best pose before it is believed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import combinations, permutations, product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.mesh import doubled_areas
from scanfind.near_surface import near_samples, near_triangles, signed_distances, unit_normals
from scanfind.pose import Pose
from scanfind.symmetry import FREE, Axis, Symmetry, pose_error, turn_about

if TYPE_CHECKING:
    from scanfind.mesh import Mesh
    from scanfind.surface import ModelSurface

Floats = NDArray[np.float64]

# A symmetry brings this share of so many samples this near to the surface, in spacings of the samples (3,000 on a spool
# of 3 m: 2.4 mm; a pipe of 0.1 m drawn with 48 sides is flat by 0.2 mm). A piece of scan has noise, and no faces.
TRUE_SHARE, TRUE_SHARE_CLOUD, TRUE_TRIED = 0.99, 0.94, 1500
TRUE_WITHIN, TRUE_WITHIN_CLOUD = 0.1, 0.3
# … and most of the samples near samples: a face that nobody sees is no part of the surface, nor is the other side of a
# sheet. Not more of them, for the walls of bolt holes hold too few samples to have one of like normal everywhere.
TRUE_SAMPLES = 0.9
ORDERS = (2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 16, 20, 24)
# Every order has one of these as a factor; who turns by all of FREE_ORDERS has no holes to be told apart by.
PRIMES, FREE_ORDERS = (2, 3, 5, 7, 11), (7, 11, 5, 9, 8)
# Few samples, and far off, show that an axis is hopeless.
ROUGH_SAMPLES, ROUGH_WITHIN, ROUGH_SHARE = 60, 2.0, 0.8
SETTLING_SAMPLES, SETTLING_STEPS = 400, 8
FACETS, FACET_COSINE, FACET_SHARE = 6, 0.999, 0.02  # plane faces whose directions propose axes
APART = np.cos(np.radians(4.0))  # axes nearer than this are proposed once

# Below this a motion leads to another pose altogether, which the search would find by itself.
LEAST_OVERLAP = 0.35
OVERLAP_SAMPLES = 200
MOST_SIMILAR = 24
# Motions that differ by less than this share of the diameter lead to one pose: ICP draws them together.
ALIKE = 1.0 / 15.0
SHIFT_SAMPLES, SHIFT_CELLS = 1500, 2.0  # the table of shifts: samples paired, its cell in spacings
MOST_SHIFTS = 20
# A repetition: so many spacings to either side of it, the model lies on itself clearly less.
SHIFT_FLANK, SHIFT_DIP = 4.0, 0.9


class Similar(NamedTuple):
    """A motion model_from_model that is no symmetry, and the share of the model's samples it brings onto samples."""

    overlap: float
    motion: Pose


class Line(NamedTuple):
    """An axis of symmetry: unit direction (3,), a point on it (3,), order (FREE: every angle)."""

    direction: Floats
    point: Floats
    order: int


class SelfSimilarity:
    """A model's surface, to be laid onto itself.

    mesh : None for a piece of scan, whose samples then stand for its surface
    """

    def __init__(self, surface: ModelSurface, mesh: Mesh | None) -> None:
        self.points, self.normals = surface.samples.points, surface.samples.normals
        self.spacing, self.diameter, self.signed = surface.spacing, surface.diameter, surface.signed
        self._reach = ROUGH_WITHIN * surface.spacing
        if mesh is None:
            self._near = near_samples(surface.samples, surface.spacing, self._reach)
            self._corners, self._faces = self.points, self.normals
        else:
            triangles = mesh.triangles()
            self._near = near_triangles(triangles, self._reach, signed=False)
            self._corners, self._faces = triangles[:, 0], unit_normals(triangles)
        self._within = surface.spacing * (TRUE_WITHIN_CLOUD if mesh is None else TRUE_WITHIN)
        self._share = TRUE_SHARE_CLOUD if mesh is None else TRUE_SHARE
        # What no symmetry moves: the middle of the surface. That of the samples is it nearly, that of the triangles
        # exactly, unless many of them are hidden.
        self.centre: Floats = self.points.mean(axis=0)
        if mesh is not None and np.linalg.norm(middle_of(mesh) - self.centre) < self.spacing:
            self.centre = middle_of(mesh)
        self._radius = float(np.linalg.norm(self.points - self.centre, axis=1).max())

    # ── how well the model lies on itself after a motion ──────────────────────────────────────────────────────────

    def _faces_below(self, motion: Pose, count: int) -> tuple[Floats, Floats, NDArray[np.int32], NDArray[np.bool_]]:
        """The first `count` samples moved, (count, 3); how far from the surface; the face there; is it the like of
        theirs, whichever side it shows.
        """
        moved, normals = motion.move(self.points[:count]), motion.turn(self.normals[:count])
        distance, face = signed_distances(self._near, moved)
        like = (face >= 0) & (np.abs((normals * self._faces[face]).sum(axis=1)) > 0.7)
        return moved, np.abs(distance.astype(np.float64)), face, like

    def off(self, motion: Pose, count: int) -> Floats:
        """How far each of the first `count` samples then is from surface of its direction, metres, clipped."""
        _, distance, _, like = self._faces_below(motion, count)
        return np.where(like, distance, self._reach)

    def overlap(self, motion: Pose, count: int = OVERLAP_SAMPLES) -> float:
        """The share of the first `count` samples that a motion brings within two spacings of a sample like them."""
        from scanfind.kernels.overlap import self_overlap

        count = min(count, len(self.points))
        rotation, translation = np.ascontiguousarray(motion.rotation), motion.translation
        return float(
            self_overlap(self.points, self.normals, self.signed, count, rotation, translation, 2.0 * self.spacing)
        )

    def is_symmetry(self, motion: Pose) -> bool:
        """Does a motion bring the surface onto itself?"""
        if np.mean(self.off(motion, OVERLAP_SAMPLES) <= self._within) < self._share - 0.03:
            return False  # most fail here, at a fifteenth of the cost
        if np.mean(self.off(motion, TRUE_TRIED) <= self._within) < self._share:
            return False
        return self.overlap(motion, 2 * OVERLAP_SAMPLES) >= TRUE_SAMPLES

    def _hopeless(self, motion: Pose) -> bool:
        return bool(np.mean(self.off(motion, ROUGH_SAMPLES) < self._reach) < ROUGH_SHARE)

    def _settled(self, motion: Pose) -> Pose:
        """The motion near this one that brings the surface onto itself best: point-to-plane ICP."""
        centre = motion.move(self.centre[None])[0]
        for _ in range(SETTLING_STEPS):
            moved, _, face, like = self._faces_below(motion, SETTLING_SAMPLES)
            if like.sum() < 6:
                break
            moved, normals, corners = moved[like], self._faces[face[like]], self._corners[face[like]]
            residual = ((moved - corners) * normals).sum(axis=1)
            lever = np.cross(moved - centre, normals) / self._radius
            # What the surface leaves open (the roll of a pipe) stays as it is: the shortest of all best steps.
            step = np.linalg.lstsq(np.hstack([lever, normals]), -residual, rcond=0.02)[0]
            turn = Pose.from_rotation_vector(step[:3] / self._radius)
            motion = Pose(turn.rotation, centre - turn.rotation @ centre + step[3:]) @ motion
            if np.abs(step).max() < 1e-4 * self._within:
                break
        return motion

    # ── symmetries ────────────────────────────────────────────────────────────────────────────────────────────────

    def symmetry(self) -> Symmetry:
        """All rotations that bring the surface onto itself: axes are proposed, settled, and held to `is_symmetry`.

        Only directions on which the surface itself insists are tried: the principal ones of its area, its normals and
        its moments, those of its plane faces and what lies between and across them, and every direction across an axis
        already found. Of an icosahedron's group that finds a part.
        """
        lines: list[Line] = []
        for direction in self._directions():
            if any(abs(direction @ line.direction) > APART for line in lines):
                continue
            line = self._line(direction, PRIMES)
            if line is not None:
                lines.append(line)
                if line.order == FREE:
                    return group_of([line, *self._across_free(line)], self.centre)
        if len(lines) == 1:
            lines += self._across(lines[0])
        return group_of(lines, self.centre)

    def _directions(self) -> Iterator[Floats]:
        """Unit directions (3,) an axis of symmetry may have, no two nearly alike."""
        arms = self.points - self.centre
        tried: list[Floats] = []
        tensors = [np.linalg.eigh(each.T @ each)[1].T for each in (np.cross(arms, self.normals), arms, self.normals)]
        facets = self._facets
        pairs = [each for a, b in combinations(facets, 2) for each in (a + b, a - b, np.cross(a, b))]
        corners = [a + s * b + t * c for a, b, c in combinations(facets[:3], 3) for s in (1, -1) for t in (1, -1)]
        for direction in [*np.eye(3), *facets, *np.concatenate(tensors), *pairs, *corners]:
            length = float(np.linalg.norm(direction))
            if length > 0.05 and all(abs(direction @ other) < APART * length for other in tried):
                tried.append(unit(direction))
                yield tried[-1]

    @cached_property
    def _facets(self) -> list[Floats]:
        """Directions of the largest plane faces, largest first, up to sign."""
        normals = self.normals[:SETTLING_SAMPLES]
        like = np.abs(normals @ normals.T) > FACET_COSINE
        found: list[Floats] = []
        while len(found) < FACETS:
            largest = int(np.argmax(like.sum(axis=1)))
            theirs = np.flatnonzero(like[largest])
            if len(theirs) < max(FACET_SHARE * len(normals), 3):
                break
            found.append(unit(np.sign(normals[theirs] @ normals[largest]) @ normals[theirs]))
            like[:, theirs] = False
        return found

    def _line(self, direction: Floats, orders: Sequence[int]) -> Line | None:
        """The axis of symmetry near a direction through the centre, if turns of one of these orders are symmetries."""
        for order in orders:
            turn = about(direction, self.centre, 2 * np.pi / order)
            if self._hopeless(turn):
                continue
            axis, point = axis_of(self._settled(turn), direction, self.centre)
            if abs(axis @ direction) > APART and self.is_symmetry(about(axis, point, 2 * np.pi / order)):
                return Line(axis, point, self._order(axis, point))
        return None

    def _order(self, direction: Floats, point: Floats) -> int:
        """FREE, or the highest order of the turns about a line that are symmetries."""

        def turns(order: int) -> bool:
            return self.is_symmetry(about(direction, point, 2 * np.pi / order))

        if all(turns(order) for order in FREE_ORDERS):
            return FREE
        return next((order for order in reversed(ORDERS) if turns(order)), 1)

    def _across_free(self, line: Line) -> list[Line]:
        """Beside an axis of revolution: another one (a sphere), or half turns about any line across it."""
        across = self._line(any_across(line.direction), (11, 2))
        return [] if across is None else [across]

    def _across(self, line: Line) -> list[Line]:
        """Half turns about lines across the only axis found: round parts do not say where these are, so all are tried.

        With half turns an n-fold axis has n lines across it at equal angles: one lies in the first π/n.
        """
        start = any_across(line.direction)
        width = np.pi / line.order
        # As close as lets no sample come farther than a spacing from where it belongs.
        steps = int(np.ceil(width * self._radius / self.spacing))
        tried = [turn_about(line.direction, width * k / steps) @ start for k in range(steps)]
        off = [self.off(about(u, self.centre, np.pi), OVERLAP_SAMPLES).mean() for u in tried]
        across = self._line(tried[int(np.argmin(off))], (2,))
        return [] if across is None else [across]

    def declared(self, axes: tuple[Axis, ...]) -> Symmetry:
        """A symmetry somebody vouches for, about the point where the surface comes nearest to having it.

        Tried are the middle of the surface, of its box, and the model's origin.
        """
        box = 0.5 * (self.points.min(axis=0) + self.points.max(axis=0))

        def off(symmetry: Symmetry) -> float:
            return float(np.mean([self.off(motion, OVERLAP_SAMPLES).mean() for motion in symmetry.motions()]))

        return min((Symmetry(centre, axes) for centre in (self.centre, box, np.zeros(3))), key=off)

    # ── what the model could be taken for ─────────────────────────────────────────────────────────────────────────

    def similar(self, symmetry: Symmetry) -> tuple[Similar, ...]:
        """Motions that bring at least `LEAST_OVERLAP` of the samples onto samples and are no symmetry, best first.

        Tried are the turns of a cube about the middle of the model's box, along its own axes and along its principal
        ones, and the shifts by which the model repeats itself (the bays of a rack).
        """
        kept = [Similar(1.0, Pose.identity())]

        def is_new(motion: Pose) -> bool:
            return all(self._differ(motion, other.motion, symmetry) for other in kept)

        proposed = [Similar(self.overlap(motion), motion) for motion in [*self._turned(), *self._shifted()]]
        for rough in sorted(proposed, key=lambda each: -each.overlap):
            if rough.overlap >= LEAST_OVERLAP and is_new(rough.motion):
                motion = self._settled(rough.motion)
                if is_new(motion):
                    kept.append(Similar(self.overlap(motion), motion))
        best = sorted(kept[1:], key=lambda each: -each.overlap)
        return tuple(each for each in best if each.overlap >= LEAST_OVERLAP)[:MOST_SIMILAR]

    def _differ(self, one: Pose, other: Pose, symmetry: Symmetry) -> bool:
        error = pose_error(one, other, symmetry)
        return error.translation_m + self._radius * error.rotation_rad > ALIKE * self.diameter

    def _turned(self) -> Iterator[Pose]:
        """Turns of a cube along the model's own axes, those of its largest plane faces, and its principal ones."""
        principal = np.linalg.svd(self.points - self.centre, full_matrices=False)[2]
        faced = self._faced()
        square = (np.abs(faced) > APART).any(axis=1).all()  # to the model's own axes
        for axes in (np.eye(3), principal) if square else (np.eye(3), faced, principal):
            axes[2] = np.cross(axes[0], axes[1])
            along = self.points @ axes.T
            middle = 0.5 * (along.min(axis=0) + along.max(axis=0)) @ axes
            for turn in cube_turns()[1:]:
                rotation = axes.T @ turn @ axes
                yield Pose(rotation, middle - rotation @ middle)

    def _faced(self) -> Floats:
        """Axes (3, 3), as rows, along the largest plane faces; the coordinate axes where there are none."""
        facets = self._facets
        if not facets:
            return np.eye(3)
        beside = next((b for b in facets[1:] if abs(b @ facets[0]) < 0.1), any_across(facets[0]))
        beside = unit(beside - (beside @ facets[0]) * facets[0])
        return np.array([facets[0], beside, np.cross(facets[0], beside)])

    def _shifted(self) -> Iterator[Pose]:
        """Shifts, there and back, at which the model lies on itself clearly better than a little farther or nearer, and
        no worse than a little aside: a beam slides along itself as well, and no place there is better than the next.
        """
        for shift in self._shifts():
            here, step = self.overlap(shifted(shift)), SHIFT_FLANK * self.spacing
            if here < LEAST_OVERLAP:
                continue
            ends = [self.overlap(shifted(shift + side * step * unit(shift))) for side in (-1, 1)]
            aside = (self.overlap(shifted(shift + side * step * axis)) for axis in np.eye(3) for side in (-1, 1))
            if max(ends) < SHIFT_DIP * here and all(each <= here for each in aside):
                yield shifted(shift)
                yield shifted(-shift)

    def _shifts(self) -> Floats:
        """The likeliest, (K, 3): peaks of how often each shift leads from a sample to one of like normal."""
        from scanfind.kernels.overlap import count_shifts

        count = min(SHIFT_SAMPLES, len(self.points))
        points, normals = self.points[:count], self.normals[:count]
        cell = SHIFT_CELLS * self.spacing * np.sqrt(len(self.points) / count)
        reach = np.ceil(np.ptp(points, axis=0) / cell).astype(np.int64) + 1
        table = np.zeros(2 * reach + 1, np.int64)
        count_shifts(points, normals, self.signed, 1.0 / cell, reach, table)
        around = np.pad(table, 1)
        neighbours = [
            around[tuple(slice(1 + d, 1 + d + size) for d, size in zip(step, table.shape, strict=True))]
            for step in product((-1, 0, 1), repeat=3)
        ]
        peaks = np.argwhere((table == np.max(neighbours, axis=0)) & (table > 0))
        shifts = (peaks - reach) * cell
        far = np.linalg.norm(shifts, axis=1) > max(ALIKE * self.diameter, 2 * SHIFT_FLANK * self.spacing)
        best = np.argsort(-table[tuple(peaks.T)] * far, kind="stable")[:MOST_SHIFTS]
        return np.asarray(shifts[best[far[best]]])


def middle_of(mesh: Mesh) -> Floats:
    """The middle of a mesh's surface, (3,)."""
    areas = doubled_areas(mesh.vertices, mesh.faces)
    return np.asarray(areas @ mesh.triangles().mean(axis=1) / areas.sum())


def shifted(shift: Floats) -> Pose:
    """The motion by (3,) without a turn."""
    return Pose(np.eye(3), np.asarray(shift))


def about(direction: Floats, point: Floats, angle: float) -> Pose:
    """The turn by `angle` about a line."""
    turn = turn_about(direction, angle)
    return Pose(turn, point - turn @ point)


def axis_of(motion: Pose, direction: Floats, near: Floats) -> tuple[Floats, Floats]:
    """The line about which a motion turns: unit direction, the way `direction` points; its point nearest to `near`."""
    values, vectors = np.linalg.eig(motion.rotation)
    axis: Floats = vectors[:, int(np.argmin(np.abs(values - 1.0)))].real
    axis = axis / np.linalg.norm(axis) * (1.0 if axis @ direction >= 0.0 else -1.0)
    aside = motion.move(near[None])[0] - near
    aside -= (aside @ axis) * axis
    return axis, near + np.linalg.lstsq(np.eye(3) - motion.rotation, aside, rcond=1e-6)[0]


def any_across(direction: Floats) -> Floats:
    """A unit direction across this one: that of the coordinate axis it is farthest from."""
    across = np.eye(3)[int(np.argmin(np.abs(direction)))]
    across = across - (across @ direction) * direction
    return unit(across)


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
    square = [line for line in others if abs(line.direction @ z) < 0.1]
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


def unit(vector: Floats) -> Floats:
    """The same direction at unit length."""
    return np.asarray(vector / np.linalg.norm(vector))


def triple(vector: Floats) -> tuple[float, float, float]:
    """Three plain floats, the largest positive, since an axis has no sign."""
    x, y, z = (vector * np.sign(vector[int(np.argmax(np.abs(vector)))])).tolist()
    return x, y, z


def cube_turns() -> list[Floats]:
    """The 24 rotations (3, 3) that map the coordinate axes onto each other."""
    turns = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        turn = np.zeros((3, 3))
        turn[np.arange(3), order] = signs
        if np.linalg.det(turn) > 0:
            turns.append(turn)
    return turns
