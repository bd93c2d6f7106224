"""The page's words and tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import attrgetter

from benchmarks.common import STAGES
from benchmarks.page.held import OURS, claims, ratio_of
from benchmarks.page.recognition import Lines, section
from benchmarks.page.results import PAPER, TABLES, TARGETS, Printed, Results, middle, printed, success
from benchmarks.page.tables import number, table
from benchmarks.paper.experiments import PUBLICATION_SEEDS
from benchmarks.paper.rows import Row
from benchmarks.paper.targets import paper

HEAD = """# Benchmarks: the paper's tables

Sharif, Nahangi, Haas & West, "Automated Model-Based Finding of 3D Objects in Cluttered Construction Point Cloud
Models" (2017), Tables 5 to 12, on scenes that anybody can make again. This page is made from the rows by
`make page`; nothing in it is typed. `make paper` makes the rows, `make paper-quick` a few of them in minutes;
[benchmarks/README.md](../benchmarks/README.md) has the definitions, what the scenes are, and the columns.
"""

# Told where rows of it are there.
SHARIF = """
`sharif2017` is the paper's settings in the same code: one pair distance, 20 s of uniform draws, and of all poses the
one with the most support, whatever beams passed through. What it misses is what support alone does not tell: a frame
turned over lies on the scan with as many of its points (errors of 180° in the rows).
"""

NOTES = {
    "density": "The paper's fully cluttered scene, thinned at random to the points a ratio stands for (10,000 for 1).",
    "clutter": "Cropped to what is nearest to the target. 100 and above: a hall of 20 bays, at the points of the full "
    "scene, so that the target is sparser too.",
    "completeness": "Branches of the target removed from the full scene, in an order drawn anew for each scene.",
    "branch": "One branch or member removed at a time: is any of them critical?",
}


# Why a target may be missed, by how its claim begins; told where it is.
WHY = {
    "density": (
        "At 200 points the part may be seen from one side and mostly hidden; then chance puts as many of its "
        "lines on the scene's as it has there."
    ),
    "every density and clutter row found": (
        "Isolated is what lies within four times the spread of its own points, 7 mm here, of the placed surface. "
        "Where a member lies on the floor or on a trestle, some of those points are its neighbour's."
    ),
    "RMS by the paper's definition": (
        "It measures to the nearest of the model's 10,000 points, and at the true pose these are so far away."
    ),
    "time a row": (
        "A row's scan of 322,191 points costs 0.2 s to sum, and a search half a second at least. Where the "
        "first round finds nothing others follow until a part that shows three tenths of itself is unlikely to "
        "have been missed."
    ),
    "time against rivals": (
        "They work on points thinned to a fiftieth of the part's diameter, a few thousand, and where little else "
        "stands about the right matches are soon drawn; our search costs half a second whatever the scan, and gains "
        "on them with clutter. Their rows but two a part are of one scene, run beside other work of lower priority."
    ),
    "pose error": (
        "All end in a fit to the same points, and their noise is what is left. Rivals' proposals are polished "
        "by an ICP of ours, with the scene's points as they are."
    ),
    "clutter": ("As for density: in the hall the part has 643 points at a ratio of 500."),
    "completeness": (
        "What is left is straight runs of pipe, and an elbow at most: each lies as well on other pipes. Of the right "
        "poses few are drawn, and those that slide along the run are not drawn back."
    ),
    "effectiveness ratio": (
        "Beside the right one another spool of the shop is reported, of which the scan shows the legs that "
        "both have in common, and hides the others."
    ),
}


def page(results: Results, lines: Lines) -> str:
    """docs/benchmarks.md."""
    parts = [HEAD, origin(results), held(results)]
    for experiment, numbers in TABLES.items():
        parts.append(f"## {experiment.capitalize()} (Tables {numbers[0]} and {numbers[1]})\n\n{NOTES[experiment]}\n")
        parts.append(f"![RR and time against {experiment}](pictures/{experiment}.svg)\n")
        parts += [by_system(results, experiment, key) + in_detail(results, experiment, key) for key in TARGETS]
    parts.append(f"## Each branch removed\n\n{NOTES['branch']}\n")
    parts += [by_system(results, "branch", key) for key in TARGETS]
    parts.append(effectiveness(results))
    parts += [PICTURES, section(lines)]
    return "\n".join(part for part in parts if part)


PICTURES = """## As in the paper's Figures 9 to 11

Scene (grey), the model where it was found (orange), and below it the isolated points.

![Density ratios 20, 5 and 1](pictures/figure_9.png)

