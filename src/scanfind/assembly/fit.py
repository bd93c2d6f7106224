"""The parts of a placed model, each fitted to the scan as a rigid body that hangs on those it joins.

One step is one of point-to-plane ICP with two changes. Motions are weighed by the model's own normals, which are exact:
along a straight pipe and about it they have no say at all, where a surfel's normal, wrong by noise, would. And every
part is tied to its neighbours, by springs so soft (20 mm, 3°) that any surface that is seen outweighs them a
thousandfold: they hold what the scan leaves open, and nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.evidence.verify import Level, held_against, spread
from scanfind.pose import Pose, nearest_rotation, rotation_from_vector, rotation_vector
from scanfind.search.hypotheses import Hypotheses

if TYPE_CHECKING:
    from scanfind.assembly.parameters import AssemblyParameters
    from scanfind.assembly.parts import Assembly, Joint
    from scanfind.evidence.verify import VerifyParameters
    from scanfind.grid.scene import Scene
    from scanfind.search.hypotheses import ModelArrays

Floats = NDArray[np.float64]

# The springs of a joint: a gap and a turn this large cost as much as one standard deviation of the data does.
SPRING_M, SPRING_RAD = 0.02, np.radians(3.0)
LEAST_NOISE_M = 5e-4  # of a surfel: a scan that fits better still does not bind a part more
# From as far as parts may be off to as near as surfels tell, each part by itself; then all together.
WIDE_STEPS, FINE_STEPS, STEPS, LAST_CELLS = 6, 4, 10, 0.5
WIDE_SAMPLES = 200  # of a part, while it is looked for within centimetres
TRIAL_SAMPLES = 400  # of a part, at each of the places it is tried at
# Of the way a part may be off: where it is tried along its axis, across it, and bent, towards so many sides. The fit
# closes what lies between. Twice, from the best so far: a leg may be bent and short.
SLID, ASIDE, BENT, SIDES = (0.3, 0.6, 0.9), 0.6, (0.35, 0.75), 8
ROUNDS = 2
LEAST_GATE_M = 0.02  # of the first of the fine steps: half of what lies between two trials, and some more
NORMALS_AGREE = 0.7  # as in the refinement of whole poses
# A part that most of its looked-at surface supports where its neighbour has it is where it should be.
SETTLED = 0.99
MISLED_M = 0.003  # a part set off this far by the one it hangs on may have been misled by it
SEEN_THROUGH_WEIGHT = 2.0  # of a sample seen through, against one that lies on the scene
MOST_REACH = 8  # cells, see kernels.nearest.mark_around
ONE_THREAD = 1  # a step takes a millisecond, as the start of a thread does


class View(NamedTuple):
    """The scene as parts are held against it.

    fine, thin : as whole poses are (see verify.gather_support); thin, which is coarser, also for wide steps
    signed : both sides know which way their normals face
    """

    scene: Scene
    fine: Level
    thin: Level
    signed: bool
    verify: VerifyParameters


class PartEvidence(NamedTuple):
    """What surfels and depth maps say of the samples of one placed part: how many there are, lie on the scene, and are
    seen through. Beams asked one by one would tell it better, and for each of a thousand trials cost too much.
    """

    samples: int
    supported: int
    seen_through: int

    def support(self) -> float:
        """Share of its samples that lie on the scene."""
        return self.supported / self.samples

    def penalty(self) -> float:
        """Share of its samples that are seen through."""
        return self.seen_through / self.samples

    def visible_support(self) -> float:
        """Share of the samples the scanners could speak of that are there."""
        spoken = self.supported + self.seen_through
        return self.supported / spoken if spoken else 0.0


class Hinges(NamedTuple):
    """K springs: hypothesis `of` is tied at `places` (K, 3), model frame, to where poses of others have these.

    rotations, translations : (K, 3, 3), (K, 3) of the others
    """

    of: NDArray[np.int64]
    places: Floats
    rotations: Floats
    translations: Floats


class PlacedParts(NamedTuple):
    """H poses of parts: which part, scene_from_model of each, and what the data say of its motions.

    information : (H, 6, 6) in (rotation × radius, translation) about the placed centre, scene axes, each row of a
        matched sample of unit weight; noise : (H,) rms of these, metres; share : (H,) distinct surfels a match
    """

    numbers: NDArray[np.int64]
    rotations: Floats
    translations: Floats
    information: Floats
    noise: Floats
    share: Floats

    def pose(self, k: int) -> Pose:
        """scene_from_model of the k-th."""
        return Pose(self.rotations[k], self.translations[k])


class PartsFit:
    """Fits the parts of one assembly to one scene."""

    def __init__(self, assembly: Assembly, view: View, parameters: AssemblyParameters) -> None:
        self.assembly, self.view, self.parameters = assembly, view, parameters
        self._sizes = assembly.samples()

    def fit(self, pose: Pose, *, believed: bool) -> tuple[PlacedParts, list[PartEvidence], NDArray[np.int64]] | None:
        """The parts of a model placed at `pose` where the scan has them; what it says of each; their parents, (P,).

        From the part with the most evidence outwards: each begins where the one before it would have it, and where
        that explains it badly, it is also tried bent and slid about the joint. Then all are fitted together. None as
        soon as so much was seen through that no fit of the rest can help, unless the pose is `believed` already.
        """
        self._reach(pose)
        count = len(self.assembly.names)
        start = placed(np.arange(count), [pose] * count)
        seen = self.evidence(start)
        root = int(np.argmax([one.supported for one in seen]))
        order, parents, places = self._tree(root)
        poses, tally = [pose] * count, np.array([self._sizes.sum(), 0])
        for part in order:
            before = poses[parents[part]] if parents[part] >= 0 else pose
            poses[part], found = self._one(part, before, places[part])
            if not self._settled(found) and apart(before, poses[root], places[part])[0] > MISLED_M:
                # An elbow can turn within itself and be nearly right; what comes after it would be far out.
                straight, seen_so = self._one(part, poses[root], places[part])
                if self._net(seen_so) > self._net(found):
                    poses[part], found = straight, seen_so
            tally += [found.supported - found.samples, found.seen_through]
            if not believed and self._hopeless(*tally):
                return None
        together = self._together(placed(np.arange(count), poses))
        return together, self.evidence(together), parents

    def evidence(self, parts: PlacedParts) -> list[PartEvidence]:
        """What the scene says of the samples of each placed part."""
        from scanfind.kernels.evidence import HIDDEN, SEEN_THROUGH, SILENT, SUPPORTED

        view, depths = self.view, self.view.scene.depths
        held = held_against(
            hypotheses(parts), view.scene, view.fine, depths, self.assembly.arrays, view.signed, view.verify, ONE_THREAD
        )
        found = []
        for state in (held.states[samples] for samples in held.poses()):
            on, through, hidden, silent = (
                int(np.count_nonzero(state == of)) for of in (SUPPORTED, SEEN_THROUGH, HIDDEN, SILENT)
            )
            found.append(PartEvidence(len(state), on, spread(through, hidden, silent)))
        return found

    def _reach(self, pose: Pose) -> None:
        """Fit the surfels as far around a pose as its parts may be off."""
        from scanfind.kernels.nearest import mark_around, mark_rows

        fine = self.view.scene.fine
        at, points = fine.cells, pose.move(self.assembly.arrays.points)
        near = np.zeros(len(fine.sides), np.bool_)
        # Twice: a part may be off, and what hangs on it swings out farther.
        reach = min(MOST_REACH, int(np.ceil(2.0 * self.parameters.most_shift_m / at.cell)) + 1)
        layers = np.zeros((len(at.filled), 8), np.uint64)
        mark_around(points, reach, at.cell, at.hash_keys, at.hash_values, layers)
        mark_rows(at.order, layers, at.block_rows, near)
        fine.fit(near[at.rows])

    def _tree(self, root: int) -> tuple[list[int], NDArray[np.int64], Floats]:
        """Parts from the root outwards, the parent of each (-1: none) and the place of their joint, (P, 3)."""
        count = len(self.assembly.names)
        parents, places = np.full(count, -1), self.assembly.arrays.centres.copy()
        order, left = [root], set(range(count)) - {root}
        while left:
            nearest = max(
                (joint for joint in self.assembly.joints if (joint.a in left) != (joint.b in left)),
                key=lambda joint: joint.points, default=None,
            )  # fmt: skip
            if nearest is None:  # pieces that touch nothing hang on the root
                part = min(left)
                parents[part] = root
            else:
                part, parent = (nearest.a, nearest.b) if nearest.a in left else (nearest.b, nearest.a)
                parents[part], places[part] = parent, nearest.place
            order.append(part)
            left.remove(part)
        return order, parents, places

    def _hopeless(self, supported: int, through: int) -> bool:
        """Would the score be too low with at most so many samples supported and at least so many seen through?"""
        verify = self.view.verify
        spared = self.parameters.most_missing * float(self._sizes.sum())
        against = SEEN_THROUGH_WEIGHT * max(through - spared, 0.0)
        return supported < verify.min_score * (supported + against)

    def _one(self, part: int, before: Pose, place: Floats) -> tuple[Pose, PartEvidence]:
        """Where a part is that its neighbour would have at `before`, scene_from_model, joined at `place` (3,)."""
        first = self._settle(placed(np.array([part]), [before]), place, [*self._wide(), *self._narrow()])
        seen = self.evidence(first)[0]
        if self._settled(seen) and self._near(first.pose(0), before, place):
            return first.pose(0), seen
        start, told, most = before, seen, -np.inf
        for _ in range(ROUNDS):
            moves = self._trials(part, place)
            tried = placed(np.full(len(moves), part), [start @ move for move in moves])
            tried = joined(first, self._settle(tried, place, self._narrow(TRIAL_SAMPLES)))
            for k, found in enumerate(self.evidence(tried)):
                value = self._worth(tried.pose(k), found, before, place)
                if value > most:
                    start, told, most = tried.pose(k), found, value
            if told.visible_support() >= SETTLED or not self._settled(told, share=0.0):
                break
        # Where it cannot be, within bounds, it is where its neighbour would have it.
        return (start, told) if most > -np.inf else (before, self.evidence(placed(first.numbers, [before]))[0])

    def _settled(self, seen: PartEvidence, share: float = SETTLED) -> bool:
        """Is enough of a part there, and so large a share of what could be seen of it?"""
        return seen.support() >= self.view.verify.min_support and seen.visible_support() >= share

    def _net(self, seen: PartEvidence) -> float:
        """Samples for, less those against."""
        return seen.supported - SEEN_THROUGH_WEIGHT * seen.seen_through

    def _worth(self, pose: Pose, found: PartEvidence, before: Pose, place: Floats) -> float:
        """What speaks for a part being at a pose, in samples; -inf beyond the bounds."""
        if not self._near(pose, before, place):
            return -np.inf
        # Of poses that explain the same, the one nearer to the design: a twentieth of the samples for all of the way.
        gap, turn = apart(pose, before, place)
        strain = gap / self.parameters.most_shift_m + float(np.degrees(turn)) / self.parameters.most_turn_deg
        return self._net(found) - 0.05 * strain * found.samples

    def _trials(self, part: int, place: Floats) -> list[Pose]:
        """Motions of a part, model frame, about a joint: slid along its axis, set aside, bent to all sides."""
        along = self.assembly.arrays.centres[part] - place
        if np.linalg.norm(along) < 1e-6:
            along = np.array([0.0, 0.0, 1.0])
        along = along / np.linalg.norm(along)
        axes = np.linalg.svd(along[None])[2]
        turn, shift = np.radians(self.parameters.most_turn_deg), self.parameters.most_shift_m
        shifts = [sign * share * along for share in SLID for sign in (1.0, -1.0)]
        shifts += [sign * ASIDE * axis for axis in axes[1:] for sign in (1.0, -1.0)]
        moves = [Pose(np.eye(3), shift * way) for way in shifts]
        for angle in 2.0 * np.pi * np.arange(SIDES) / SIDES:
            axis = np.cos(angle) * axes[1] + np.sin(angle) * axes[2]
            rotations = [rotation_from_vector(share * turn * axis) for share in BENT]
            moves += [Pose(rotation, place - rotation @ place) for rotation in rotations]
        return moves

    def _near(self, pose: Pose, before: Pose, place: Floats) -> bool:
        gap, turn = apart(pose, before, place)
        return gap <= self.parameters.most_shift_m and np.degrees(turn) <= self.parameters.most_turn_deg

    def _settle(self, parts: PlacedParts, place: Floats, steps: list[tuple[Level, float]]) -> PlacedParts:
        """Fit several poses of parts, each by itself, tied at `place` (3,) to where it began."""
        count = len(parts.numbers)
        hinges = Hinges(np.arange(count), np.tile(place, (count, 1)), parts.rotations, parts.translations)
        for level, gate in steps:
            parts = self._step(parts, level, gate, hinges)
        return parts

    def _together(self, parts: PlacedParts) -> PlacedParts:
        """Fit all parts at once, each tied to its neighbours as it is to them now."""
        rest = parts
        fine = self.view.fine
        for gate in np.geomspace(1.0, LAST_CELLS, STEPS) * fine.surfels.cell:
            hinges = hinges_of(self.assembly.joints, parts, rest)
            parts = self._step(parts, fine, max(gate, 3.0 * self.view.scene.noise), hinges)
        return parts

    def _wide(self) -> list[tuple[Level, float]]:
        """Steps from several centimetres away: levels and gates, metres."""
        coarse, fine = self.view.thin._replace(samples=WIDE_SAMPLES), self.view.fine
        far = min(0.75 * self.parameters.most_shift_m, 4.0 * coarse.surfels.cell)
        near = min(1.2 * fine.surfels.cell, far)
        return [(coarse, float(gate)) for gate in np.geomspace(far, near, WIDE_STEPS)]

    def _narrow(self, samples: int | None = None) -> list[tuple[Level, float]]:
        """Steps from near by."""
        fine = self.view.fine if samples is None else self.view.fine._replace(samples=samples)
        cell = fine.surfels.cell
        return [(fine, float(gate)) for gate in np.geomspace(max(cell, LEAST_GATE_M), LAST_CELLS * cell, FINE_STEPS)]

    def _step(self, parts: PlacedParts, level: Level, gate: float, hinges: Hinges) -> PlacedParts:
        """One Gauss-Newton step of each part."""
        surfels, arrays = level.surfels, self.assembly.arrays
        sizes = np.minimum(self._sizes[parts.numbers], level.samples)
        rules = replace(self.view.verify, gate_cells=min(4.0, gate / surfels.cell), normal_agreement=NORMALS_AGREE)
        # Correspondences need no depth maps: without them the kernel asks no beams.
        claims = held_against(
            hypotheses(parts), self.view.scene, level._replace(inlier=gate), [], arrays, self.view.signed, rules,
            ONE_THREAD,
        ).claims  # fmt: skip
        found = []
        for h, (number, end) in enumerate(zip(parts.numbers, np.cumsum(sizes), strict=True)):
            claim = claims[end - sizes[h] : end]
            on = np.flatnonzero(claim >= 0)
            base, pose = arrays.starts[number], parts.pose(h)
            points, normals = pose.move(arrays.points[base + on]), pose.turn(arrays.normals[base + on])
            surfel = claim[on]
            gaps, weights = matches(points, normals, surfels.means[surfel], surfels.normals[surfel], gate)
            share = len(np.unique(surfel)) / len(on) if len(on) else 1.0
            found.append(Matches(points, normals, gaps, weights, share))
        return stepped(parts, found, hinges, arrays)


class Matches(NamedTuple):
    """Where a part meets the scan: N points of it and their normals (N, 3), scene frame.

    gaps : (N,) metres the scan lies above each, along its normal; weights : (N,) 0 … 1
    share : of them that count as independent
    """

    points: Floats
    normals: Floats
    gaps: Floats
    weights: Floats
    share: float


def stepped(parts: PlacedParts, found: list[Matches], hinges: Hinges, arrays: ModelArrays) -> PlacedParts:
    """The parts after one Gauss-Newton step towards what each of them meets, held by the hinges."""
    tied, pull = springs(parts, hinges, arrays.centres, arrays.radii)
    rotations, translations = parts.rotations.copy(), parts.translations.copy()
    information, noise, share = np.zeros_like(parts.information), parts.noise.copy(), parts.share.copy()
    for h, (number, met) in enumerate(zip(parts.numbers, found, strict=True)):
        centre, radius = arrays.centres[number], arrays.radii[number]
        middle = rotations[h] @ centre + translations[h]
        rows = np.hstack([np.cross(met.points - middle, met.normals) / radius, met.normals])
        information[h] = (rows * met.weights[:, None]).T @ rows
        total = float(met.weights.sum())
        squares = float((met.weights * met.gaps * met.gaps).sum())
        noise[h] = max(LEAST_NOISE_M, np.sqrt(squares / total)) if total > 0.0 else 1.0
        share[h] = met.share
        precision = share[h] / noise[h] ** 2
        # A thousandth of one match in a thousand, as in ICP of whole poses: a part that hangs on nothing stays.
        hessian = precision * information[h] + tied[h] + 1e-6 * (precision * total + 1.0) * np.eye(6)
        step = np.linalg.solve(hessian, precision * (rows.T @ (met.weights * met.gaps)) + pull[h])
        rotations[h] = nearest_rotation(rotation_from_vector(step[:3] / radius) @ rotations[h])
        translations[h] = middle + step[3:] - rotations[h] @ centre
    return PlacedParts(parts.numbers, rotations, translations, information, noise, share)


def matches(
    points: Floats, normals: Floats, means: Floats, directions: Floats, gate: float
) -> tuple[Floats, Floats]:  # fmt: skip
    """Of N placed samples and the surfels they meet: gaps (N,), and Tukey's weights (N,).

    The gap is measured along the mean of both normals: of a bent surface a sample beside its surfel lies as far
    beneath the one's plane as above the other's (Rusinkiewicz 2019).
    """
    sides = np.where((normals * directions).sum(axis=1) < 0.0, -1.0, 1.0)
    between = normals + sides[:, None] * directions
    between /= np.maximum(np.linalg.norm(between, axis=1), 1e-12)[:, None]
    gaps = ((means - points) * between).sum(axis=1)
    return gaps, tukey(gaps, gate)


def tukey(gaps: Floats, gate: float) -> Floats:
    """Tukey's weights, 0 from the gate on."""
    weights: Floats = np.maximum(1.0 - (gaps / gate) ** 2, 0.0) ** 2
    return weights


