"""Refined poses weighed: what surfels, beams and lines say of each."""

from __future__ import annotations

from dataclasses import replace
from itertools import chain
from math import ceil
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.evidence.free_space import Limits, Spoken
from scanfind.evidence.verify import Evidence, Level, gather_rough, gather_support, rough_score, score
from scanfind.pose import Pose
from scanfind.recognition.candidate import Candidate
from scanfind.recognition.witnesses import Witnesses
from scanfind.threads import in_threads

if TYPE_CHECKING:
    from scanfind.evidence.neighbours import Design
    from scanfind.evidence.verify import Rough, VerifyParameters
    from scanfind.fit.refine import Refined
    from scanfind.recognition.ground import Ground
    from scanfind.search.hypotheses import Hypotheses
    from scanfind.search.lines import LineSearch

Floats = NDArray[np.float64]

ALL_SAMPLES = 1 << 30
# Share of the score asked for that the evidence on the coarse surfels must reach: there 400 samples tell the final
# score of a shop's 96 best poses within 0.2.
PROMISING = 0.67
NET_PENALTY = 2.0
# Before ICP a hypothesis may lie so many coarse cells off the scene; a beam through it counts so much against it.
DRAWN_CELLS, ROUGH_PENALTY = 0.5, 3.0
TOLD_BY_LINES = 12  # poses that these speak for, refined whatever the coarse surfels say


