"""What a report is made of: one item an element of the design, or one an instance where there is no design."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import degrees
from typing import TYPE_CHECKING

from scanfind.design.elements import INSTALLED, NO_DATA, NOT_ENOUGH_DATA, NOT_FOUND, OCCLUDED, UNCERTAIN
from scanfind.report.dimensions import Line, lines_of
from scanfind.results.explain import STATUS_WORDS, detection_sentences, element_sentences, headline
from scanfind.tolerances import IN, NOT_JUDGED, OUT, Check, Judgement, judge_detection, judge_element

if TYPE_CHECKING:
    from scanfind.results.schema import DetectionEntry, ElementEntry, Matrix, Results
    from scanfind.tolerances import Profile
    from scanfind.tolerances.discs import Disc

FOUND = "found"  # the status of an instance, where there is no design
EXTRA = "extra"  # of one that no element of the design is taken for
WORDS = {**STATUS_WORDS, EXTRA: "not in the design"}
VERDICT_WORDS = {IN: "in tolerance", OUT: "out of tolerance", NOT_JUDGED: "not judged", "": "–"}
# What needs a look comes first.
ORDER = (NOT_FOUND, UNCERTAIN, EXTRA, OCCLUDED, NOT_ENOUGH_DATA, NO_DATA, INSTALLED, FOUND)
VERDICT_ORDER = (OUT, NOT_JUDGED, "", IN)


@dataclass(frozen=True)
class Item:
    """An element of the design, or an instance, as a report tells of it.

    key : its anchor in the page; model : its geometry's name in the result's models
    verdict : of VERDICT_WORDS, "" where no tolerance was given; verdict_why : in words
    numbers : label, value with its unit, for a table
    found : the instance taken for it; scene_from_model, design_from_model : where it stands, where it should
    """

    key: str
    name: str
    ifc_class: str
    global_id: str
    model: str
    status: str
    verdict: str
    verdict_why: str
    headline: str
    sentences: tuple[str, ...]
    numbers: tuple[tuple[str, str], ...]
    judgement: Judgement | None
    found: DetectionEntry | None
    scene_from_model: Matrix | None
    design_from_model: Matrix | None
    off_m: float | None
    shift_m: tuple[float, float, float] | None
    turn_rad: float | None

    @property
    def status_words(self) -> str:
        """Its status, for people."""
        return WORDS.get(self.status, self.status.replace("_", " "))

    @property
    def verdict_words(self) -> str:
        """Its verdict, for people."""
        return VERDICT_WORDS[self.verdict]

    @property
    def p95_m(self) -> float | None:
        """Within which distance of its surface 95 % of its points lie, metres."""
        return None if self.found is None or self.found.deviation is None else self.found.deviation.p95_m

    @property
    def dimensions(self) -> list[Line]:
        """Its key dimensions."""
        return lines_of(self)

    @property
    def other_checks(self) -> list[Check]:
        """What it was held against besides these."""
        return [check for check in self.judgement.checks if not check.is_of_dimension] if self.judgement else []

    @property
    def is_fine(self) -> bool:
        """Is there nothing to look at: it is there, and nobody says it is off?"""
        return self.status in {INSTALLED, FOUND} and self.verdict in {IN, ""}


def items_of(
    results: Results, profile: Profile | None, discs: Mapping[tuple[str, str], Disc] | None = None
) -> list[Item]:
    """All items of a result, what needs a look first; judged by a profile, where there is one."""
    items = [_element(results, each, k, profile, discs) for k, each in enumerate(results.elements, 1)]
    taken = {each.detection for each in results.elements}
    status = EXTRA if results.elements else FOUND
    items += [_detection(results, one, status, profile, discs) for one in results.detections if one.id not in taken]
    return sorted(items, key=lambda item: (_place(ORDER, item.status), VERDICT_ORDER.index(item.verdict), item.name))


def counts_of(items: Sequence[Item]) -> list[tuple[str, str, int]]:
    """How many items have which status and which verdict: its name, its words, how many; none that nobody has."""
    statuses, verdicts = Counter(item.status for item in items), Counter(item.verdict for item in items)
    told = [(status, WORDS.get(status, status), statuses[status]) for status in (*ORDER[::-1],)]
    told += [(verdict, VERDICT_WORDS[verdict], verdicts[verdict]) for verdict in (IN, OUT, NOT_JUDGED)]
    return [line for line in told if line[2]]


def _element(
    results: Results, each: ElementEntry, number: int, profile: Profile | None,
    discs: Mapping[tuple[str, str], Disc] | None,
) -> Item:  # fmt: skip
    found = next((one for one in results.detections if one.id == each.detection), None)
    # Of what was not found the status says it all.
    judgement = judge_element(profile, results, each, discs) if profile and each.status == INSTALLED else None
    shift = tuple(_mm(value) for value in each.shift_m) if each.shift_m else ("–",) * 3
    numbers = [
        ("Off the design, at most", _mm(each.off_m)),
        ("Shift of its middle, x / y / z", " / ".join(shift)),
        ("Turned by", _degrees(each.turn_rad)),
        *_of_instance(found),
        ("Beams that met it", _share(each.on)),
        ("Beams that met something else", _share(each.beside)),
        ("Beams that went on behind it", _share(each.through)),
        ("Beams stopped before it", _share(each.hidden)),
    ]
    return Item(
        key=f"e{number}",
        name=each.name or each.model,
        ifc_class=each.ifc_class,
        global_id=each.global_id,
        model=each.model,
        status=each.status,
        verdict="" if judgement is None else judgement.verdict,
        verdict_why="" if judgement is None else judgement.why,
        headline=headline(each),
        sentences=element_sentences(results, each),
        numbers=tuple(pair for pair in numbers if pair[1] not in {"–", "– / – / –"}),
        judgement=judgement,
        found=found,
        scene_from_model=None if found is None else found.scene_from_model,
        design_from_model=each.design_from_model,
        off_m=each.off_m,
        shift_m=each.shift_m,
        turn_rad=each.turn_rad,
    )


def _detection(
    results: Results, found: DetectionEntry, status: str, profile: Profile | None,
    discs: Mapping[tuple[str, str], Disc] | None,
) -> Item:  # fmt: skip
    judgement = None if profile is None else judge_detection(profile, results, found, discs)
    x, y, z = found.translation_m
    numbers = [("Stands at x / y / z", f"{x:z.3f} / {y:z.3f} / {z:z.3f} m"), *_of_instance(found)]
    return Item(
        key=f"d{found.id}",
        name=f"{found.model} {found.id}",
        ifc_class="",
        global_id="",
        model=found.model,
        status=status,
        verdict="" if judgement is None else judgement.verdict,
        verdict_why="" if judgement is None else judgement.why,
        headline=f"found at {x:z.3f}, {y:z.3f}, {z:z.3f} m",
        sentences=detection_sentences(results, found),
        numbers=tuple(pair for pair in numbers if pair[1] != "–"),
        judgement=judgement,
        found=found,
        scene_from_model=found.scene_from_model,
        design_from_model=None,
        off_m=None,
        shift_m=None,
        turn_rad=None,
    )


def _of_instance(found: DetectionEntry | None) -> list[tuple[str, str]]:
    """The numbers of an instance; none where there is none."""
    if found is None:
        return []
    deviation = found.deviation
    return [
        ("Score", "–" if found.score is None else f"{found.score:.2f}"),
        ("Right with a probability of", _share(found.probability)),
        ("Surface that the scan shows", _share(found.coverage)),
        ("Points of its own", f"{found.points:,}"),
        ("Points from the surface, mean", _mm(None if deviation is None else deviation.mean_m)),
        ("… 95 % of them within", _mm(None if deviation is None else deviation.p95_m)),
        ("Its middle is known to ±", _mm(found.sigma_m, 2)),
        ("Its turn is known to ±", _degrees(found.sigma_rad, 3)),
    ]


def _place(order: Sequence[str], status: str) -> int:
    return order.index(status) if status in order else len(order)


def _mm(value: float | None, decimals: int = 1) -> str:
    return "–" if value is None else f"{1e3 * value:z.{decimals}f} mm"


def _degrees(value: float | None, decimals: int = 2) -> str:
    return "–" if value is None else f"{degrees(value):z.{decimals}f}°"


def _share(value: float | None) -> str:
    return "–" if value is None else f"{100.0 * value:.0f} %"
