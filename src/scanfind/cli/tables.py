"""Tables for people: metres where things stand, millimetres for how well they fit, degrees for how they are turned."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from math import atan2, degrees, hypot
from typing import TYPE_CHECKING

from scanfind.design.elements import (
    IN_TOLERANCE,
    INSTALLED,
    NO_DATA,
    NOT_ENOUGH_DATA,
    NOT_FOUND,
    NOT_JUDGED,
    OCCLUDED,
    OUT_OF_TOLERANCE,
    UNCERTAIN,
)
from scanfind.detection import OFF_M

if TYPE_CHECKING:
    from scanfind.results.schema import (
        AlignmentEntry,
        DetectionEntry,
        ElementEntry,
        Matrix,
        PartEntry,
        RefusedEntry,
        Results,
    )
    from scanfind.simulate import Sight

FOUND = (
    "id", "model", "x m", "y m", "z m", "yaw °", "pitch °", "roll °", "score", "right %", "visible %", "rms mm", "± mm",
    "± °", "points", "mean mm", "95 % mm", "free to",
)  # fmt: skip

ELEMENTS = ("element", "class", "status", "verdict", "id", "off mm", "x mm", "y mm", "z mm", "turned °", "why")
# What needs a look first.
ORDER = [
    (NOT_FOUND, None), (UNCERTAIN, None), (INSTALLED, OUT_OF_TOLERANCE), (INSTALLED, NOT_JUDGED),
    *((status, None) for status in (OCCLUDED, NOT_ENOUGH_DATA, NO_DATA, INSTALLED)), (INSTALLED, IN_TOLERANCE),
]  # fmt: skip

PARTS = ("id", "part", "status", "off mm", "± mm", "x mm", "y mm", "z mm", "turned °", "± °", "joined to", "free to")


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Columns as wide as their widest cell; those that hold numbers on the right."""
    columns = list(zip(header, *rows, strict=True))
    widths = [max(map(len, column)) for column in columns]
    right = [bool(rows) and all(_is_number(cell) for cell in column[1:]) for column in columns]
    lines = (
        "  ".join(cell.rjust(w) if r else cell.ljust(w) for cell, w, r in zip(line, widths, right, strict=True))
        for line in (header, *rows)
    )
    return "\n".join(line.rstrip() for line in lines)


def found_table(results: Results) -> str:
    """One line a detection; "mean" and "95 %" are of the signed, and of the absolute distances of its points.

    "±" is how far, root mean square, its middle and its rotation may be off.
    """
    return table(FOUND, [_found_row(found) for found in results.detections])


def parts_table(results: Results) -> str:
    """One line for each part of a detection that is surely off the design or missing; empty where none is.

    x, y, z: the shift of its middle along the model's axes.
    """
    parts = [(found, part) for found in results.detections for part in found.parts]
    rows = [_part_row(found, part) for found, part in parts if part.status == "missing" or _is_off(part)]
    return table(PARTS, rows) if rows else ""


def elements_table(results: Results) -> str:
    """One line an element of the design, what needs a look first; x, y, z: its middle's shift in the scan's axes."""
    rows = sorted(results.elements, key=lambda each: (ORDER.index((each.status, each.verdict)), each.name))
    return table(ELEMENTS, [_element_row(each) for each in rows])


def elements_in_words(results: Results) -> str:
    """How many elements have which status, in one line."""
    counts = Counter(each.status for each in results.elements)
    told = [f"{count} {status.replace('_', ' ')}" for status, count in counts.most_common()]
    if results.profile is not None:
        verdicts = Counter(each.verdict for each in results.elements)
        told.append(f"{verdicts[OUT_OF_TOLERANCE]} out of tolerance ({results.profile['title']})")
        if verdicts[NOT_JUDGED]:
            told.append(f"{verdicts[NOT_JUDGED]} not judged")
    return f"{len(results.elements)} elements of the design: {', '.join(told)}"


def alignment_in_words(alignment: AlignmentEntry) -> str:
    """Where the design lies in the scans and how sure that is, in one line."""
    x, y, z = (row[3] for row in alignment.scene_from_design[:3])
    angles = " ".join(f"{angle:.3f}°" for angle in turned(alignment.scene_from_design))
    agree = f"{alignment.agreeing} of {alignment.found} instances found agree to {alignment.rms_m * 1e3:.1f} mm"
    sure = f"± {alignment.sigma_m * 1e3:.1f} mm and ± {degrees(alignment.sigma_rad):.3f}°"
    return (
        f"scans and design are in different frames: the design's origin is at {x:.3f} {y:.3f} {z:.3f} m in the scans, "
        f"turned by {angles} (yaw, pitch, roll); {agree}; known to {sure}"
    )