![Clutter ratios of the paper's rows](pictures/figure_10.png)

![Branches removed](pictures/figure_11.png)
"""


def origin(results: Results) -> str:
    """Where the rows come from."""
    lines = ["## Where the rows come from\n"]
    for system, rows in results.rows.items():
        tuned = "; **seeds that were tuned on**" if min(row.seed for row in rows) < PUBLICATION_SEEDS else ""
        lines.append(f"- {system}: {len(rows)} rows; {'; '.join(results.comments[system])}{tuned}")
    return "\n".join(lines) + "\n" + (SHARIF if "sharif2017" in results.rows else "")


def held(results: Results) -> str:
    """The targets."""
    said = {True: "held", False: "**NOT held**", None: "–"}
    every = claims(results)
    rows = [[one.what, one.limit, one.measured, said[one.held]] for one in every]
    told = "## What scanfind is held to\n\n" + table(["", "target", "measured", ""], rows)
    missed = [one.what for one in every if one.held is False]
    reasons = [f"- {what}: {why}" for what, why in WHY.items() if any(one.startswith(what) for one in missed)]
    return told + "\nWhy targets are missed:\n\n" + "\n".join(reasons) + "\n" if reasons else told


def by_system(results: Results, experiment: str, key: str) -> str:
    """Success rate over all scenes and median time, a column a system."""
    names, systems = results.row_names(experiment, key), results.systems(experiment, key)
    if not names:
        return ""
    theirs = printed(experiment, key)
    columns = [*([PAPER] if theirs else []), *systems]
    rows = []
    for row in names:
        cells = [row]
        if theirs:
            one = theirs.get(row)
            cells.append("–" if one is None else "fails" if not one.success else f"found, {one.seconds:g} s")
        for system in systems:
            mine = results.of(system, experiment, key, row)
            cells.append(f"{success(mine):.2f}, {number(middle(mine, lambda r: r.total_s), 2)} s" if mine else "–")
        rows.append(cells)
    return f"**{TARGETS[key].capitalize()}**: success rate over all scenes, median time\n\n" + table(
        [experiment, *columns], rows
    )


def in_detail(results: Results, experiment: str, key: str) -> str:
    """All about scanfind's rows: medians over all scenes, of errors over those found; the paper's RR and RMS beside."""
    head = [
        experiment, "scenes", "points", "on object", "success", "false", "RR", "paper", "precision", "RMS cm", "paper",
        "to surface mm", "pose mm", "pose °", *(f"{stage} s" for stage in STAGES), "total s",
    ]  # fmt: skip
    rows = [
        [name, *details(mine, printed(experiment, key).get(name))]
        for name in results.row_names(experiment, key)
        if (mine := results.of(OURS, experiment, key, name))
    ]
    return f"\n{OURS} in detail, medians:\n\n" + table(head, rows) if rows else ""


def details(rows: Sequence[Row], theirs: Printed | None) -> list[str]:
    """The cells of a row of the table above, after its name."""
    right = [row for row in rows if row.success]
    return [
        f"{len(rows)}",
        f"{middle(rows, lambda r: r.scene_points):.0f}",
        f"{middle(rows, lambda r: r.object_points):.0f}",
        f"{success(rows):.2f}",
        f"{sum(row.false for row in rows)}",
        number(middle(rows, lambda r: r.rr), 3),
        number(theirs.rr if theirs else math.nan, 3),
        number(middle(rows, lambda r: r.precision), 3),
        number(middle(rows, lambda r: r.rms_cm), 2),
        number(theirs.rms_cm if theirs else math.nan, 2),
        number(middle(rows, lambda r: r.rms_surface_mm), 2),
        number(middle(right, lambda r: r.error_mm), 2),
        number(middle(right, lambda r: r.error_deg), 3),
        *(number(middle(rows, attrgetter(f"{stage}_s")), 2) for stage in STAGES),
        number(middle(rows, lambda r: r.total_s), 2),
    ]


def effectiveness(results: Results) -> str:
    """Tables 11 and 12."""
    rows = [
        [TARGETS[key], system, f"{len(mine)}", f"{success(mine):.2f}", f"{ratio_of(mine):.2f}"]
        for key in TARGETS
        for system in results.systems("effectiveness", key)
        if (mine := results.of(system, "effectiveness", key))
    ]
    for key, value in paper()["tables11_12_effectiveness"].items():
        rows.append([TARGETS[key], PAPER, "–", "–", f"{value['overlap_ratio_0_15']:.2f}"])
    return (
        "## Effectiveness (Tables 11 and 12)\n\nRuns in which the target was isolated and nothing else, over runs in "
        "which it was isolated at all, with other parameters after a failure.\n\n"
        + table(["", "system", "runs", "success", "effectiveness ratio"], rows)
    )
