"""A pose that is weighed, and an instance that stands."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.pose import Pose

if TYPE_CHECKING:
    from scanfind.assembly import Explained
    from scanfind.evidence.verify import Evidence
    from scanfind.kernels.distance import NearSurface
    from scanfind.mesh import Placement

Floats = NDArray[np.float64]

REFUSED_SHOWN = 3  # of each model: what came closest

# Refused not for what the scene says of a pose, but for what it says of another one.
OUTWEIGHED = "another pose explains more of the same surface"
SHOWS_LESS = "much less of it lies on the scan than of another instance, and no free space is known to tell why"
FOR_ANOTHER = frozenset({OUTWEIGHED, SHOWS_LESS})


class Candidate(NamedTuple):
    """A refined pose with what the scene says of it.

    model : its number among those sought
    rotation, translation : (3, 3), (3,) scene_from_model, relative to the grid's offset
    hessian, rms : (6, 6) of ICP and what it left, metres, see Refined
    score : 0 … 1; area : supported surface, counted by how much it tells, less what was seen through, m²: by it
        conflicting poses are ranked
    whole : its parts, where they were fitted: of a pose that is believed by them alone
    in_place : the design puts it there; what adjoins it by design may share its surface
    instead_of : the element in whose place it stands, where the two were swapped
    """

    model: int
    rotation: Floats
    translation: Floats
    hessian: Floats
    rms: float
    evidence: Evidence
    score: float
    area: float
    whole: Explained | None = None
    in_place: bool = False
    instead_of: Placement | None = None

    def pose(self) -> Pose:
        """scene_from_model, relative to the grid's offset."""
        return Pose(self.rotation, self.translation)


class Standing(NamedTuple):
    """An instance found by an earlier search, whose surface is taken: asked for distances up to its reach."""

    surface: NearSurface
    scene_from_model: Pose


def closest(refused: list[tuple[Candidate, str]]) -> list[tuple[Candidate, str]]:
    """The best few of each model by score, most convincing first; of poses at nearly one place only the best."""
    kept: list[tuple[Candidate, str]] = []
    for candidate, reason in sorted(refused, key=lambda pair: (-pair[0].score, -pair[0].area)):
        same = [c for c, _ in kept if c.model == candidate.model]
        if len(same) < REFUSED_SHOWN and all(
            np.linalg.norm(c.translation - candidate.translation) > 1e-3
            or np.abs(c.rotation - candidate.rotation).max() > 1e-3
            for c in same
        ):
            kept.append((candidate, reason))
    return kept
