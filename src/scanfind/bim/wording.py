"""What a finding is called and what is said of it, in the words of a building site."""

from __future__ import annotations

from math import degrees
from typing import TYPE_CHECKING

from scanfind.elements import INSTALLED, OUT_OF_TOLERANCE

if TYPE_CHECKING:
    from scanfind.schema import DetectionEntry, ElementEntry, Results


def is_finding(element: ElementEntry) -> bool:
    """Does somebody have to look at it? Not where it is installed and nobody says it is out of tolerance."""
    return element.status != INSTALLED or element.verdict == OUT_OF_TOLERANCE


def named(element: ElementEntry) -> str:
    """What people call an element."""
    return element.name or element.model


def title(element: ElementEntry) -> str:
    """One line: which element, and what is the matter with it."""
    if element.status == INSTALLED and element.shift_m is not None:
        return f"{named(element)}: {off_in_words(element)}"
    return f"{named(element)}: {element.status.replace('_', ' ')}"


def off_in_words(element: ElementEntry) -> str:
    """How far off: "12 mm low", if it is mostly that; else how far the point that moved the most did."""
    off, (x, y, z) = element.off_m or 0.0, element.shift_m or (0.0, 0.0, 0.0)
    if abs(z) > 0.8 * off and abs(z) > 2.0 * max(abs(x), abs(y)):
        return f"{1e3 * abs(z):.0f} mm {'high' if z > 0.0 else 'low'}"
    return f"{1e3 * off:.0f} mm off"


def description(element: ElementEntry, found: DetectionEntry | None, results: Results) -> str:
    """Some lines: the evidence, how far off in which direction, of what scans.

    found : the instance taken for it
    """
    lines = [element.why[:1].upper() + element.why[1:] + "."]
    if element.shift_m is not None and element.off_m is not None:
        x, y, z = (1e3 * value for value in element.shift_m)
        turn = degrees(element.turn_rad or 0.0)
        lines += [
            f"Its middle is off by x {x:+.1f}, y {y:+.1f}, z {z:+.1f} mm, and it is turned by {turn:.2f}°.",
            f"The point of its surface that moved the most is off by {1e3 * element.off_m:.1f} mm"
            + ("." if results.allowed_m is None else f"; allowed are {1e3 * results.allowed_m:g} mm."),
        ]
    if found is not None and found.deviation is not None and found.deviation.rms_m is not None:
        lines.append(f"Its {found.points:,} points lie {1e3 * found.deviation.rms_m:.1f} mm (rms) about its surface.")
    scans = ", ".join(scan.path.replace("\\", "/").rpartition("/")[2] for scan in results.scans)
    lines.append(
        f"Scans: {scans}. Inspected {results.made or 'at a time that is not known'}, scanfind {results.scanfind}."
    )
    return "\n".join(lines)


def judged(results: Results, allowed_m: float | None) -> Results:
    """The same with the verdicts that so much (metres) gives; None: as they are."""
    from scanfind.document import findings_of

    if allowed_m is None:
        return results
    verdicts = [element.verdict(allowed_m) for element in findings_of(results).elements]
    elements = [
        entry.model_copy(update={"verdict": verdict}) for entry, verdict in zip(results.elements, verdicts, strict=True)
    ]
    return results.model_copy(update={"elements": elements, "allowed_m": allowed_m})