class Weighing:
    """What the scene says of poses.

    witnesses : its scanners
    lines : what lines say, once these were asked
    """

    def __init__(self, ground: Ground, tells: tuple[Floats, Floats], design: Design | None) -> None:
        """Take a scene; tells : how much its fine and coarse surfels tell (Search.telling); design : see Witnesses."""
        self._ground = ground
        self.lines: LineSearch | None = None
        scene, parameters = ground.scene, ground.parameters
        inlier = parameters.verify.inlier_noises * scene.noise
        inliers = [inlier + parameters.verify.inlier_cells * level.cell for level in (scene.fine, scene.coarse)]
        self.fine = Level(scene.fine, tells[0], ALL_SAMPLES, inliers[0])
        self.thin = Level(scene.coarse, tells[1], ALL_SAMPLES, inliers[0])
        self._rough = Level(scene.coarse, tells[1], parameters.refine.coarse_samples, inliers[1])
        self._drawn = self._rough._replace(inlier=DRAWN_CELLS * scene.coarse.cell)
        limits = Limits(self.fine.inlier, self.fine.margin(parameters.verify), parameters.verify.least_facing)
        self.witnesses = Witnesses(scene.beams, ground.offset, limits, design)

    def candidates(self, refined: Refined, *, in_place: bool = False, instead_of: str = "") -> list[Candidate]:
        """Refined poses with their evidence.

        in_place : of where the design puts the models; instead_of : the model in whose place they stand
        """
        self._ground.fit_near(refined.hypotheses, ceil(self._ground.parameters.verify.gate_cells))
        found, models, blind, verify = [], self._ground.models, self._ground.blind, self._ground.parameters.verify
        for k, seen in enumerate(self._evidence(refined.hypotheses, in_place, instead_of)):
            number = int(refined.hypotheses.models[k])
            # What a pose explains of the scene, in samples; what beams passed through counts double.
            net = (seen.telling - NET_PENALTY * seen.penalty()) * seen.samples
            found.append(
                Candidate(
                    number, refined.hypotheses.rotations[k], refined.hypotheses.translations[k], refined.hessians[k],
                    float(refined.rms[k]), seen, score(seen, blind, verify, in_place=in_place),
                    net * models[number].area_of_a_sample(), in_place=in_place,
                )
            )  # fmt: skip
        return found

    def _evidence(self, hypotheses: Hypotheses, in_place: bool, instead_of: str) -> list[Evidence]:
        """What surfels and beams say of poses near which the fine surfels are fitted; for the rest see `candidates`."""
        ground, verify = self._ground, self._ground.parameters.verify
        support = gather_support(
            hypotheses, ground.scene, self.fine, self.thin, ground.arrays, ground.signed, verify, ground.jobs
        )  # fmt: skip
        lines = self.lines.beyond_chance(hypotheses) if self.lines else np.zeros(len(support))
        poses = list(zip(*hypotheses[:3], strict=True))
        spoken = in_threads(
            ground.jobs, len(poses),
            lambda start, stop: [
                self.spoken_of(int(number), Pose(rotation, translation), in_place=in_place, instead_of=instead_of)
                for number, rotation, translation in poses[start:stop]
            ],
        )  # fmt: skip
        return [
            Evidence(*seen[:-1], said, seen.claims, float(on_lines), ground.models[number].mesh is None)
            for seen, said, on_lines, number in zip(support, chain(*spoken), lines, hypotheses.models, strict=True)
        ]

    def spoken_of(self, number: int, placed: Pose, *, in_place: bool = False, instead_of: str = "") -> Spoken:
        """What beams say of a model at a pose relative to the grid's offset; for the rest see `candidates`."""
        model = self._ground.models[number]
        by_each = self.witnesses.say_by_each(model, placed, in_place=in_place, instead_of=instead_of)
        return Spoken(*by_each.sum(axis=0).tolist())

    def best_drawn(self, hypotheses: Hypotheses) -> Hypotheses:
        """The same, best first, by what coarse surfels and beams say of them as they were drawn.

        The test asks whether there is anything at all; of a spool of which a third shows, the best right pose was on
        average the 36th of the distinct ones that passed it, and is the 8th so.
        """
        refine = self._ground.parameters.refine
        as_icp_begins = replace(
            self._ground.parameters.verify, gate_cells=refine.coarse_gates[0],
            normal_agreement=refine.normal_agreement, margin_inliers=1.0,
        )  # fmt: skip
        net = [net_of(seen) for seen in self._roughly(hypotheses, self._drawn, as_icp_begins)]
        return hypotheses.take(np.argsort(net, kind="stable")[::-1])

    def best_fitted(self, hypotheses: Hypotheses) -> Hypotheses:
        """The same, best first, by what coarse surfels and beams say of them after ICP on these."""
        net = [net_of(seen) for seen in self._roughly(hypotheses, self._rough, self._ground.parameters.verify)]
        return hypotheses.take(np.argsort(net, kind="stable")[::-1])

    def promising(self, hypotheses: Hypotheses, least: int) -> NDArray[np.intp]:
        """Those whose evidence on the coarse surfels is not hopeless, and the best `least` of each model (indices).

        Of a part that shows little few samples speak, and what these say of the silent ones is a guess.
        """
        ground, verify = self._ground, self._ground.parameters.verify
        rough = self._roughly(hypotheses, self._rough, verify)
        scores, net = np.array([(rough_score(seen, ground.blind), net_of(seen)) for seen in rough]).reshape(-1, 2).T
        kept = scores >= PROMISING * verify.min_score
        for model in np.unique(hypotheses.models):
            theirs = np.flatnonzero(hypotheses.models == model)
            kept[theirs[np.argsort(-net[theirs], kind="stable")[:least]]] = True
        if self.lines:
            # A pose on lines is half a cell off until it is fitted to beams, and looks worse than it is.
            told = self.lines.beyond_chance(hypotheses)
            best = np.argsort(-told, kind="stable")[:TOLD_BY_LINES]
            kept[best[told[best] > 0.0]] = True
        return np.flatnonzero(kept)

    def _roughly(self, hypotheses: Hypotheses, level: Level, verify: VerifyParameters) -> list[Rough]:
        """What a level of coarse surfels and the depth maps say of each."""
        ground = self._ground
        return gather_rough(hypotheses, ground.scene, level, ground.arrays, ground.signed, verify, ground.jobs)


def net_of(seen: Rough) -> float:
    """Share of samples that are on the coarse surfels, less that of what beams passed through, by its weight."""
    return (seen.supported - ROUGH_PENALTY * seen.seen_through) / seen.samples
