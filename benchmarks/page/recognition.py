"""The page's section on recognition, from results/recognition_<line>.csv: what is asked, what was measured, by case."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

from benchmarks.common import median
from benchmarks.ledger import read_rows
from benchmarks.page.held import Claim
from benchmarks.page.tables import number, table
from benchmarks.recognition.trial import ENOUGH_TELLING, Row

# Scenes of these seeds and above are never looked at while anything is tuned.
PUBLICATION_SEEDS = 7400
SCENES = 100

K = TypeVar("K")


class Measured(NamedTuple):
    """One line: where its rows come from, and the rows."""

    comments: list[str]
    rows: list[Row]


Lines = Mapping[str, Measured]


def read_lines(folder: Path) -> Lines:
    """All of results/recognition_<line>.csv that are there, by line."""
    paths = {name: folder / f"recognition_{name}.csv" for name in CLAIMS}
    return {name: Measured(*read_rows(Row, path)) for name, path in paths.items() if path.exists()}


def section(lines: Lines) -> str:
    """The section, empty where nothing was measured."""
    if not lines:
        return ""
    claims = [[*told(name, lines[name].rows), name] for name in CLAIMS if name in lines]
    origins = []
    for name, (comments, rows) in lines.items():
        tuned = "; **seeds that were tuned on**" if min(row.seed for row in rows) < PUBLICATION_SEEDS else ""
        origins.append(f"- {name}: {len(rows)} searches; {'; '.join(comments)}{tuned}")
    return "\n".join(
        [
            HEAD,
            table(["", "target", "measured", "", "line"], claims),
            *origins,
            "",
            by_case(lines),
            decoys(lines["alarms"].rows) if "alarms" in lines else "",
        ]
    )


HEAD = f"""## Recognition: many parts, likenesses, occlusion

Scenes and definitions of success are in [benchmarks/README.md](../benchmarks/README.md); `python -m
benchmarks.recognition --line NAME --seeds A-B` makes the rows, each with the reason of what went wrong. Fewer than
{SCENES} scenes can miss a target but not show that it is held: then there is a dash. Seconds are wall-clock, with
whatever else the machine was at.
"""


def told(name: str, rows: Sequence[Row]) -> list[str]:
    """A line's target in words, what was measured, and whether it is held."""
    claim = CLAIMS[name](rows)
    scenes = len({row.seed for row in rows})
    held = None if claim.held and scenes < SCENES else claim.held
    return [claim.what, claim.limit, claim.measured, {True: "held", False: "**NOT held**", None: "–"}[held]]


def alarms(rows: Sequence[Row]) -> Claim:
    """Recall where the score asked for is above that of every false alarm in the scenes without the part."""
    without, there = [row for row in rows if not row.instances], [row for row in rows if row.instances]
    loudest = max((row.false_score for row in without if row.false), default=-math.inf)
    recall = share(sum(row.score > loudest for row in there), len(there))
    at_default = share(sum(row.right for row in there), len(there))
    words = (
        f"{recall:.2f} of {len(there)} at a score above {loudest:.2f}; as it is: {at_default:.2f}, and "
        f"{sum(row.false for row in without)} false in {len(without)} scenes without"
        if loudest > 0.0
        else f"{recall:.2f} of {len(there)}; no false alarm in {len(without)} scenes without"
    )
    return Claim("recall at zero false alarms, decoys present", "≥ 0.98", words, recall >= 0.98)


def instances(rows: Sequence[Row]) -> Claim:
    """By instance, over all scenes."""
    right, there = sum(row.right for row in rows), sum(row.instances for row in rows)
    false = sum(row.false for row in rows)
    recall, precision = share(right, there), share(right, right + false)
    words = f"recall {recall:.3f}, precision {precision:.3f}: {right} of {there}, {false} false"
    held = recall >= 0.97 and precision >= 0.99
    return Claim("30 instances of 10 models in one plant scene", "recall ≥ 0.97, precision ≥ 0.99", words, held)


def occlusion(rows: Sequence[Row]) -> Claim:
    """Where the recall falls through a half."""
    what, limit = "occlusion at which half are still found", "≥ 0.90"
    halves = {part: half_found(mine) for part, mine in grouped(rows, lambda row: row.case.split()[0]).items()}
    words = ", ".join(f"{part} {half:.2f}" for part, half in halves.items())
    return Claim(what, limit, words, min(halves.values()) >= 0.9)


