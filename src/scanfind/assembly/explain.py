"""What became of each part of a model, and whether the model with its parts where they are explains the scan.

The design's place is that of the parts that keep to it among themselves; every part is measured against it, along what
the scan fixes and nothing else. A pose refused as a whole is believed when the parts, moved within bounds, are there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.assembly.fit import (
    ONE_THREAD,
    PartEvidence,
    PartsFit,
    PlacedParts,
    View,
    apart,
    hypotheses,
    skew,
)
from scanfind.assembly.parts import Assembly, assembly_of
from scanfind.assembly.points import fitted_to_points, placed_faces
from scanfind.cloud import OrientedCloud
from scanfind.detection import PartFit
from scanfind.evidence.free_space import Limits, caster_of, spoken_of
from scanfind.evidence.verify import Evidence, gather_support, why_refused
from scanfind.fit.refine import motion_of, triple
from scanfind.mesh import Mesh
from scanfind.pose import Pose, nearest_rotation, rotation_from_vector, rotation_vector

if TYPE_CHECKING:
    from scanfind.assembly.parameters import AssemblyParameters
    from scanfind.library.model import Model

Floats = NDArray[np.float64]

MEASURED, MISSING, NOT_SEEN = "measured", "missing", "not_seen"
# Fewer supported samples than this many, or than this share, do not measure a part; as many spoken of can miss it.
LEAST_SUPPORTED, LEAST_SHOWN = 20, 0.08
THERE = 0.5  # share of what scanners could see of a part that must be there for it to be there
# Parts whose surface lies within this of where the design puts it, rms, keep to it: as a scan's noise is.
KEEPS_M = 0.002
# A motion is free where less than this of what it moves the surface by, squared, is across the surface. Facets make
# 0.0014 of a cylinder's roll (24 of them 0.006), oblique ones around a branch 0.004 of its slide; the face of a flange
# is 0.1 of the slide of a leg of 1 m, and a square bar rolls across itself by 0.25.
FREE_BELOW = 0.01
# Surfels near each other err alike (bent surface, mixed pixels), which their residuals do not show.
ALIKE_M, ALIKE_SHARE = 1e-4, 3.0


class Explained(NamedTuple):
    """The scan, explained by a model in parts.

    pose : scene_from_model of the parts that keep to the design, relative to the grid's offset
    parts : one each; evidence : of all, but for missing ones that may be missing
    reason : why it is not believed, in words; empty where it is
    placed, seen, parents : what the parts were told from: poses, evidence, and on which part each hangs
    """

    pose: Pose
    parts: tuple[PartFit, ...]
    evidence: Evidence
    reason: str
    placed: PlacedParts
    seen: Sequence[PartEvidence]
    parents: NDArray[np.int64]


class Assemblies:
    """The models sought, cut into parts where they have them, each cut once."""

    def __init__(self, models: Sequence[Model], view: View, parameters: AssemblyParameters, blind: bool) -> None:
        self._models, self._view, self._parameters, self._blind = models, view, parameters, blind
        self._fits: dict[int, PartsFit | None] = {}

    def explain(self, model: int, pose: Pose, *, believed: bool = False) -> Explained | None:
        """Fit the parts of a model placed near `pose`; None where it has but one, or where that is hopeless.

        believed : the pose is, without its parts: nothing is hopeless
        """
        if model not in self._fits:
            self._fits[model] = self._cut(self._models[model])
        fit = self._fits[model]
        return None if fit is None else explained(fit, self._models[model], pose, self._blind, believed=believed)

    def faces(self, model: int, whole: Explained) -> Floats:
        """The faces (F, 3, 3) of a model as built, relative to the grid's offset; without its missing parts."""
        fit, mesh = self._fits[model], self._models[model].mesh
        assert fit is not None  # else nothing could have been explained
        assert mesh is not None
        return placed_faces(mesh, fit.assembly, whole.placed, [part.status != MISSING for part in whole.parts])

    def measured(self, model: int, whole: Explained, points: Floats) -> Explained:
        """The same, each part fitted to the raw points (N, 3) within REACH_M of it, relative to the grid's offset."""
        fit, mesh = self._fits[model], self._models[model].mesh
        assert fit is not None
        assert mesh is not None
        placed = fitted_to_points(whole.placed, mesh, fit.assembly, points)
        pose, parts, _ = told(placed, whole.seen, whole.parents, fit.assembly, whole.pose)
        return whole._replace(pose=pose, parts=parts, placed=placed)

    def _cut(self, model: Model) -> PartsFit | None:
        if model.mesh is None:
            return None
        surface = replace(model.parameters.surface, samples=self._parameters.samples)
        assembly = assembly_of(model.mesh, surface)
        return None if assembly is None else PartsFit(assembly, self._view, self._parameters)


