"""Free space: what the scanners' beams say of a placed model, beam by beam.

Each beam is held against the model itself: where should it have met it, and where did it go? Samples held against the
pixels of a depth map (Papazov & Burschka 2010) are wrong along every edge, and a frame or a pipe is mostly edge.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanfind.evidence.rays import RayCaster
from scanfind.mesh import Mesh
from scanfind.pose import Pose

if TYPE_CHECKING:
    from scanfind.grid.depth import Beams
    from scanfind.library.model import Model

Floats = NDArray[np.float64]

# Beams asked of a pose: a share of them is then known within a half per cent.
MOST_BEAMS = 6000
# Pixels this many sample spacings about each sample cover a model: no point of it is farther from one than 1.
REACH_SPACINGS = 1.0
# A piece of scan has no triangles: each of its samples stands for a square so many spacings wide.
SQUARE_SPACINGS = 1.0


class Spoken(NamedTuple):
    """How much of a placed model's surface beams speak of, m².

    on : they met it; beside : they met something within the margin, but not it; through : they went on behind it
    hidden : they stopped before it
    """

    on: float
    beside: float
    through: float
    hidden: float


class Limits(NamedTuple):
    """When a beam is on, beside, through.

    inlier : it met the surface if it ended within so many metres of it, across it
    margin : it passed through if it went on so many metres farther
    facing : least cosine to the surface's normal; a beam that grazes it may bring nothing back
    """

    inlier: float
    margin: float
    facing: float


def caster_of(model: Model) -> RayCaster:
    """A model's surface in its own frame, ready to be met by beams."""
    if model.mesh is not None:
        return RayCaster([(model.mesh, Pose.identity())])
    points, normals = model.samples.points, model.samples.normals
    across = np.cross(normals, np.where(np.abs(normals[:, :1]) < 0.6, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]))
    across *= 0.5 * SQUARE_SPACINGS * model.spacing / np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(normals, across)
    corners = np.stack([points - across - along, points + across - along, points + across + along,
                        points - across + along], axis=1)  # fmt: skip
    faces = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(len(points))[:, None, None]
    squares = Mesh(model.name, corners.reshape(-1, 3), faces.reshape(-1, 3).astype(np.int32), model.source)
    return RayCaster([(squares, Pose.identity())])


def spoken_of(model: Model, caster: RayCaster, placed: Pose, scanners: Sequence[Beams], limits: Limits) -> Spoken:
    """What the beams of all scanners say of a model placed by scene_from_model, relative to the grid's offset."""
    beams = towards(model, placed, scanners)
    if not len(beams.ranges):
        return Spoken(0.0, 0.0, 0.0, 0.0)
    back = placed.inverse()
    origins, directions = back.move(beams.origins), beams.directions @ placed.rotation
    hits = caster.shoot(origins, directions)
    met = np.flatnonzero((hits.cosine >= limits.facing) & np.isfinite(hits.distance))
    distance, cosine, ranges = hits.distance[met], hits.cosine[met], beams.ranges[met]
    area = beams.angles[met] * distance**2 / cosine
    through, hidden = ranges > distance + limits.margin, ranges < distance - limits.margin
    on = np.abs(ranges - distance) * cosine <= limits.inlier
    # A beam a hair within the outline says nothing: the pose is no better than that.
    passed = np.flatnonzero(through)
    deep = within(caster, origins[met[passed]], directions[met[passed]], ranges[passed] - limits.margin, limits.inlier)
    edge = np.zeros(len(met), np.bool_)
    edge[passed[~deep]] = True
    beside = ~(on | through | hidden)
    return Spoken(*(float(area[which & ~edge].sum()) for which in (on, beside, through, hidden)))


class Towards(NamedTuple):
    """Beams that go towards a model: origins, directions (B, 3), ranges, solid angles of their pixels (B,)."""

    origins: Floats
    directions: Floats
    ranges: Floats
    angles: Floats

    def ends(self) -> Floats:
        """Where they ended, (B, 3)."""
        return self.origins + self.directions * self.ranges[:, None]


def towards(model: Model, placed: Pose, scanners: Sequence[Beams]) -> Towards:
    """The beams that go towards a placed model, MOST_BEAMS of them where there are more."""
    from scanfind.kernels.beams import beams_of, pixels_towards

    points, reach, pixels = placed.move(model.samples.points), REACH_SPACINGS * model.spacing, []
    for scanner in scanners:
        met, found = np.zeros(len(scanner.nearest), np.bool_), np.empty(len(scanner.nearest), np.int64)
        count = pixels_towards(points, scanner.origin, reach, scanner.edge, scanner.nearest, met, found)
        pixels.append(found[:count])
    share = min(1.0, MOST_BEAMS / max(sum(map(len, pixels)), 1))
    asked_for = [Towards(np.empty((0, 3)), np.empty((0, 3)), np.empty(0), np.empty(0))]
    for scanner, some in zip(scanners, pixels, strict=True):
        asked = some[lots(some) < share]
        directions, ranges, angles = np.empty((len(asked), 3)), np.empty(len(asked)), np.empty(len(asked))
        beams_of(asked, scanner.nearest, scanner.edge, directions, ranges, angles)
        # Each of those asked stands for as many as were left out.
        origins = np.broadcast_to(scanner.origin, directions.shape)
        asked_for.append(Towards(origins, directions, ranges, angles / share))
    return Towards(*(np.concatenate(column) for column in zip(*asked_for, strict=True)))


def lots(numbers: NDArray[np.int64]) -> Floats:
    """A number in 0 … 1 for each of some numbers, the same for the same one, without pattern (Fibonacci hashing)."""
    mixed = numbers.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    return (mixed >> np.uint64(11)).astype(np.float64) / 2.0**53


def within(caster: RayCaster, origins: Floats, directions: Floats, before: Floats, apart: float) -> NDArray[np.bool_]:
    """Which rays would meet the surface `before` so many metres (B,) moved `apart` metres to any side as well."""
    deep = np.ones(len(directions), np.bool_)
    if not len(directions):
        return deep
    side = np.cross(directions, np.where(np.abs(directions[:, :1]) < 0.6, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]))
    side *= apart / np.linalg.norm(side, axis=1, keepdims=True)
    for step in (side, -side, other := np.cross(directions, side), -other):
        deep &= caster.shoot(origins + step, directions).distance < before
    return deep
