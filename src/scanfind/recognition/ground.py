"""What all steps of a search stand on: the scene, the models sought with their samples, the parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.evidence.confidence import probability, weighed_as_measured
from scanfind.evidence.verify import why_refused
from scanfind.pose import Pose
from scanfind.priors.allowed import why_not
from scanfind.search.hypotheses import Hypotheses

if TYPE_CHECKING:
    from scanfind.grid.scene import Scene
    from scanfind.library.model import Model
    from scanfind.parameters import Parameters
    from scanfind.recognition.candidate import Candidate
    from scanfind.search.hypotheses import ModelArrays

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Ground:
    """What all steps of a search stand on; poses in it are relative to the grid's offset."""

    scene: Scene
    models: Sequence[Model]
    arrays: ModelArrays
    parameters: Parameters
    jobs: int

    @property
    def signed(self) -> bool:
        """Is the side known that all normals are of, the scene's and the models'?"""
        return self.scene.fine.signed and all(model.signed for model in self.models)

    @property
    def blind(self) -> bool:
        """Is no scanner position known, so that free space says nothing?"""
        return not self.scene.depths

    @property
    def offset(self) -> Floats:
        """Of the grid, (3,), metres in the scans' own frame."""
        return self.scene.fine.cells.offset

    def in_scans(self, pose: Pose) -> Pose:
        """A pose in the scans' own frame."""
        return Pose(pose.rotation, pose.translation + self.offset)

    def in_grid(self, pose: Pose) -> Pose:
        """A pose of the scans' own frame, relative to the grid's offset."""
        return Pose(pose.rotation, pose.translation - self.offset)

    def placements(self, model: int, poses: Sequence[Pose]) -> Hypotheses:
        """Poses of one model as hypotheses."""
        count = len(poses)
        return Hypotheses(
            np.full(count, model), np.array([p.rotation for p in poses]), np.array([p.translation for p in poses]),
            np.ones(count),
        )  # fmt: skip

    def apart(self, one: Candidate, other: Candidate) -> float:
        """How far the sample that two poses of one model part the most is from where it was, metres."""
        points = self.models[one.model].samples.points
        moved = points @ (one.rotation - other.rotation).T + one.translation - other.translation
        return float(np.linalg.norm(moved, axis=1).max())

    def why_not_allowed(self, candidate: Candidate) -> str:
        """Why what is known beforehand speaks against a pose, in words; empty where it does not."""
        return why_not(self.models[candidate.model], self.parameters.priors, self.in_scans(candidate.pose()))

    def why_refused(self, candidate: Candidate) -> str:
        """Why the evidence does not carry a pose found anywhere; empty where it does."""
        return why_refused(candidate.evidence, self.blind, self.parameters.verify)

    def probability(self, candidate: Candidate, rival: float, *, outweighed: bool = False) -> float:
        """How likely a pose is right; rival : see Detection; outweighed : see `curve_of`.

        NaN where nobody measured: in its place by design, believed by its parts, of a piece of scan, weighed otherwise.
        """
        other = candidate.in_place or candidate.whole is not None or candidate.evidence.rough
        if other or not weighed_as_measured(self.parameters.verify):
            return nan
        return probability(candidate.score, rival, blind=self.blind, outweighed=outweighed)

    def why_not_believed(self, candidate: Candidate) -> str:
        """Why the one or the other speaks against a pose; empty where neither does."""
        return self.why_not_allowed(candidate) or self.why_refused(candidate)

    def no_rows(self) -> NDArray[np.bool_]:
        """No row of the fine cells, to be marked."""
        return np.zeros(len(self.scene.fine.sides), np.bool_)

    def mark(self, points: Floats, reach: int, marked: NDArray[np.bool_]) -> None:
        """Mark the rows of the fine cells up to `reach` cells from points (N, 3)."""
        from scanfind.kernels.nearest import mark_around, mark_rows

        at = self.scene.fine.cells
        layers = np.zeros((len(at.filled), 8), np.uint64)
        mark_around(points, reach, at.cell, at.hash_keys, at.hash_values, layers)
        mark_rows(at.order, layers, at.block_rows, marked)

    def fit_near(self, hypotheses: Hypotheses, reach: int) -> None:
        """Fit the fine surfels up to `reach` cells from the placed samples of some poses."""
        placed, starts = [np.empty((0, 3))], self.arrays.starts
        for number, rotation, translation in zip(*hypotheses[:3], strict=True):
            samples = self.arrays.points[starts[number] : starts[number + 1]]
            placed.append(samples @ rotation.T + translation)
        near = self.no_rows()
        self.mark(np.concatenate(placed), reach, near)
        self.scene.fine.fit(near[self.scene.fine.cells.rows])
