"""What is told of what was found: detections, elements, stations and ends, in the scans' own frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.design.elements import Element, assigned, elements_of, open_slide, placements_of, said_by
from scanfind.detection import Detection, Motion
from scanfind.evidence.ends import slid
from scanfind.fit.refine import covariance_of, triple, unobservable
from scanfind.pose import Pose

if TYPE_CHECKING:
    from scanfind.assembly import Assemblies, Explained
    from scanfind.recognition.candidate import Candidate
    from scanfind.recognition.ground import Ground
    from scanfind.recognition.weighing import Weighing

Floats = NDArray[np.float64]

ALONG = 0.95  # cosine between a slide and one that is the same


class Telling:
    """What is told of one search's instances."""

    def __init__(self, ground: Ground, weighing: Weighing, assemblies: Assemblies) -> None:
        self._ground, self._weighing, self._assemblies = ground, weighing, assemblies
        self._in_parts: dict[int, tuple[int, Explained]] = {}

    def detection(self, number: int, found: Candidate, rival: float) -> Detection:
        """What is told of something believed, under a number, in the scans' own frame; rival : see Detection."""
        whole, probability = found.whole, self._ground.probability(found, rival)
        if self._ground.parameters.assembly.parts and whole is None:
            whole = self._assemblies.explain(found.model, found.pose(), believed=True)
        if whole is not None:
            self._in_parts[number] = found.model, whole
            found = found._replace(rotation=whole.pose.rotation, translation=whole.pose.translation)
        # Of poses that look the same the one whose parts are told: turned over, each would have another's name.
        pose = self._ground.in_scans(found.pose()) if whole else self.pose(found)
        seen, radius = found.evidence, float(self._ground.arrays.radii[found.model])
        pivot = pose.move(self._ground.arrays.centres[found.model][None])[0]
        below = self._ground.parameters.refine.unobservable_below
        return Detection(
            id=number, model=self._ground.models[found.model].name, scene_from_model=pose, score=found.score,
            support=seen.support(), visible_support=seen.visible_support(), penalty=seen.penalty(),
            coverage=seen.support(), rms_m=seen.rms, unobservable=self._unobservable(found),
            covariance=covariance_of(found.hessian, found.rms, radius, below) if np.isfinite(found.rms) else None,
            pivot=triple(pivot), instead_of=found.instead_of.name if found.instead_of else "",
            parts=whole.parts if whole else (), rival=rival, probability=probability,
        )  # fmt: skip

    def elements(self, number: int, detections: Sequence[Detection], stations: Floats) -> list[Element]:
        """What became of each element of the design that is of a model.

        detections : as they are reported; stations : where all of them stood, in order, (S, 3)
        """
        return elements_of(
            self._ground.models[number], detections, lambda pose: self._said_at(number, pose), self._numbers(stations)
        )

    def with_ends(self, number: int, detections: Sequence[Detection]) -> dict[int, Detection]:
        """By id the detections of a model that stand for an element, each `at_its_ends`."""
        model, places = self._ground.models[number], placements_of(self._ground.models[number])
        taken = assigned(model, places, [one for one in detections if one.model == model.name])
        return {one.id: self.at_its_ends(number, one, places[place].design_from_model) for place, one in taken.items()}

    def at_its_ends(self, number: int, found: Detection, design: Pose) -> Detection:
        """A detection slid to where beams say its ends are, where its faces do not tell and they refute the design's.

        design : scene_from_model as the design has it, in the scans' own frame
        """
        model, placed = self._ground.models[number], found.scene_from_model
        along = open_slide(model, found)
        if along is None or self._ground.blind or found.parts or found.covariance is None or found.pivot is None:
            return found
        centre = model.symmetry.centre[None]
        alike = model.symmetry.nearest(design, placed.rotation)
        from_here = float((alike.move(centre) - placed.move(centre))[0] @ along)
        ground, weighing = self._ground, self._weighing
        told = slid(
            model, weighing.caster(number), ground.in_grid(placed), along, from_here, ground.scene.beams,
            weighing.limits(), weighing.design, ground.offset,
        )  # fmt: skip
        if told is None:
            return found
        step, covariance = told.by * along, found.covariance.copy()
        covariance[3:, 3:] += told.sigma**2 * np.outer(along, along)
        own = placed.rotation.T @ along
        others = [each for each in found.unobservable if each.kind != "slide" or abs(np.dot(each.axis, own)) < ALONG]
        return replace(
            found, scene_from_model=Pose(placed.rotation, placed.translation + step), covariance=covariance,
            pivot=triple(np.array(found.pivot) + step), slide=triple(along),
            unobservable=(*others, Motion("slide", triple(own), triple(centre[0]), told.sigma)),
        )  # fmt: skip

    def with_stations(self, number: int, found: Detection, stations: Floats) -> Detection:
        """A detection of a model with what each station says of it; stations : see `elements`."""
        said = self._said_at(number, found.scene_from_model)
        return replace(found, stations=said_by(said, self._numbers(stations)))

    def _said_at(self, number: int, pose: Pose) -> Floats:
        """What the beams of each scanner say of a model at a pose in the scans' own frame: see Weighing."""
        here, in_place = self._ground.in_grid(pose), self._weighing.design is not None
        return self._weighing.said_by_each(number, here, in_place=in_place)

    def _numbers(self, stations: Floats) -> list[int]:
        """Of each scanner the number, from 1, of the station that stood where it did."""
        stood = [scanner.origin + self._ground.offset for scanner in self._ground.scene.beams]
        return [1 + int(np.nanargmin(np.linalg.norm(stations - where, axis=1))) for where in stood]

    def built(self) -> dict[int, Floats]:
        """By detection, where it was fitted in parts: its faces (F, 3, 3) as built, scan frame, metres."""
        offset = self._ground.offset
        return {k: self._assemblies.faces(*of) + offset for k, of in self._in_parts.items()}

    def measured(self, found: Detection, points: Floats | None) -> Detection:
        """A detection with its parts fitted to raw points (N, 3) around it, scan frame; None: it has no parts."""
        if points is None:
            return found
        model, whole = self._in_parts[found.id]
        whole = self._assemblies.measured(model, whole, points - self._ground.offset)
        self._in_parts[found.id] = model, whole
        return replace(found, scene_from_model=self._ground.in_scans(whole.pose), parts=whole.parts)

    def pose(self, found: Candidate) -> Pose:
        """In the scans' own frame; of the poses that look the same always one, however it was come by."""
        return self._ground.models[found.model].symmetry.canonical(self._ground.in_scans(found.pose()))

    def _unobservable(self, found: Candidate) -> tuple[Motion, ...]:
        """In the model's own axes."""
        turn = np.zeros((6, 6))
        turn[:3, :3] = turn[3:, 3:] = self.pose(found).rotation
        arrays, below = self._ground.arrays, self._ground.parameters.refine.unobservable_below
        centre, radius = arrays.centres[found.model], float(arrays.radii[found.model])
        return unobservable(turn.T @ found.hessian @ turn, centre, radius, below)
