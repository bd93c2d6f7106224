"""What is told of what was found: detections and their parts, in the scans' own frame."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.detection import Detection, Motion
from scanfind.fit.refine import covariance_of, triple, unobservable

if TYPE_CHECKING:
    from scanfind.assembly import Assemblies, Explained
    from scanfind.pose import Pose
    from scanfind.recognition.candidate import Candidate
    from scanfind.recognition.ground import Ground

Floats = NDArray[np.float64]


class Telling:
    """What is told of one search's instances."""

    def __init__(self, ground: Ground, assemblies: Assemblies) -> None:
        self._ground, self._assemblies = ground, assemblies
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
