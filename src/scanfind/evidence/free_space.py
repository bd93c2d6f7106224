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
from scanfind.grid.depth import LEAST_FILLED
from scanfind.library.model import Cover
from scanfind.mesh import Mesh
from scanfind.pose import Pose

if TYPE_CHECKING:
    from scanfind.evidence.neighbours import Design
    from scanfind.grid.depth import Beams, Silence
    from scanfind.library.model import Model

Floats = NDArray[np.float64]
STAYS = np.zeros((1, 3))

# What a beam says of a surface it would have met: see Spoken; a beam a hair within the outline says nothing.
ON, BESIDE, THROUGH, HIDDEN, NOTHING = range(5)

# Beams asked of a pose: a share of them is then known within a half per cent.
MOST_BEAMS = 6000
# A model's samples are more than a scanner needs where they are nearer to each other than so many pixels.
WIDE_PIXELS = 2.0
# Where a beam ended on a surface and on another element as well it speaks for the surface only if that is so much
# nearer, in inliers; and faces that lie on each other are no farther apart than so.
TELLS_APART, FLUSH_M = 0.25, 5e-4
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

    def looked_at(self) -> float:
        """How much surface scanners looked at, m²."""
        return self.on + self.beside + self.through


class Limits(NamedTuple):
    """When a beam is on, beside, through.

    inlier : it met the surface if it ended within so many metres of it, across it
    margin : it passed through if it went on so many metres farther
    facing : least cosine to the surface's normal; a beam that grazes it may bring nothing back
    edge : a beam so near to the outline says nothing if it went on, metres; 0: `inlier`
    """

    inlier: float
    margin: float
    facing: float
    edge: float = 0.0


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


def spoken_of(
    model: Model, caster: RayCaster, placed: Pose, scanners: Sequence[Beams | Silence], limits: Limits
) -> Spoken:
    """What the beams of all scanners say of a model placed by scene_from_model, relative to the grid's offset."""
    return Spoken(*spoken_by_each(model, caster, placed, scanners, limits).sum(axis=0).tolist())


def spoken_by_each(
    model: Model, caster: RayCaster, placed: Pose, scanners: Sequence[Beams | Silence], limits: Limits,
    design: Design | None = None, offset: Floats | None = None, instead_of: str = "",
) -> Floats:  # fmt: skip
    """What the beams of each of S scanners say: rows as of `Spoken`, (S, 4), m²; for the rest see `verdicts`."""
    met = verdicts(model, caster, placed, scanners, limits, design, offset, instead_of)
    said = [met.says == of for of in (ON, BESIDE, THROUGH, HIDDEN)]
    areas = [np.bincount(met.scanner[each], met.area[each], len(scanners)) for each in said]
    return np.stack(areas, axis=1).astype(np.float64)  # of no beams at all numpy counts integers


class Verdicts(NamedTuple):
    """What each of B beams says that would have met a placed model.

    where : (B, 3) the model's surface would have been met, model frame; area : (B,) the surface it speaks for, m²
    scanner : (B,) whose it is; says : (B,) ON, BESIDE, THROUGH, HIDDEN or NOTHING
    """

    where: Floats
    area: Floats
    scanner: NDArray[np.intp]
    says: NDArray[np.uint8]


def verdicts(
    model: Model, caster: RayCaster, placed: Pose, scanners: Sequence[Beams | Silence], limits: Limits,
    design: Design | None = None, offset: Floats | None = None, instead_of: str = "",
) -> Verdicts:  # fmt: skip
    """What beams say of a model placed by scene_from_model, relative to the grid's offset, one by one.

    design, offset : of a model that is in its place in it, what hides it there; the grid's offset, (3,)
    instead_of : the model in whose place it stands, which is not there to hide it
    """
    beams, back = towards(model, placed, scanners), placed.inverse()
    origins, directions = back.move(beams.origins), beams.directions @ placed.rotation
    hits = caster.shoot(origins, directions)
    met = np.flatnonzero((hits.cosine >= limits.facing) & np.isfinite(hits.distance))
    origins, directions, ranges = origins[met], directions[met], beams.ranges[met]
    distance, cosine = hits.distance[met], hits.cosine[met]
    says = np.full(len(met), BESIDE, np.uint8)
    says[ranges < distance - limits.margin] = HIDDEN
    says[np.abs(ranges - distance) * cosine <= limits.inlier] = ON
    # A beam a hair within the outline says nothing: the pose is no better than that.
    passed = np.flatnonzero((ranges > distance + limits.margin) & (says != ON))
    before, apart = ranges[passed] - limits.margin, limits.edge or limits.inlier
    deep = within(caster, origins[passed], directions[passed], before, apart)
    says[passed] = np.where(deep, THROUGH, NOTHING)
    if design is not None:
        some = np.flatnonzero((says == BESIDE) | (says == ON))
        theirs = beams.take(met[some]).moved(np.zeros(3) if offset is None else offset)
        said = of_neighbours(
            design.off({model.name, instead_of}, theirs.ends(), limits.inlier), ranges[some] - distance[some],
            cosine[some], says[some], limits.inlier,
        )  # fmt: skip
        says[some] = said
    where = origins + directions * distance[:, None]
    return Verdicts(where, beams.angles[met] * distance**2 / cosine, beams.scanner[met], says)


