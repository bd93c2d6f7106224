"""Scanners as witnesses: what their beams say of models at poses. No surfels are asked, so any process can."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.design.elements import Element, assigned, elements_of, open_slide, placements_of, said_by
from scanfind.detection import Detection, Motion
from scanfind.evidence.ends import Slid, slid, with_faces
from scanfind.evidence.free_space import (
    ON,
    THROUGH,
    Limits,
    beams_to,
    caster_of,
    covers_of,
    spoken_by_each,
    spoken_of,
    verdicts,
)  # fmt: skip
from scanfind.fit.patches import measured
from scanfind.fit.refine import triple
from scanfind.pose import Pose

if TYPE_CHECKING:
    from scanfind.evidence.neighbours import Design
    from scanfind.evidence.rays import RayCaster
    from scanfind.grid.depth import Beams
    from scanfind.kernels.distance import NearSurface
    from scanfind.library.model import Model

Floats = NDArray[np.float64]

EDGE_INLIERS = 2.0  # a laser's spot is a centimetre wide at 10 m: nearer to the outline some of it went past
MOVED_M = 0.01  # an element that is so far off across a slide was moved: along it nothing says that it was not
MOST_ABOUT = 20_000  # beams asked for what stands about a place; what is so near to a neighbour may be the neighbour's
NEIGHBOUR_INLIERS = 1.5
ALONG = 0.95  # cosine between a slide and one that is the same


@dataclass(frozen=True, eq=False)
class Witnesses:
    """The scanners of a scene.

    beams : what each of S of them saw, relative to the grid's offset
    offset : (3,) of the grid, metres in the scans' own frame
    limits : when a beam is on a surface, beside it, or through
    design : all elements where the design has them; None where nobody asks for them in their places
    """

    beams: Sequence[Beams]
    offset: Floats
    limits: Limits
    design: Design | None
    _casters: dict[str, RayCaster] = field(default_factory=dict, init=False)

    def say_by_each(self, model: Model, placed: Pose, *, in_place: bool = False, instead_of: str = "") -> Floats:
        """What each says of a model at a pose relative to the grid's offset, rows as of Spoken, (S, 4), m².

        in_place : of where the design puts it; instead_of : the model in whose place it stands
        """
        return spoken_by_each(model, *self._asks(model, placed, in_place=in_place), instead_of)

    def met(self, model: Model, placed: Pose) -> tuple[Floats, Floats]:
        """Where beams meet a model as the design puts it, (N, 3) in the scans' own frame, and of how much, (N,) m²."""
        met = verdicts(model, *self._asks(model, placed, in_place=True))
        on = met.says == ON
        return placed.move(met.where[on]) + self.offset, met.area[on]

    def unexplained(self, model: Model, placed: Pose, surface: NearSurface) -> tuple[Floats, Floats]:
        """Where beams ended about a model as the design puts it and on no other element of the design.

        surface : of the model; as far as it reaches beams are asked for
        Returns (N, 3) relative to the grid's offset, and of how much, (N,) m²: less than it is where they graze it.
        """
        about = covers_of(model, placed, more=surface.reach)
        beams = beams_to(about, self.beams, MOST_ABOUT, short=surface.reach)
        ends, areas = beams.ends(), beams.angles * beams.ranges**2
        near = np.flatnonzero(measured(surface, placed, ends, 1)[1] >= 0)
        if self.design is not None:
            within = NEIGHBOUR_INLIERS * self.limits.inlier
            near = near[np.isinf(self.design.off({model.name}, ends[near] + self.offset, within))]
        return ends[near], areas[near]

    def _asks(
        self, model: Model, placed: Pose, *, in_place: bool
    ) -> tuple[RayCaster, Pose, Sequence[Beams], Limits, Design | None, Floats]:
        """What beams are asked of a model with: see `verdicts`."""
        limits = self.limits._replace(edge=EDGE_INLIERS * self.limits.inlier) if in_place else self.limits
        design = self.design if in_place else None
        return self._caster(model), placed, self.beams, limits, design, self.offset

    def say_at(self, model: Model, pose: Pose) -> Floats:
        """What each says of a model at a pose in the scans' own frame: as `say_by_each`, in place where asked so."""
        return self.say_by_each(model, self._in_grid(pose), in_place=self.design is not None)

    def among(self, design: Design | None) -> Witnesses:
        """The same scanners, where elements stand as in another design."""
        told = replace(self, design=design)
        told._casters.update(self._casters)
        return told

    def say_of_place(self, model: Model, pose: Pose, is_there: bool) -> Floats:
        """What each says of a model where the design puts it, as `say_at`; where it was not found, beams that did not
        come back from there passed through.
        """
        said = self.say_at(model, pose)
        if not is_there:
            said[:, THROUGH] += self.silent_at(model, pose, said)
        return said

    def silent_at(self, model: Model, pose: Pose, said: Floats) -> Floats:
        """The surface of a model at a pose, scans' own frame, from which a beam of each of S scanners should have come
        back and none did, (S,) m².

        said : (S, 4) of the beams that did, as of `say_at`: so many are silent on any surface, and are left out
        """
        caster, placed, found = self._caster(model), self._in_grid(pose), []
        for beams, came in zip(self.beams, said.sum(axis=1), strict=True):
            silence = beams.silence
            through = spoken_of(model, caster, placed, [silence], self.limits).through if silence.where.any() else 0.0
            found.append(max(0.0, through - came * (1.0 - beams.filled)))
        return np.array(found)

    def elements(self, model: Model, detections: Sequence[Detection], stations: Floats) -> list[Element]:
        """What became of each element of the design that is of a model.

        The elements of the design these know should stand as they were found (see `among`): what one that was moved
        stopped says nothing of another's place.

        detections : as they are reported; stations : where all of them stood, in order, (S, 3)
        """
        places = placements_of(model)
        taken = assigned(model, places, detections)
        said = [self.say_of_place(model, each.design_from_model, k in taken) for k, each in enumerate(places)]
        return elements_of(model, detections, said, self.numbers(stations))

    def with_ends(self, model: Model, detections: Sequence[Detection]) -> dict[int, Detection]:
        """By id the detections of a model that stand for an element, each `at_its_ends`."""
        places = placements_of(model)
        taken = assigned(model, places, detections)
        return {one.id: self.at_its_ends(model, one, places[place].design_from_model) for place, one in taken.items()}

    def at_its_ends(self, model: Model, found: Detection, design: Pose) -> Detection:
        """A detection slid to where beams say its ends are, where its faces do not tell and they refute the design's.

        design : scene_from_model as the design has it, in the scans' own frame
        """
        placed, along = found.scene_from_model, open_slide(model, found)
        if along is None or not self.beams or found.parts or found.covariance is None or found.pivot is None:
            return found
        centre = model.symmetry.centre[None]
        alike = model.symmetry.nearest(design, placed.rotation)
        shift = (alike.move(centre) - placed.move(centre))[0]
        from_here = float(shift @ along)
        stayed = np.linalg.norm(shift - from_here * along) < MOVED_M
        told = self.slid(model, self._in_grid(placed), along, from_here if stayed else None)
        if told is None:
            return found
        # What faces say of one motion is a variance only where they say something of all.
        by_faces = 0.0
        if all(each.sigma is not None for each in found.unobservable):
            by_faces = float(along @ found.covariance[3:, 3:] @ along)
        told = with_faces(told, by_faces)
        step = told.by * along
        own = placed.rotation.T @ along
        others = [each for each in found.unobservable if each.kind != "slide" or abs(np.dot(each.axis, own)) < ALONG]
        return replace(
            found, scene_from_model=Pose(placed.rotation, placed.translation + step),
            covariance=known_along(found.covariance, along, by_faces, told.sigma**2),
            pivot=triple(np.array(found.pivot) + step), slide=triple(along),
            unobservable=(*others, Motion("slide", triple(own), triple(centre[0]), told.sigma)),
        )  # fmt: skip

    def slid(self, model: Model, placed: Pose, along: Floats, design: float | None) -> Slid | None:
        """How far a model at a pose relative to the grid's offset has to slide along a direction: see `ends.slid`."""
        caster = self._caster(model)
        return slid(model, caster, placed, along, design, self.beams, self.limits, self.design, self.offset)

    def with_stations(self, model: Model, found: Detection, stations: Floats) -> Detection:
        """A detection of a model with what each station says of it; stations : see `elements`."""
        said = self.say_at(model, found.scene_from_model)
        return replace(found, stations=said_by(said, self.numbers(stations)))

    def numbers(self, stations: Floats) -> list[int]:
        """Of each scanner the number, from 1, of the station that stood where it did; stations : see `elements`."""
        stood = [scanner.origin + self.offset for scanner in self.beams]
        return [1 + int(np.nanargmin(np.linalg.norm(stations - where, axis=1))) for where in stood]

    def _in_grid(self, pose: Pose) -> Pose:
        return Pose(pose.rotation, pose.translation - self.offset)

    def _caster(self, model: Model) -> RayCaster:
        """The surface of a model, made ready for beams when first asked for."""
        if model.name not in self._casters:
            self._casters[model.name] = caster_of(model)
        return self._casters[model.name]


def known_along(covariance: Floats, along: Floats, before: float, now: float) -> Floats:
    """A pose's covariance (6, 6) where a shift along a unit direction (3,) has another variance than before, m².

    How it goes with the other motions stays as it was; of what was not known at all, 0, it goes with none.
    """
    way, scale = np.outer(along, along), np.eye(6)
    if before > 0.0:
        scale[3:, 3:] += (np.sqrt(now / before) - 1.0) * way
        return np.asarray(scale @ covariance @ scale.T)
    found = covariance.copy()
    found[3:, 3:] += now * way
    return found