def explained(fit: PartsFit, model: Model, pose: Pose, blind: bool, *, believed: bool) -> Explained | None:
    """What the scan says of a model placed near `pose`, in parts; blind : no scanner position is known."""
    fitted = fit.fit(pose, believed=believed)
    if fitted is None:
        return None
    parts, seen, parents = fitted
    assembly, parameters, verify = fit.assembly, fit.parameters, fit.view.verify
    reference, fits, kept = told(parts, seen, parents, assembly, pose)
    spared = forgiven(assembly, [part.status for part in fits], seen, parameters.most_missing)
    strained = beyond_bounds(parents, fits, fit)
    evidence = together(fit, model, parts, reference, ~spared)
    reason = why_refused(evidence, blind, verify)
    if not reason and kept < parameters.least_kept:
        reason = f"only {kept:.0%} of what is seen of it keeps to the design, {parameters.least_kept:.0%} is asked for"
    lost = [part.name for part, spare in zip(fits, spared, strict=True) if part.status == MISSING and not spare]
    if not reason and (lost or strained):
        reason = f"{lost[0]} is missing" if lost else f"{strained} is farther off than a part may be"
    return Explained(reference, fits, evidence, reason, parts, seen, parents)


def beyond_bounds(parents: NDArray[np.int64], fits: Sequence[PartFit], fit: PartsFit) -> str:
    """The name of a measured part that has left the one it hangs on farther than parts may; empty where none has."""
    for k, parent in enumerate(parents.tolist()):
        if parent < 0 or {fits[k].status, fits[parent].status} != {MEASURED}:
            continue
        mine, theirs = fits[k].built_from_design, fits[parent].built_from_design
        gap, turn = apart(mine, theirs, place_of(fit.assembly, k, parent))
        if gap > fit.parameters.most_shift_m or np.degrees(turn) > fit.parameters.most_turn_deg:
            return fits[k].name
    return ""


def place_of(assembly: Assembly, one: int, other: int) -> Floats:
    """Where two parts join (3,), model frame; where they do not touch, the middle of the first."""
    places = [joint.place for joint in assembly.joints if {joint.a, joint.b} == {one, other}]
    return places[0] if places else assembly.arrays.centres[one]


def told(
    parts: PlacedParts, seen: Sequence[PartEvidence], parents: NDArray[np.int64], assembly: Assembly, pose: Pose
) -> tuple[Pose, tuple[PartFit, ...], float]:  # fmt: skip
    """The pose of the design, the parts against it, and the share of the surface seen that keeps to it."""
    status = [status_of(one) for one in seen]
    reference, keeps = consensus(parts, seen, status, assembly, pose)
    fits = tuple(
        told_of(k, parts, seen[k], status[k], int(parents[k]), reference, assembly) for k in range(len(seen))
    )  # fmt: skip
    supported = np.array([one.supported for one in seen])
    return reference, fits, float(supported[keeps].sum() / max(supported.sum(), 1))


def status_of(seen: PartEvidence) -> str:
    """Whether a part is measured, missing, or not seen well enough to say."""
    least = max(LEAST_SUPPORTED, LEAST_SHOWN * seen.samples)
    if seen.supported >= least and seen.visible_support() >= THERE:
        return MEASURED
    return MISSING if seen.seen_through >= least and seen.visible_support() < THERE else NOT_SEEN


def consensus(
    parts: PlacedParts, seen: Sequence[PartEvidence], status: Sequence[str], assembly: Assembly, pose: Pose
) -> tuple[Pose, NDArray[np.bool_]]:  # fmt: skip
    """The pose of the design, scene_from_model, that the most surface keeps to, and which parts do, (P,)."""
    measured = np.array([one == MEASURED for one in status])
    weight = np.array([one.supported for one in seen])

    def keeping(reference: Pose) -> NDArray[np.bool_]:
        off = [off_design(parts, k, reference, assembly) for k in range(len(seen))]
        return measured & (np.array(off) <= KEEPS_M)

    tried = [pose, *(parts.pose(int(k)) for k in np.flatnonzero(measured))]
    best = max(tried, key=lambda one: float(weight[keeping(one)].sum()))
    for _ in range(3):
        on = keeping(best)
        better = agreed(parts, np.flatnonzero(on), best, assembly) if on.any() else best
        if weight[keeping(better)].sum() < weight[on].sum():
            break
        best = better
    return best, keeping(best)


def motion_from(parts: PlacedParts, k: int, reference: Pose, assembly: Assembly) -> Floats:
    """How a part is moved from where `reference` has it: (rotation × radius, translation) of its middle, scene axes."""
    centre, radius = assembly.arrays.centres[k], assembly.arrays.radii[k]
    turn = rotation_vector(parts.rotations[k] @ reference.rotation.T)
    shift = parts.pose(k).move(centre[None])[0] - reference.move(centre[None])[0]
    return np.concatenate([turn * radius, shift])


