"""What became of the design: for every element that should be there a status, and the evidence that decided it.

Statuses are those of construction verification: `installed` (found, wherever it stands), `uncertain` (something is
there that the scan does not settle), `occluded` (other things stand before it), `not_found` (scanners looked, and it is
not there), `not_enough_data` (too little of it was looked at), `no_data` (no beam came near it).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from heapq import heappop, heappush
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scanfind.detection import StationSays
from scanfind.evidence.free_space import Spoken
from scanfind.fit.refine import held
from scanfind.mesh import Placement
from scanfind.pose import Pose
from scanfind.symmetry import pose_error

if TYPE_CHECKING:
    from scanfind.detection import Detection
    from scanfind.library.model import Model

Floats = NDArray[np.float64]

INSTALLED, UNCERTAIN, OCCLUDED = "installed", "uncertain", "occluded"
NOT_FOUND, NOT_ENOUGH_DATA, NO_DATA = "not_found", "not_enough_data", "no_data"

# Of the surface that beams went to from the stations: below the first nothing was there to look with; below the second
# what was looked at is too little to call the rest missing.
LEAST_ASKED, LEAST_LOOKED_AT = 0.02, 0.1
# Of the surface looked at: so much of it there, and something stands in its place that may be the element; so much
# passed through or beside what was met, and it is not there.
MAY_BE, IS_NOT = 0.5, 0.7
# Farther from its place than this and it may as well be another part of the same shape.
FAR_M = 0.5
SAID_M = 0.002  # what a motion that is held at the design's would add is told from here on
IN_TOLERANCE, OUT_OF_TOLERANCE, NOT_JUDGED = "in_tolerance", "out_of_tolerance", "not_judged"
# A motion fixed so much worse than others on average is asked of the ends; and so much of it must be a slide.
OPEN, SLIDES = 0.1, 0.5
LEAST_SAID = 0.01  # of the surface that beams went to: a station that speaks of less is not told
PAIRED_BY = 50  # samples, which lie evenly over the model: they tell which of two places is nearer


@dataclass(frozen=True)
class Element:
    """One product of the design, and what the scans say of it.

    placement : its GlobalId, class, name, and where the design puts it, in the scans' frame; model : of which geometry
    status : one of those above
    detection : the id of the instance that is taken for it, or stands far off and may be it
    shift_m : (3,) of its middle from where the design puts it, in the scans' axes; turn_rad : by what angle it is
        turned, symmetry not counted; off_m : how far the point of its surface that moved the most did. None without
        a detection
    on, beside, through, hidden : what beams say at the design's place, as shares of the surface they went to: they
        ended on it, near it but not on it, behind it, or before it; of an element that was not found those that should
        have come back and did not went behind it. None where no scanner position is known
    why : the evidence in words
    built_from_design : what moves it from its place in the design to where it stands, in the design's axes about their
        origin; without the motions the scan hardly fixes. None unless installed
    stations : what each station says of its place in the design; empty where there are not several
    verdict, verdict_why : in_tolerance, out_of_tolerance or not_judged, and why (see `scanfind.tolerances`); None
        unless it is installed and somebody said how far off it may be
    """

    placement: Placement
    model: str
    status: str
    detection: int | None
    shift_m: tuple[float, float, float] | None
    turn_rad: float | None
    off_m: float | None
    on: float | None
    beside: float | None
    through: float | None
    hidden: float | None
    why: str
    built_from_design: Pose | None = None
    verdict: str | None = None
    verdict_why: str = ""
    stations: tuple[StationSays, ...] = ()


def placements_of(model: Model) -> tuple[Placement, ...]:
    """Where the design puts a model: as its products say, or as it was drawn where the format knows no products."""
    return model.placements or (Placement("", "", model.name, Pose.identity()),)


def elements_of(
    model: Model, detections: Sequence[Detection], said: Sequence[Floats], stations: Sequence[int] = ()
) -> list[Element]:
    """The elements of a design that are of one model, in the order of its placements.

    detections : in the scans' frame, which is the design's
    said : for each placement, what the beams of each of S scanners say of the model there: rows as of Spoken, (S, 4)
    stations : their numbers
    """
    placements, found = placements_of(model), []
    taken = assigned(model, placements, detections)
    for place, placement in enumerate(placements):
        by_each, one = said[place], taken.get(place)
        spoken = Spoken(*by_each.sum(axis=0).tolist()) if len(by_each) else None
        told = missed(model, placement, spoken) if one is None else installed(model, placement, one, spoken)
        found.append(replace(told, stations=said_by(by_each, stations)))
    return found


def assigned(model: Model, placements: Sequence[Placement], detections: Iterable[Detection]) -> dict[int, Detection]:
    """Which detection of a model is taken for which placement (by number): the nearest pair first, each once.

    What stands in another's place is first taken for an element in whose place another stands.
    """
    every, some, centre = list(detections), model.samples.points[:PAIRED_BY], model.symmetry.centre[None]
    listed = [one for one in every if one.model == model.name]
    there = np.array([placement.design_from_model.move(centre)[0] for placement in placements]).reshape(-1, 1, 3)
    here = np.array([one.scene_from_model.move(centre)[0] for one in listed]).reshape(-1, 3)
    # Between its points, so the farthest of these is off by more: most pairs are never looked at closely.
    least = np.linalg.norm(there - here, axis=2)
    others = [np.array(one.pivot) for one in every if one.instead_of and one.pivot and one.model != model.name]
    far = [np.linalg.norm(there[:, 0] - other, axis=1) for other in others]
    left = dict.fromkeys(int(each.argmin()) for each in far if each.min() < FAR_M)
    swapped = [number for number, one in enumerate(listed) if one.instead_of]
    taken = {place: listed[number] for place, number in zip(left, swapped, strict=False)}
    free = set(range(len(listed))) - set(swapped[: len(left)])
    pairs = list[tuple[float, int, int, int]]()

    def settle(nearer_than: float) -> None:
        while pairs and pairs[0][0] < nearer_than:
            _, place, _, number = heappop(pairs)
            if place not in taken and number in free:
                taken[place] = listed[number]
                free.remove(number)

    for place, number in np.column_stack(np.unravel_index(np.argsort(least, axis=None, kind="stable"), least.shape)):
        settle(least[place, number])
        if place not in taken and number in free:
            one, design = listed[number], placements[place].design_from_model
            heappush(pairs, (off_by(model, some, one.scene_from_model, design), int(place), one.id, int(number)))
    settle(np.inf)
    return taken


def off_by(model: Model, points: Floats, found: Pose, design: Pose) -> float:
    """How far from its place the farthest of N points (N, 3) of the model is, metres; symmetry does not count."""
    alike = model.symmetry.nearest(found, design.rotation)
    return float(np.linalg.norm(alike.move(points) - design.move(points), axis=1).max())


def installed(model: Model, placement: Placement, found: Detection, spoken: Spoken | None) -> Element:
    """An element that is there, and how far from where the design puts it."""
    design, centre = placement.design_from_model, model.symmetry.centre[None]
    stands = drawn_back(model, found, design)
    x, y, z = (stands.move(centre) - design.move(centre))[0].tolist()
    turn = pose_error(stands, design, model.symmetry).rotation_rad
    off = off_by(model, model.samples.points, stands, design)
    if off > FAR_M and not found.instead_of:
        _, there = status_at(spoken, model.area)
        why = f"where it should be {there}; one of its shape stands {off:.2f} m off"
        return Element(placement, model.name, UNCERTAIN, found.id, (x, y, z), turn, off, *shares(spoken), why)
    why = f"found with score {found.score:.2f}: {found.coverage:.0%} of its surface lies on the scan"
    if spoken and found.coverage < LEAST_LOOKED_AT and spoken.on > 0.0:  # few points: surfels do not tell, beams do
        met = spoken.on / spoken.looked_at()
        why = f"found with score {found.score:.2f}: {met:.0%} of what scanners looked at of it is there"
    if found.instead_of:
        why = f"{why}; it stands in the place of {found.instead_of}"
    further = off_by(model, model.samples.points, found.scene_from_model, design) - off
    if further > SAID_M:
        why += f"; {1e3 * further:.0f} mm more, along a motion the scan hardly fixes, are left out"
    moved = stands @ design.inverse()
    return Element(placement, model.name, INSTALLED, found.id, (x, y, z), turn, off, *shares(spoken), why, moved)


def drawn_back(model: Model, found: Detection, design: Pose) -> Pose:
    """Where an element stands, as designed along the motions that the scan hardly fixes."""
    alike = model.symmetry.nearest(found.scene_from_model, design.rotation)
    if found.covariance is None or found.pivot is None or found.instead_of:
        return alike
    middle = found.scene_from_model.inverse().move(np.array(found.pivot)[None])
    radius = 0.5 * model.diameter
    information = information_of(found, radius)
    if found.slide is not None:  # its ends say it, however little its faces do
        along = np.concatenate([np.zeros(3), found.slide])
        information = information + np.trace(information) / 6.0 * np.outer(along, along)
    # The pivot is in the middle of what was seen; a symmetry may have turned that elsewhere.
    there = alike.inverse().move(found.scene_from_model.move(middle))[0]
    return held(design, alike, information, there, radius)


def open_slide(model: Model, found: Detection) -> Floats | None:
    """The direction (3,) of a slide that the faces of an instance leave open, scan axes; None where there is none."""
    values, motions = np.linalg.eigh(information_of(found, 0.5 * model.diameter))
    for value, motion in zip(values, motions.T, strict=True):
        share = np.linalg.norm(motion[3:])
        if value < OPEN * values.mean() and share > SLIDES:
            return np.asarray(motion[3:] / share)
    return None


def information_of(found: Detection, radius: float) -> Floats:
    """What the scan says of the motions (rotation × radius, translation of the pivot) of an instance, (6, 6), 1/m².

    As if it said the same of all of them where there is no covariance; radius : of the model, metres.
    """
    if found.covariance is None:
        return np.eye(6)
    scale = np.array([radius] * 3 + [1.0] * 3)
    inverse = np.linalg.pinv(found.covariance * np.outer(scale, scale), rcond=1e-9, hermitian=True)
    return np.asarray(inverse, np.float64)


def missed(model: Model, placement: Placement, spoken: Spoken | None) -> Element:
    """An element that was not found, and what its place in the design looks like."""
    status, why = status_at(spoken, model.area)
    return Element(placement, model.name, status, None, None, None, None, *shares(spoken), why)


def said_by(by_each: Floats, stations: Sequence[int]) -> tuple[StationSays, ...]:
    """What each of S stations says, (S, 4) m², as shares of what all went to; none of one station alone."""
    if len(by_each) < 2:
        return ()
    parts = by_each / max(by_each.sum(), 1e-300)
    told = zip(stations, parts.tolist(), strict=True)
    return tuple(StationSays(number, *part) for number, part in told if sum(part) >= LEAST_SAID)


def shares(spoken: Spoken | None) -> tuple[float | None, float | None, float | None, float | None]:
    """What beams say, as shares of the surface they went to."""
    if spoken is None:
        return None, None, None, None
    asked = max(sum(spoken), 1e-300)
    return spoken.on / asked, spoken.beside / asked, spoken.through / asked, spoken.hidden / asked


def status_at(spoken: Spoken | None, area: float) -> tuple[str, str]:
    """The status of an element that was not found, and why, from what beams say of its place.

    area : of its surface that scanners could see, m²
    """
    if spoken is None:
        return UNCERTAIN, "not found, and no scanner position is known to tell missing from hidden: give --origin X,Y,Z"
    on, beside, through, hidden = spoken
    asked, looked = sum(spoken), spoken.looked_at()
    if asked < LEAST_ASKED * area:
        return NO_DATA, "no beam of any scanner came near its place"
    if looked < LEAST_LOOKED_AT * area:
        if hidden >= 0.5 * asked:
            return OCCLUDED, f"other things stand before {hidden / asked:.0%} of what the scanners would see of it"
        return NOT_ENOUGH_DATA, f"scanners looked at only {looked / area:.0%} of its surface"
    if on >= MAY_BE * looked:
        return UNCERTAIN, f"{on / looked:.0%} of the surface looked at lies on the scan, which does not settle it"
    if through + beside >= IS_NOT * looked:
        if through >= beside:
            return NOT_FOUND, f"{through / looked:.0%} of the surface scanners should see is empty space"
        return NOT_FOUND, f"what stands in its place is not it: {beside / looked:.0%} of its surface lies elsewhere"
    return UNCERTAIN, f"only {on / looked:.0%} of the surface looked at lies on the scan"
