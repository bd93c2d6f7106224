"""What a result says, in words a site engineer understands: pure functions of what results.json holds.

Millimetres, degrees and per cent, because people read them; directions are those of the scans' axes, z up.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import degrees, hypot

from scanfind.design.elements import (
    INSTALLED,
    NO_DATA,
    NOT_ENOUGH_DATA,
    NOT_FOUND,
    OCCLUDED,
    UNCERTAIN,
)
from scanfind.results.schema import DetectionEntry, ElementEntry, Matrix, PartEntry, Results, Vector

STATUS_WORDS = {
    INSTALLED: "installed",
    UNCERTAIN: "uncertain",
    OCCLUDED: "hidden",
    NOT_FOUND: "not found",
    NOT_ENOUGH_DATA: "not enough data",
    NO_DATA: "no data",
}
TOO_SMALL_M = 0.0005  # a displacement below this is written as none: scans do not tell it
ALONG = 0.985  # cosine of 10°: a direction so near to an axis is called by the axis


def element_sentences(results: Results, each: ElementEntry) -> tuple[str, ...]:
    """What became of an element of the design and why, the most important first.

    `each` is one of `results.elements`; the instance taken for it, where there is one, is among `results.detections`.
    """
    found = next((one for one in results.detections if one.id == each.detection), None)
    looked_from = stations_in_words(results)
    if each.status == INSTALLED:
        sigma = None if found is None else found.sigma_rad
        there = (place_in_words(each, sigma), *(detection_sentences(results, found, of_design=True) if found else ()))
        emptied = emptied_in_words(each, looked_from)
        return (*there, emptied) if emptied else there
    if each.detection is not None and each.off_m is not None:
        far = f"One of its shape stands {length(each.off_m)} off and may be it, built in another place"
        return f"{far} (instance {each.detection}).", *absence_sentences(each, looked_from)
    return absence_sentences(each, looked_from)


def detection_sentences(results: Results, found: DetectionEntry, *, of_design: bool = False) -> tuple[str, ...]:
    """Why an instance is believed, how well it is measured, and how its surface lies.

    of_design : it stands for an element of a design: how much of it is there goes without its score
    """
    told = [part_in_words(part) for part in found.parts if part.status == "missing" or is_off(part)]
    if found.coverage is not None:
        told.append(f"The scan shows {share(found.coverage)} of its surface.")
    if not of_design and found.visible_support is not None and found.visible_support > 0.0:
        told.append(
            f"Of the surface that {stations_in_words(results)} should see, {share(found.visible_support)} is there."
        )
    if found.penalty is not None and found.penalty >= 0.05 and not of_design:
        told.append(f"Beams passed through {share(found.penalty)} of it, as if it were not there.")
    told.extend(surface_in_words(found))
    told.extend(certainty_in_words(found))
    told.extend(part_in_words(part) for part in found.parts if part.status == "not_seen")
    return tuple(told)


def headline(each: ElementEntry) -> str:
    """One line for a title: "installed, 12 mm too low, 4 mm towards +x"."""
    words = STATUS_WORDS.get(each.status, each.status)
    if each.status != INSTALLED or each.shift_m is None or each.off_m is None:
        return words
    if each.off_m < TOO_SMALL_M:
        return f"{words}, in place"
    moved = shift_in_words(each.shift_m)
    return f"{words}, {moved}" if moved else f"{words}, {length(each.off_m)} off by a turn"


def place_in_words(each: ElementEntry, sigma_rad: float | None = None) -> str:
    """Where an installed element stands, against the design. A turn within two standard deviations is not told."""
    if each.shift_m is None or each.off_m is None:
        return "It is there."
    if each.off_m < TOO_SMALL_M:
        return "It stands where the design puts it: no point of it is off by half a millimetre."
    moved = shift_in_words(each.shift_m)
    turned = each.turn_rad is not None and each.turn_rad > 2.0 * (sigma_rad or 0.0)
    turn = turn_in_words(each.turn_rad) if turned else ""
    where = f"Its middle stands {moved}" if moved else "Its middle is in place"
    return f"{where}{turn}; the point of it that moved the most is {length(each.off_m)} from the design."


def absence_sentences(each: ElementEntry, looked_from: str) -> tuple[str, ...]:
    """Why an element was not found in its place: what beams say of the surface that should be there."""
    if each.on is None or each.beside is None or each.through is None or each.hidden is None:
        return ("It was not found. Where the scanner stood is not known, so missing cannot be told from hidden.",)
    reached = max(each.on + each.beside + each.through, 1e-9)
    there, other, empty = each.on / reached, each.beside / reached, each.through / reached
    behind = f"Other things hide {share(each.hidden)} of it." if each.hidden >= 0.005 else ""
    told = []
    if each.status == NO_DATA:
        return ("No beam of any station came near its place: the scans do not cover it.",)
    if each.status == OCCLUDED:
        told.append(f"Other things stand before {share(each.hidden)} of what {looked_from} would see of it.")
        return (*told, "What is left to see is too little to say whether it is there.")
    if each.status == NOT_ENOUGH_DATA:
        return ("Too little of its surface was looked at to say whether it is there.", *filter(None, [behind]))
    if there >= max(empty, other):
        told.append(f"{share(there)} of the surface looked at is there, which does not settle that it is the element.")
        rest = [(other, "something else"), (empty, "empty space")]
        told += [f"{share(part)} of it is {what}." for part, what in rest if part >= 0.005]
        return (*told, *filter(None, [behind]))
    if empty >= other:
        told.append(f"{share(empty)} of the surface that {looked_from} should see is empty space.")
        if other >= 0.05:
            told.append(f"In place of another {share(other)} stands something that is not of its shape.")
    else:
        told.append(
            f"Something else stands in its place: {share(other)} of the surface that should be seen is not its."
        )
        if empty >= 0.05:
            told.append(f"Another {share(empty)} is empty space.")
    if there >= 0.05:
        told.append(f"{share(there)} of the surface looked at is there.")
    if each.status == UNCERTAIN:
        told.append("The scan does not settle whether that is the element.")
    return (*told, *filter(None, [behind]))


def emptied_in_words(each: ElementEntry, looked_from: str) -> str:
    """That the designed place of an element built elsewhere is empty; nothing where it is not."""
    if each.through is None or each.through < 0.2:
        return ""
    return f"In its designed place, {share(each.through)} of the surface that {looked_from} should see is empty space."


def surface_in_words(found: DetectionEntry) -> list[str]:
    """How its own points lie to the surface of the model."""
    deviation = found.deviation
    if deviation is None or deviation.mean_m is None or deviation.p95_m is None:
        return []
    side = "outside" if deviation.mean_m > 0 else "inside"
    mean = "in the mean on it" if abs(deviation.mean_m) < 5e-5 else f"in the mean {length(deviation.mean_m)} {side} it"
    surface = "the surface of its parts as built" if found.parts else "its surface"
    return [f"95 % of its {found.points:,} points lie within {length(deviation.p95_m)} of {surface}, {mean}."]


def certainty_in_words(found: DetectionEntry) -> list[str]:
    """How well the scan fixes where it stands, and what it leaves open."""
    told = []
    if found.sigma_m is not None and found.sigma_rad is not None:
        sigma, angle = length(found.sigma_m, 2), degrees(found.sigma_rad)
        told.append(f"The scan fixes its middle to ± {sigma} and its turn to ± {angle:.3f}° (one standard deviation).")
    for motion in found.unobservable:
        what = motion_in_words(motion.kind, _turned(found.scene_from_model, motion.axis))
        if motion.sigma is None:
            told.append(f"Nothing in the scan tells whether it {what}.")
        else:
            to = length(motion.sigma) if motion.kind == "slide" else f"{degrees(motion.sigma):.2f}°"
            told.append(f"The scan hardly tells whether it {what}: only to ± {to}.")
    return told


def part_in_words(part: PartEntry) -> str:
    """What became of one part of an assembly."""
    if part.status == "missing":
        return f"Its part {part.name} is missing: beams passed through {share(part.penalty or 0.0)} of it."
    if part.status != "measured" or part.off_m is None:
        return f"Its part {part.name} cannot be judged: too little of it was looked at."
    turn = turn_in_words(None if part.turn_rad is None else hypot(*part.turn_rad))
    return f"Its part {part.name} is {length(part.off_m)} off{turn}."


def is_off(part: PartEntry) -> bool:
    """Is some of a part surely off the design: by more than three standard deviations, and three millimetres?"""
    return part.off_m is not None and part.off_m > max(0.003, 3.0 * (part.off_sigma_m or 0.0))


def shift_in_words(shift: Vector) -> str:
    """A displacement, the largest part of it first: "12 mm too low, 4 mm towards +x". Empty where it is none."""
    ways = [("towards +x", "towards -x"), ("towards +y", "towards -y"), ("too high", "too low")]
    parts = sorted(zip(shift, ways, strict=True), key=lambda part: -abs(part[0]))
    told = [f"{length(value)} {way[value < 0]}" for value, way in parts if abs(value) >= TOO_SMALL_M]
    return ", ".join(told)


def turn_in_words(angle: float | None) -> str:
    """By what angle, as the end of a phrase; nothing for less than a hundredth of a degree."""
    return "" if angle is None or degrees(angle) < 0.01 else f", turned by {degrees(angle):.2f}°"


def stations_in_words(results: Results) -> str:
    """Who looked: "the 12 stations"."""
    known = sum(station is not None for scan in results.scans for station in scan.stations_m)
    return "the station" if known == 1 else f"the {known} stations" if known else "a scanner"


def motion_in_words(kind: str, axis: Sequence[float]) -> str:
    """A slide or a roll along or about a direction of the scans' axes: "has moved up or down"."""
    near = next((name for name, value in zip("xyz", axis, strict=True) if abs(value) >= ALONG), None)
    along = near or "({:.2f}, {:.2f}, {:.2f})".format(*axis)
    if kind == "slide":
        return "has moved up or down" if near == "z" else f"has moved along {along}"
    return f"is turned about an axis along {along}"


def length(metres: float, decimals: int = 1) -> str:
    """A length for people, unsigned: millimetres to a tenth below 10 mm, metres from one metre on."""
    size = abs(metres)
    if size >= 1.0:
        return f"{size:.2f} m"
    return f"{1e3 * size:.{decimals}f} mm" if size < 0.00995 else f"{1e3 * size:.0f} mm"


def share(part: float) -> str:
    """A share for people; what is not all of it is never called 100 %, nor what is something 0 %."""
    whole = round(100.0 * part)
    if whole >= 100 > 100.0 * part + 1e-9:
        return "over 99 %"
    return "under 1 %" if whole == 0 and part > 0.0 else f"{whole} %"


def _turned(matrix: Matrix, axis: Vector) -> tuple[float, float, float]:
    x, y, z = (sum(a * b for a, b in zip(row[:3], axis, strict=True)) for row in matrix[:3])
    return x, y, z