def off_design(parts: PlacedParts, k: int, reference: Pose, assembly: Assembly) -> float:
    """How far the seen surface of a part is from where `reference` has it, across itself, rms, metres."""
    motion, information = motion_from(parts, k, reference, assembly), parts.information[k]
    matched = float(np.trace(information[3:, 3:]))  # unit normals: the sum of the weights
    return float(np.sqrt(max(motion @ information @ motion, 0.0) / matched)) if matched > 0.0 else np.inf


def agreed(parts: PlacedParts, which: NDArray[np.intp], start: Pose, assembly: Assembly) -> Pose:
    """The pose that some parts agree on, each as far as the scan fixes it; one step from `start`."""
    middle = start.move(assembly.arrays.points.mean(axis=0)[None])[0]
    hessian, gradient = np.zeros((6, 6)), np.zeros(6)
    for k in which:
        arm = start.move(assembly.arrays.centres[k][None])[0] - middle
        lever = np.block([[assembly.arrays.radii[k] * np.eye(3), np.zeros((3, 3))], [-skew(arm), np.eye(3)]])
        information = parts.information[k] / parts.noise[k] ** 2
        hessian += lever.T @ information @ lever
        gradient += lever.T @ information @ motion_from(parts, int(k), start, assembly)
    # A part that fixes nothing of some motion leaves it where it is.
    step = np.linalg.solve(hessian + 1e-6 * np.trace(hessian) / 6.0 * np.eye(6), gradient)
    rotation = nearest_rotation(rotation_from_vector(step[:3]) @ start.rotation)
    moved = middle + step[3:] + rotation_from_vector(step[:3]) @ (start.translation - middle)
    return Pose(rotation, moved)


def told_of(
    k: int, parts: PlacedParts, seen: PartEvidence, status: str, parent: int, reference: Pose, assembly: Assembly
) -> PartFit:  # fmt: skip
    """What is reported of one part, in the model's own axes."""
    joined_to = assembly.names[parent] if parent >= 0 else None
    shares = (seen.support(), seen.visible_support(), seen.penalty())
    if status != MEASURED or not parts.information[k].any():
        status = NOT_SEEN if status == MEASURED else status
        none = (0.0, 0.0, 0.0)
        nan = float("nan")
        return PartFit(
            assembly.names[k], status, joined_to, Pose.identity(), none, none, nan, nan, nan, nan, (), *shares
        )
    centre, radius = assembly.arrays.centres[k], float(assembly.arrays.radii[k])
    turned = np.kron(np.eye(2), reference.rotation)
    information = turned.T @ parts.information[k] @ turned
    moved = reference.inverse() @ parts.pose(k)
    arms, normals = moved.turn(assembly.points(k) - centre), moved.turn(assembly.normals(k))
    moving = moved_by(arms, radius)
    # What its shape leaves free is so by exactly that motion: of one side that was seen it is the nearest only.
    rows = np.hstack([np.cross(arms, normals) / radius, normals])
    _, _, by_shape = free_and_held(rows.T @ rows, moving)
    information = by_shape.T @ information @ by_shape
    free, held, fixed = free_and_held(information, moving)
    built_from_design = without(fixed, moved, centre, radius)
    turn, shift = rotation_vector(built_from_design.rotation), built_from_design.move(centre[None])[0] - centre
    covariance = held @ np.linalg.inv(held.T @ information @ held) @ held.T * parts.noise[k] ** 2 / parts.share[k]
    covariance = fixed @ (ALIKE_SHARE * covariance + np.eye(6) * ALIKE_M**2) @ fixed.T
    sigma_shift = float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
    sigma_turn = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])) / radius
    points = assembly.points(k)
    shifts = built_from_design.move(points) - points
    farthest = int(np.argmax(np.linalg.norm(shifts, axis=1)))
    lever = np.hstack([-skew(points[farthest] - centre) / radius, np.eye(3)])
    off, off_sigma = np.linalg.norm(shifts[farthest]), np.sqrt(np.linalg.eigvalsh(lever @ covariance @ lever.T)[-1])
    return PartFit(
        assembly.names[k], status, joined_to, built_from_design, triple(shift), triple(turn),
        float(off), float(off_sigma), sigma_shift, sigma_turn,
        tuple(motion_of(vector, centre, radius) for vector in free.T), *shares,
    )  # fmt: skip


def moved_by(arms: Floats, radius: float) -> Floats:
    """(6, 6): how far motions in (rotation × radius, translation) move N points at `arms` (N, 3), mean square."""
    turns = np.stack([-skew(arm) / radius for arm in arms])
    rows = np.concatenate([turns, np.broadcast_to(np.eye(3), turns.shape)], axis=2).reshape(-1, 6)
    return np.asarray(rows.T @ rows / len(arms)) + 1e-9 * np.eye(6)


