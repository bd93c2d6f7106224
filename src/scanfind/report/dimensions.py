"""An item's key dimensions as a report tells them: designed, as built, what they differ by, and whether that may be."""

from __future__ import annotations

from math import degrees
from typing import TYPE_CHECKING, NamedTuple

from scanfind.detection import ANGLE

if TYPE_CHECKING:
    from scanfind.report.items import Item

HEADS = ("Dimension", "Design", "Built", "Difference", "± σ", "Allowed")


class Line(NamedTuple):
    """One dimension, millimetres or degrees. None: not measured, or nothing said about it; `why` says why not.

    verdict : of VERDICT_WORDS, "" where nobody limits it; source : of the limit
    """

    name: str
    unit: str
    design: float
    built: float | None
    difference: float | None
    sigma: float | None
    allowed: float | None
    verdict: str
    why: str
    source: str

    def cells(self) -> list[str]:
        """What HEADS calls for, for people."""
        decimals = 3 if self.unit == "°" else 2

        def told(value: float | None, form: str = "z") -> str:
            return "–" if value is None else f"{value:{form}.{decimals}f}"

        design = f"{self.design:z.{decimals - 1}f}" + ("°" if self.unit == "°" else " mm")
        return [self.name, design, told(self.built), told(self.difference, "+z"), told(self.sigma), told(self.allowed)]


def lines_of(item: Item) -> list[Line]:
    """The key dimensions of an item; none of one that was not found."""
    checks = item.judgement.checks if item.judgement else ()
    limits = {check.part: check for check in checks if check.is_of_dimension}
    told = []
    for each in item.found.dimensions if item.found else ():
        angle, check = each.kind == ANGLE, limits.get(each.name)
        factor = degrees(1.0) if angle else 1e3
        measured = each.built is not None and each.sigma is not None
        told.append(
            Line(
                each.name,
                "°" if angle else "mm",
                factor * each.design,
                factor * each.built if each.built is not None else None,
                factor * (each.built - each.design) if each.built is not None else None,
                factor * each.sigma if each.sigma is not None else None,
                factor * check.limit.value if check else None,
                check.verdict if check else "",
                each.why if not measured else "" if check is None or check.verdict != "not_judged" else check.why,
                check.limit.source if check else "",
            )
        )
    return told