def hinges_of(joints: Sequence[Joint], parts: PlacedParts, rest: PlacedParts) -> Hinges:
    """Every part of an assembly, in their order, tied to its neighbours as it is to them at `rest`.

    Not as the design has it: a leg whose slide nothing but its end tells was slid to where its end is, and stays there.
    """
    pairs = [tied for joint in joints for tied in ((joint.a, joint.b), (joint.b, joint.a))]
    of, others = np.array(pairs, np.int64).reshape(-1, 2).T
    places = np.repeat(np.array([joint.place for joint in joints]).reshape(-1, 3), 2, axis=0)
    anchors = [
        parts.pose(b) @ rest.pose(b).inverse() @ rest.pose(a) for a, b in zip(of.tolist(), others.tolist(), strict=True)
    ]
    rotations = np.array([one.rotation for one in anchors]).reshape(-1, 3, 3)
    return Hinges(of, places, rotations, np.array([one.translation for one in anchors]).reshape(-1, 3))


def springs(parts: PlacedParts, hinges: Hinges, centres: Floats, radii: Floats) -> tuple[Floats, Floats]:
    """The hessian (H, 6, 6) and the pull (H, 6) of the springs on each part, about its placed centre."""
    hessian, pull = np.zeros((len(parts.numbers), 6, 6)), np.zeros((len(parts.numbers), 6))
    for of, place, rotation, translation in zip(*hinges, strict=True):
        number = parts.numbers[of]
        radius, mine = radii[number], parts.pose(int(of))
        arm = mine.rotation @ (place - centres[number])
        gap = rotation @ place + translation - mine.move(place[None])[0]
        rows = np.hstack([-skew(arm) / radius, np.eye(3)]) / SPRING_M
        turning = np.hstack([np.eye(3) / radius, np.zeros((3, 3))]) / SPRING_RAD
        hessian[of] += rows.T @ rows + turning.T @ turning
        pull[of] += rows.T @ (gap / SPRING_M) + turning.T @ (rotation_vector(rotation @ mine.rotation.T) / SPRING_RAD)
    return hessian, pull


