"""Which surface of the scene belongs to what is believed: no two instances share it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scanfind.library.near_surface import signed_distances

if TYPE_CHECKING:
    from scanfind.recognition.candidate import Candidate, Standing
    from scanfind.recognition.ground import Ground

CLAIM_CELLS = 2  # a detection claims the surfels up to so many cells around those that support its samples


class Claims:
    """The rows of the fine cells that poses claim; marked : (rows,)."""

    def __init__(self, ground: Ground, claimants: Iterable[Candidate] = ()) -> None:
        self._ground, self.marked = ground, ground.no_rows()
        for candidate in claimants:
            self.add(candidate)

    def add(self, candidate: Candidate) -> None:
        """Mark the cells a pose claims: its samples are too few to name every cell of its surface themselves."""
        claims, scene = candidate.evidence.claims, self._ground.scene
        if len(claims):
            self._ground.mark(scene.fine.means[claims], CLAIM_CELLS, self.marked)
        else:  # so sparse that coarse cells and lines speak alone
            samples = self._ground.models[candidate.model].samples.points
            self._ground.mark(candidate.pose().move(samples), CLAIM_CELLS, self.marked)

    def hold(self, candidate: Candidate) -> bool:
        """Is too much of what supports a pose claimed already?"""
        fine = self._ground.scene.fine
        claims: NDArray[Any] = fine.cells.rows[fine.cell_of[candidate.evidence.claims]]
        if not len(claims):
            claims = Claims(self._ground, [candidate]).marked
            if not claims.any():
                return True
        return bool(self.marked[claims].mean() > self._ground.parameters.verify.shared)


def stands_elsewhere(candidate: Candidate, standing: Sequence[Standing], ground: Ground) -> bool:
    """Does too much of what supports a pose belong to an instance of a larger model?"""
    points = ground.scene.fine.means[candidate.evidence.claims] + ground.offset
    return any(
        float(np.isfinite(signed_distances(one.surface, one.scene_from_model.inverse().move(points))[0]).mean())
        > ground.parameters.verify.shared
        for one in standing
    )
