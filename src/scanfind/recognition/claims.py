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
        # All at once: each marking passes over the whole scene, and a design has hundreds of elements.
        if some := [self._claimed(candidate) for candidate in claimants]:
            ground.mark(np.concatenate(some), CLAIM_CELLS, self.marked)

    def add(self, candidate: Candidate) -> None:
        """Mark the cells a pose claims."""
        self._ground.mark(self._claimed(candidate), CLAIM_CELLS, self.marked)

    def _claimed(self, candidate: Candidate) -> NDArray[np.float64]:
        """Points (N, 3) about which a pose claims cells: its samples are too few to name all of its surface's."""
        claims = candidate.evidence.claims
        if len(claims):
            return self._ground.scene.fine.means[claims]
        # So sparse that coarse cells and lines speak alone.
        return candidate.pose().move(self._ground.models[candidate.model].samples.points)

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