def skew(vector: Floats) -> Floats:
    """The matrix (3, 3) whose product with another vector is the cross product of the two."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def apart(pose: Pose, other: Pose, place: Floats) -> tuple[float, float]:
    """How far two poses part a place (3,) of the model, metres, and how far they turn against each other, radians."""
    gap = float(np.linalg.norm(pose.move(place[None]) - other.move(place[None])))
    return gap, pose.difference(other)[1]


def placed(numbers: NDArray[np.int64], poses: list[Pose]) -> PlacedParts:
    """Parts at poses of which nothing is known yet."""
    count = len(numbers)
    rotations, translations = np.array([p.rotation for p in poses]), np.array([p.translation for p in poses])
    return PlacedParts(numbers, rotations, translations, np.zeros((count, 6, 6)), np.ones(count), np.ones(count))


def joined(some: PlacedParts, others: PlacedParts) -> PlacedParts:
    """Both, end to end."""
    rest = (np.concatenate([mine, theirs]) for mine, theirs in zip(some[1:], others[1:], strict=True))
    return PlacedParts(np.concatenate([some.numbers, others.numbers]), *rest)


def hypotheses(parts: PlacedParts) -> Hypotheses:
    """As the kernels of verification take them."""
    return Hypotheses(parts.numbers, parts.rotations, parts.translations, np.ones(len(parts.numbers)))
