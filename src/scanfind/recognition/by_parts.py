"""What was refused as a whole, tried with each of its parts where it is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.evidence.verify import distances, outlines, score
from scanfind.recognition.claims import Claims
from scanfind.recognition.weighing import NET_PENALTY

if TYPE_CHECKING:
    from scanfind.assembly import Assemblies
    from scanfind.recognition.candidate import Candidate
    from scanfind.recognition.ground import Ground

Floats = NDArray[np.float64]

WEARY = 12  # poses of a model tried in parts, from which on only what comes closer than any of these is tried


class ByParts:
    """Refused poses explained by their parts; apart : (models,) from which on poses are two, metres."""

    def __init__(self, ground: Ground, assemblies: Assemblies, apart: Floats) -> None:
        self._ground, self._assemblies, self._apart = ground, assemblies, apart
        self._tried: list[Candidate] = []

    def explained(self, refused: Sequence[Candidate], believed: Sequence[Candidate]) -> list[Candidate]:
        """Those among the best refused that, with each part where it is, the evidence carries."""
        ground, limits = self._ground, self._ground.parameters.assembly
        found: list[Candidate] = []
        claims = Claims(ground, believed)
        tried = dict.fromkeys(range(len(ground.models)), 0)
        best = {model: max((c.score for c in self._tried if c.model == model), default=0.0) for model in tried}
        weary = {model: sum(c.model == model for c in self._tried) >= WEARY for model in tried}
        for candidate in sorted(refused, key=lambda c: -c.score):
            model = candidate.model
            if candidate.evidence.visible_support() < limits.least_visible or tried[model] >= limits.tried:
                continue
            if claims.hold(candidate):
                continue
            if weary[model] and candidate.score <= best[model]:
                continue
            if any(other.model == model and self._coincide(candidate, other) for other in self._tried):
                continue
            self._tried.append(candidate)
            tried[model] += 1
            whole = self._assemblies.explain(model, candidate.pose())
            if whole is None or whole.reason:
                continue
            net = whole.evidence.telling - NET_PENALTY * whole.evidence.penalty()
            found.append(
                candidate._replace(
                    rotation=whole.pose.rotation, translation=whole.pose.translation, evidence=whole.evidence,
                    score=score(whole.evidence, ground.blind, ground.parameters.verify),
                    area=net * ground.models[model].area, whole=whole,
                )
            )  # fmt: skip
            claims.add(found[-1])
        return found

    def _coincide(self, one: Candidate, other: Candidate) -> bool:
        """Are two poses of one model so near that the fit of parts would lead both to one place?"""
        ground = self._ground
        here, there = (outlines(ground.placements(c.model, [c.pose()]), ground.arrays) for c in (one, other))
        return bool(distances(here[0], there)[0] < self._apart[one.model])
