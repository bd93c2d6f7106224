"""What a report says, whatever file it goes into, and its words about the whole."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

from scanfind.report.items import Item, counts_of

if TYPE_CHECKING:
    from scanfind.report.material import Material
    from scanfind.results.schema import Results
    from scanfind.tolerances import Profile


@dataclass(frozen=True, eq=False)
class Content:
    """A result as it is reported: its items, judged by a profile or by none, and what is seen of them."""

    results: Results
    items: tuple[Item, ...]
    profile: Profile | None
    material: Material
    title: str
    made: date

    @property
    def of_design(self) -> bool:
        """Is it about the elements of a design, not about instances?"""
        return bool(self.results.elements)

    @property
    def kind(self) -> str:
        """What kind of report it is."""
        return "Inspection against the design" if self.of_design else "Instances found in scans"

    @property
    def noun(self) -> str:
        """What its items are, one or many."""
        return ("element" if self.of_design else "instance") + ("" if len(self.items) == 1 else "s")

    @property
    def stations(self) -> list[tuple[float, float, float]]:
        """Where scanners stood, as far as anybody knows, scan frame, metres."""
        return [place for scan in self.results.scans for place in scan.stations_m if place is not None]

    def counts(self) -> list[tuple[str, str, int]]:
        """How many items have which status and verdict: key, words, how many."""
        return counts_of(self.items)

    def facts(self) -> str:
        """Scans, their size, and the tolerance, in one line."""
        scans = self.results.scans
        points = sum(scan.points for scan in scans)
        names = ", ".join(Path(scan.path).name for scan in scans[:3]) + (" …" if len(scans) > 3 else "")
        judged = self.profile.title if self.profile else "none given, nothing is judged"
        return f"{points:,} points of {names or 'no scan'} · tolerance: {judged}"

    def notes(self) -> list[str]:
        """What a reader should know besides."""
        found = {one.model for one in self.results.detections}
        lost = (
            [] if self.of_design else [f"{m.name} was not found." for m in self.results.models if m.name not in found]
        )
        return [*lost, *self.results.notes, *self.material.notes]

    def made_by(self) -> str:
        """Who made it when, and of what."""
        return f"Made {self.made:%d %B %Y} by scanfind {self.results.scanfind}. Lengths in metres or millimetres, z up."
