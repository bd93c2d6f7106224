"""All elements where the design has them: what a beam met of one of them says nothing of another.

Steel lies on steel. A plate of 8 mm that is missing leaves the flange it was to lie on, nearer to the plate's place
than free space tells apart.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.evidence.rays import RayCaster
from scanfind.library.near_surface import near_triangles, signed_distances

if TYPE_CHECKING:
    from scanfind.kernels.distance import NearSurface
    from scanfind.mesh import Mesh
    from scanfind.pose import Pose

Floats = NDArray[np.float64]


class Placed(NamedTuple):
    """An element where the design has it: the name of its model, its mesh, and design_from_model."""

    model: str
    mesh: Mesh
    pose: Pose


class Design:
    """All elements where the design has them, in the scans' own frame."""

    def __init__(self, placed: Sequence[Placed]) -> None:
        """Take one element or more."""
        self._placed = tuple(placed)
        self._ready: RayCaster | None = None
        corners = [each.pose.move(each.mesh.vertices) for each in placed]
        self._low, self._high = (np.array([side(some, axis=0) for some in corners]) for side in (np.min, np.max))
        self._names = np.array([each.model for each in placed])
        self._near: dict[str, NearSurface] = {}

    def met(self, model: str, origins: Floats, directions: Floats, ranges: Floats, within: float) -> NDArray[np.bool_]:
        """Which of B beams first met an element that is not of a model, and ended on it, (B,).

        within : of its plane, metres
        """
        hits = self._caster().shoot(origins, directions)
        first = np.isfinite(hits.distance) & (self._names != model)[hits.owner]
        off = np.abs(ranges - np.where(first, hits.distance, 0.0)) * hits.cosine
        return np.asarray(first & (off <= within))

    def off(self, without: Set[str], points: Floats, within: float) -> Floats:
        """How far each of N points (N, 3) is from the nearest element, metres; infinite where farther than `within`.

        without : models whose elements do not count
        """
        found = np.full(len(points), np.inf)
        if not len(points):
            return found
        low, high = points.min(axis=0) - within, points.max(axis=0) + within
        for number in np.flatnonzero(((self._low <= high) & (self._high >= low)).all(axis=1)):
            name, mesh, pose = self._placed[number]
            if name in without:
                continue
            near = ((points >= self._low[number] - within) & (points <= self._high[number] + within)).all(axis=1)
            some = np.flatnonzero(near)
            if not len(some):
                continue
            surface = self._surface(name, mesh)._replace(reach=within)
            apart, _ = signed_distances(surface, pose.inverse().move(points[some]))
            found[some] = np.fmin(found[some], np.abs(apart))  # NaN where it is farther
        return found

    def _caster(self) -> RayCaster:
        """All of them, made ready for beams when first asked for."""
        self._ready = self._ready or RayCaster([(each.mesh, each.pose) for each in self._placed])
        return self._ready

    def _surface(self, name: str, mesh: Mesh) -> NearSurface:
        """The surface of a model, made ready when first asked for."""
        if name not in self._near:
            self._near[name] = near_triangles(mesh.triangles(), 1.0)
        return self._near[name]