def of_neighbours(
    off: Floats, behind: Floats, cosine: Floats, says: NDArray[np.uint8], inlier: float
) -> NDArray[np.uint8]:
    """What beams say that are on a surface or beside it, where another element of the design may have stopped them.

    off : (B,) from their ends to the nearest other element; behind : how far behind the surface they ended, along
        themselves, metres; cosine : of their angle to its normal
    says : ON or BESIDE; inlier : see Limits
    """
    said = says.copy()
    own = np.abs(behind) * cosine
    theirs = off <= np.where(says == ON, own + TELLS_APART * inlier, inlier)
    said[theirs & (says == ON)] = NOTHING
    # Faces that lie on each other hide nothing of each other.
    before = np.where(says == ON, behind * cosine < -TELLS_APART * inlier, behind < -FLUSH_M)
    said[theirs & before] = HIDDEN
    return said


class Towards(NamedTuple):
    """Beams that go towards a model: origins, directions (B, 3), ranges, solid angles of their pixels, whose (B,)."""

    origins: Floats
    directions: Floats
    ranges: Floats
    angles: Floats
    scanner: NDArray[np.intp]

    def take(self, which: NDArray[np.intp]) -> Towards:
        """Some of them."""
        return Towards(
            self.origins[which], self.directions[which], self.ranges[which], self.angles[which], self.scanner[which]
        )

    def moved(self, by: Floats) -> Towards:
        """The same from elsewhere, (3,)."""
        return self._replace(origins=self.origins + by)

    def ends(self) -> Floats:
        """Where they ended, (B, 3)."""
        return self.origins + self.directions * self.ranges[:, None]


def towards(model: Model, placed: Pose, scanners: Sequence[Beams | Silence], short: float = np.inf) -> Towards:
    """The beams that go towards a placed model, MOST_BEAMS of them where there are more; short : see `beams_to`."""
    return beams_to(covers_of(model, placed), scanners, MOST_BEAMS, short)


def covers_of(model: Model, placed: Pose, more: float = 0.0, swept: Floats = STAYS) -> list[Cover]:
    """What covers a placed model, with fewer and fewer points, in the frame of the pose.

    more : metres about it that are to be covered as well; swept : (K, 3) shifts in each of which it is
    """
    return [
        Cover((placed.move(points) + swept[:, None]).reshape(-1, 3), reach + more) for points, reach in model.covers
    ]


def beams_to(
    covers: Sequence[Cover], scanners: Sequence[Beams | Silence], most: float = np.inf, short: float = np.inf
) -> Towards:
    """The beams that go by what is covered, at a little more than the reach of the covers at most; `most` of them where
    there are more.

    covers : of one and the same, with fewer and fewer points
    short : most of those that end more than so many metres before it are left out
    """
    pixels = []
    for scanner in scanners:
        points, reach = covers[0]
        away = float(np.linalg.norm(covers[-1].points - scanner.origin, axis=1).min(initial=np.inf)) - covers[-1].reach
        for fewer in covers[1:]:
            if fewer.reach <= WIDE_PIXELS * 2.0 / scanner.edge * away:
                points, reach = fewer
        pixels.append(scanner.towards(points, reach, short + reach))
    share = min(1.0, most / max(sum(map(len, pixels)), 1))
    asked_for = [Towards(np.empty((0, 3)), np.empty((0, 3)), np.empty(0), np.empty(0), np.empty(0, np.intp))]
    for number, (scanner, some) in enumerate(zip(scanners, pixels, strict=True)):
        if not len(some):
            continue  # most of fifty rooms
        directions, ranges, angles = scanner.beams_in(some[lots(some) < share])
        # Each of those asked stands for those left out, and for those between it and the next that were never sent.
        of_all = share * max(scanner.filled, LEAST_FILLED)
        origins = np.broadcast_to(scanner.origin, directions.shape)
        whose = np.full(len(ranges), number)
        asked_for.append(Towards(origins, directions, ranges, angles / of_all, whose))
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