def sight_table(sights: Sequence[Sight]) -> str:
    """One line a target of a simulated scan: what each station sees of it, and all together."""
    stations = [f"from {k} %" for k in range(1, len(sights[0].visible) + 1)]
    header = ("id", "target", "points", "seen %", *stations, "spacing mm", "incidence °", "steepest °", "range m")
    return table(header, [_sight_row(sight) for sight in sights])


def closest(results: Results) -> list[str]:
    """A line for each model that was not found: what came closest, and why it was refused."""
    found = {detection.model for detection in results.detections}
    lines = []
    for model in results.models:
        if model.name in found:
            continue
        near = [refused for refused in results.refused if refused.model == model.name]
        if near:
            best = max(near, key=_closeness)
            x, y, z = (row[3] for row in best.scene_from_model[:3])
            where = f"the closest was at {x:.3f} {y:.3f} {z:.3f} m, score {_number(best.score, 2)}: {best.reason}"
        else:
            # Mistaken units are the commonest cause, and the size is what shows them.
            where = f"no part of the scene looks like it, which is {model.diameter_m:,.3f} m across"
        lines.append(f"{model.name}: not found: {where}")
    return lines


def turned(matrix: Matrix) -> tuple[float, float, float]:
    """Yaw about z, then pitch about the new y, then roll about the new x, degrees."""
    (a, _, _, _), (b, _, _, _), (c, d, e, _), _ = matrix
    return degrees(atan2(b, a)), degrees(atan2(-c, hypot(d, e))), degrees(atan2(d, e))


def _found_row(found: DetectionEntry) -> list[str]:
    deviation = found.deviation
    return [
        str(found.id),
        found.model,
        *(_number(value, 3) for value in found.translation_m),
        *(_number(value, 2) for value in turned(found.scene_from_model)),
        _number(found.score, 2),
        _number(found.probability, 0, 100.0),
        _number(found.visible_support, 0, 100.0),
        _number(found.rms_m, 1, 1e3),
        _number(found.sigma_m, 2, 1e3),
        _number(None if found.sigma_rad is None else degrees(found.sigma_rad), 3),
        f"{found.points:,}",
        _number(deviation.mean_m if deviation else None, 1, 1e3),
        _number(deviation.p95_m if deviation else None, 1, 1e3),
        ", ".join(motion.kind for motion in found.unobservable) or "–",
    ]


def _is_off(part: PartEntry) -> bool:
    return part.off_m is not None and part.off_m > max(OFF_M, 3.0 * (part.off_sigma_m or 0.0))


def _part_row(found: DetectionEntry, part: PartEntry) -> list[str]:
    angle = None if part.turn_rad is None else degrees(hypot(*part.turn_rad))
    sigma = None if part.turn_sigma_rad is None else degrees(part.turn_sigma_rad)
    return [
        str(found.id),
        part.name,
        part.status.replace("_", " "),
        _number(part.off_m, 1, 1e3),
        _number(part.off_sigma_m, 1, 1e3),
        *(_number(value, 1, 1e3) for value in part.shift_m or (None, None, None)),
        _number(angle, 2),
        _number(sigma, 2),
        part.joined_to or "–",
        ", ".join(motion.kind for motion in part.free) or "–",
    ]


def _element_row(each: ElementEntry) -> list[str]:
    return [
        each.name or each.model,
        each.ifc_class or "–",
        each.status.replace("_", " "),
        (each.verdict or "–").replace("_", " "),
        "–" if each.detection is None else str(each.detection),
        _number(each.off_m, 1, 1e3),
        *(_number(value, 1, 1e3) for value in each.shift_m or (None, None, None)),
        _number(None if each.turn_rad is None else degrees(each.turn_rad), 2),
        f"{each.why}; {each.verdict_why}" if each.verdict in {OUT_OF_TOLERANCE, NOT_JUDGED} else each.why,
    ]


def _sight_row(sight: Sight) -> list[str]:
    incidence = [None if angle is None else degrees(angle) for angle in (sight.incidence, sight.steepest)]
    return [
        str(sight.object_id),
        sight.name,
        f"{sum(sight.points):,}",
        *(_number(share, 0, 100.0) for share in (sight.together, *sight.visible)),
        _number(sight.spacing_m, 1, 1e3),
        *(_number(angle, 0) for angle in incidence),
        f"{_number(sight.nearest_m, 1)} to {_number(sight.farthest_m, 1)}",
    ]


def _closeness(refused: RefusedEntry) -> float:
    return -1.0 if refused.score is None else refused.score


def _number(value: float | None, decimals: int, factor: float = 1.0) -> str:
    return "–" if value is None else f"{value * factor:z.{decimals}f}"


def _is_number(cell: str) -> bool:
    return cell == "–" or cell.replace(",", "").replace(".", "").lstrip("-").isdigit()