def free_and_held(information: Floats, moving: Floats) -> tuple[Floats, Floats, Floats]:
    """The motions the data leave free (6, F), those they hold (6, 6 - F), and a projection (6, 6) on motions without.

    What it leaves does not turn about the axis of a free roll, and does not shift along that of a free slide.
    information : (6, 6) of the matched samples; moving : (6, 6), see `moved_by`
    """
    across = information / np.trace(information[3:, 3:])  # unit normals: the sum of the weights
    scale = np.linalg.inv(np.linalg.cholesky(moving)).T
    shares, vectors = np.linalg.eigh(scale.T @ across @ scale)
    vectors = scale @ vectors
    free, held = vectors[:, shares < FREE_BELOW], vectors[:, shares >= FREE_BELOW]
    # A pipe rolls and slides, and so does any screw: of such, those that turn the most and the least.
    free = free @ np.linalg.svd(free[:3])[2].T if free.shape[1] else free
    rolls = [np.linalg.norm(vector[:3]) > np.linalg.norm(vector[3:]) for vector in free.T]
    along = np.array([
        [*vector[:3], 0.0, 0.0, 0.0] if roll else [0.0, 0.0, 0.0, *vector[3:]]
        for vector, roll in zip(free.T, rolls, strict=True)
    ]).reshape(-1, 6)  # fmt: skip
    return free, held, np.eye(6) - free @ np.linalg.solve(along @ free, along)


def without(fixed: Floats, motion: Pose, centre: Floats, radius: float) -> Pose:
    """A part's motion without what the data leave open; fixed : (6, 6) the projection on what they do not.

    Undone as motions, step by step: the vectors of a roll by 3° and a bend by 5° do not add up by 0.13°.
    """
    for _ in range(4):
        shift = motion.move(centre[None])[0] - centre
        vector = np.concatenate([rotation_vector(motion.rotation) * radius, shift])
        loose = vector - fixed @ vector
        rotation = nearest_rotation(rotation_from_vector(-loose[:3] / radius) @ motion.rotation)
        motion = Pose(rotation, centre + shift - loose[3:] - rotation @ centre)
    return motion


def forgiven(
    assembly: Assembly, status: Sequence[str], seen: Sequence[PartEvidence], most: float
) -> NDArray[np.bool_]:  # fmt: skip
    """Which parts may be missing, (P,): those that join others at two places or more, if they are not too much."""
    joints = np.zeros(len(status), np.int64)
    for joint in assembly.joints:
        joints[[joint.a, joint.b]] += 1
    spared = np.array([one == MISSING for one in status]) & (joints >= 2)
    samples = np.array([one.samples for one in seen])
    return spared if samples[spared].sum() <= most * samples.sum() else np.zeros(len(status), np.bool_)


def together(
    fit: PartsFit, model: Model, parts: PlacedParts, reference: Pose, counted: NDArray[np.bool_]
) -> Evidence:  # fmt: skip
    """The evidence of the parts that are counted, (P,), each where it is, as that of one thing: as of a whole pose."""
    view, assembly = fit.view, fit.assembly
    verify, level, chosen = view.verify, view.fine, np.flatnonzero(counted)
    support = gather_support(
        hypotheses(parts), view.scene, level, view.thin, assembly.arrays, view.signed, verify, ONE_THREAD
    )  # fmt: skip
    seen = [support[k] for k in chosen]
    samples, supported = sum(one.samples for one in seen), sum(one.supported for one in seen)
    squares = sum(one.supported * one.rms**2 for one in seen if one.supported)
    back = [reference.inverse() @ parts.pose(int(k)) for k in chosen]
    points = np.concatenate([pose.move(assembly.points(k)) for pose, k in zip(back, chosen.tolist(), strict=True)])
    normals = np.concatenate([pose.turn(assembly.normals(k)) for pose, k in zip(back, chosen.tolist(), strict=True)])
    assert model.mesh is not None  # else it has no parts
    faces = reference.inverse().move(placed_faces(model.mesh, assembly, parts, counted.tolist()).reshape(-1, 3))
    mesh = Mesh.of(model.name, faces, np.arange(len(faces)).reshape(-1, 3))
    built = replace(model, samples=OrientedCloud(points, normals, model.signed), mesh=mesh)
    limits = Limits(level.inlier, level.margin(verify), verify.least_facing)
    return Evidence(
        samples, supported, sum(one.telling * one.samples for one in seen) / samples,
        float(np.sqrt(squares / supported)) if supported else float("inf"),
        spoken_of(built, caster_of(built), reference, view.scene.beams, limits),
        np.unique(np.concatenate([one.claims for one in seen])), rough=True,
    )  # fmt: skip