def half_found(rows: Sequence[Row]) -> float:
    """The occlusion at which the recall, linear between the cases, first falls below a half; NaN if it never was."""
    levels = [
        (median([row.occlusion for row in mine]), share(sum(row.right for row in mine), len(mine)))
        for mine in grouped(rows, lambda row: float(row.case.split()[1])).values()
    ]
    before = None
    for at, recall in sorted(levels):
        if recall < 0.5:
            if before is None:
                return math.nan
            return before[0] + (at - before[0]) * (before[1] - 0.5) / (before[1] - recall)
        before = at, recall
    return before[0] if before else math.nan


def likeness(rows: Sequence[Row]) -> Claim:
    """Detections that lie on the part in a wrong pose, where the data tell."""
    asked = [row for row in rows if row.can_tell()]
    wrong = sum(row.likeness for row in asked)
    missed = sum(not row.right for row in asked)
    words = f"{wrong} in {len(asked)}; the part not found in {missed} of them"
    return Claim("wrong symmetric or mirrored pose, where the data tell", "0 in 200", words, wrong == 0)


def pose(rows: Sequence[Row]) -> Claim:
    """Medians over what was found."""
    right = [row for row in rows if row.right]
    mm, deg = median([row.error_mm for row in right]), median([row.error_deg for row in right])
    words = f"{mm:.2f} mm, {deg:.4f}° over {len(right)} of {len(rows)} found"
    limit = "median ≤ 0.3 mm, 0.01°"
    return Claim("pose error, 2 mm noise, full visibility", limit, words, mm <= 0.3 and deg <= 0.01)


def library(rows: Sequence[Row]) -> Claim:
    """The hundred over the one, scene by scene."""
    times = {(row.case, row.seed): row.total_s for row in rows}
    ratios = [s / times["1", seed] for (case, seed), s in times.items() if case == "100" and ("1", seed) in times]
    ratio = median(ratios)
    found = sum(row.right for row in rows if row.case == "100")
    words = f"{ratio:.1f} × over {len(ratios)} scenes, the spool found in {found}"
    held = ratio <= 5.0 and found == len(ratios)
    return Claim("time, a library of 100 against 1 model, and the part found", "≤ 5 ×", words, held)


def choice(rows: Sequence[Row]) -> Claim:
    """The right one of two, and not the other in its place."""
    asked = [row for row in rows if row.can_tell()]
    right = sum(bool(row.right) and not row.likeness for row in asked)
    words = f"{right} of {len(asked)} where {ENOUGH_TELLING} points or more tell ({len(rows)} scenes)"
    return Claim("near duplicates: the right one of two", "every time the data tell", words, right == len(asked))


CLAIMS: dict[str, Callable[[Sequence[Row]], Claim]] = {
    "alarms": alarms,
    "instances": instances,
    "occlusion": occlusion,
    "likeness": likeness,
    "pose": pose,
    "library": library,
    "choice": choice,
}


def by_case(lines: Lines) -> str:
    """Every case of every line: counts, medians of errors over what is right, median seconds."""
    rows = []
    for name in CLAIMS:
        for case, mine in grouped(lines[name].rows if name in lines else [], lambda row: row.case).items():
            right = [row for row in mine if row.right]
            rows.append(
                [
                    name, case, f"{len(mine)}", f"{sum(row.instances for row in mine)}",
                    f"{sum(row.right for row in mine)}", f"{sum(row.false for row in mine)}",
                    f"{sum(row.likeness for row in mine)}", number(median([row.error_mm for row in right]), 2),
                    number(median([row.error_deg for row in right]), 3),
                    number(median([row.search_s for row in mine]), 2), number(median([row.total_s for row in mine]), 2),
                ]
            )  # fmt: skip
    head = [
        "line",
        "case",
        "searches",
        "instances",
        "right",
        "false",
        "on an instance",
        "mm",
        "°",
        "search s",
        "total s",
    ]
    return table(head, rows)


def decoys(rows: Sequence[Row]) -> str:
    """What false alarms lie on, in scenes without the part."""
    without = [row for row in rows if not row.instances]
    counts = Counter(name for row in without for name in row.false_on.split("+") if name)
    if not counts:
        return ""
    listed = [[name, f"{count}"] for name, count in sorted(counts.items(), key=lambda one: (-one[1], one[0]))]
    return "False alarms in scenes without the part, by what they lie on:\n\n" + table(["", "false alarms"], listed)


def grouped(rows: Sequence[Row], key: Callable[[Row], K]) -> dict[K, list[Row]]:
    """Rows by a key, in the order they come."""
    groups: dict[K, list[Row]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    return groups


def share(some: int, all_: int) -> float:
    """NaN of nothing."""
    return some / all_ if all_ else math.nan
