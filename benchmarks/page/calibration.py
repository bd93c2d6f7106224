"""The page's section on probabilities, from results/calibration_*.csv: are they true, and what a threshold lets by."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.calibration.candidates import BELIEVED, Row
from benchmarks.calibration.fit import bins, error_by_chance, expected_error, named, probability
from benchmarks.ledger import read_rows
from benchmarks.page.held import Claim
from benchmarks.page.plots import STYLE
from benchmarks.page.tables import number, table
from scanfind.evidence.confidence import CURVES

LIMIT = 0.05
# Bins of equally many: of some hundred detections five, so that each has twenty.
BINS, BINS_TOLD = 10, 5
THRESHOLDS = (0.9, 0.95, 0.98, 0.99, 0.995)

HEAD = """## Probabilities: are they true?

Each search is of three likenesses (spools, or frames, that differ in one respect), of which two, one or none are there,
in a shop, behind boards, in a plant, in a steel frame, or thinned to 2 to 20 % of its points; scanned by the paper's
FARO, a modern phase scanner, the plain one of the other lines, one frame of structured light, or from nowhere that is
known. A candidate is what is told, or is among the three closest refused of each model; it is right if its model is
there, at its pose, and was not told before. [docs/score.md](score.md) says how a probability comes about;
[benchmarks/README.md](../benchmarks/README.md) has the columns.
"""

PICTURE = "![Share that is right against the probability told](pictures/calibration.svg)\n"


class Measured(NamedTuple):
    """One part, fit or held out: where its rows come from, and the rows."""

    comments: list[str]
    rows: list[Row]


def read_parts(folder: Path) -> dict[str, Measured]:
    """The parts of results/calibration_<part>.csv that are there."""
    paths = {part: folder / f"calibration_{part}.csv" for part in ("fit", "held")}
    return {part: Measured(*read_rows(Row, path)) for part, path in paths.items() if path.exists()}


def section(parts: dict[str, Measured]) -> str:
    """The section; empty where nothing was held out."""
    if "held" not in parts:
        return ""
    rows = parts["held"].rows
    told = [row for row in rows if row.told == BELIEVED]
    said = {True: "held", False: "**NOT held**", None: "–"}
    claims = [[one.what, one.limit, one.measured, said[one.held]] for one in claims_of(rows)]
    origins = [
        f"- {part}: {len(some)} candidates of {searches(some)} searches; {'; '.join(comments)}"
        for part, (comments, some) in parts.items()
    ]
    return "\n".join(
        [
            HEAD,
            table(["", "target", "measured on seeds held out", ""], claims),
            PICTURE,
            "By the curve a probability is read from:\n",
            shares(rows, named, list(CURVES)),
            "Detections, by scene and by sensor:\n",
            shares(told, lambda row: row.scene),
            shares(told, lambda row: row.sensor),
            "What a threshold lets by, over all seeds, fitted and held out, for no curve has a say in it:\n",
            thresholds([row for part in parts.values() for row in part.rows]),
            "Where the rows come from:\n",
            *origins,
            "",
        ]
    )


def claims_of(rows: Sequence[Row]) -> list[Claim]:
    """The expected calibration error, of what is told and of all candidates."""
    told = [row for row in rows if row.told == BELIEVED]
    limit = f"≤ {LIMIT:g}"
    claims = []
    for what, some, count in (("detections", told, BINS_TOLD), ("all candidates", rows, BINS)):
        said, right = arrays(some)
        error, chance = expected_error(said, right, count), error_by_chance(said, count)
        words = (
            f"{error:.3f} of {len(some)}, {count} bins (told {said.mean():.3f}, right {right.mean():.3f}; "
            f"were all true, so few would show {chance:.3f})"
        )
        claims.append(Claim(f"expected calibration error, {what}", limit, words, error <= LIMIT))
    return claims


def arrays(
    rows: Sequence[Row],
) -> tuple[np.ndarray[tuple[int], np.dtype[np.float64]], np.ndarray[tuple[int], np.dtype[np.int64]]]:
    """What is told of rows, (N,), and what is right, (N,)."""
    return np.array([probability(row) for row in rows]), np.array([row.right for row in rows], np.int64)


def shares(rows: Sequence[Row], key: Callable[[Row], str], order: Sequence[str] = ()) -> str:
    """Rows in groups: how many, what was told of them on average, and what share was right."""
    names = [*order, *sorted({key(row) for row in rows} - {*order})]
    lines = []
    for name in names:
        said, right = arrays([row for row in rows if key(row) == name])
        if len(said):
            lines.append([name, f"{len(said)}", f"{right.sum()}", number(said.mean(), 3), number(right.mean(), 3)])
    return table(["", "candidates", "right", "told", "share that is right"], lines)


def thresholds(rows: Sequence[Row]) -> str:
    """For each least score: of what is told, how much is right and how much false."""
    told = [row for row in rows if row.told == BELIEVED]
    count, lines = searches(rows), []
    for least in THRESHOLDS:
        some = [row for row in told if row.score >= least]
        right = sum(row.right for row in some)
        false = len(some) - right
        lines.append(
            [f"{least:g}", f"{right}", f"{false}", number(false / max(len(some), 1), 3), number(false / count, 3)]
        )
    head = ["least score", "right", "false", "false of all told", "false a search"]
    return table(head, lines)


def searches(rows: Sequence[Row]) -> int:
    """How many searches rows come from; of one that had no candidate there is none."""
    return len({row.seed for row in rows})


def draw(parts: dict[str, Measured], folder: Path) -> list[Path]:
    """The reliability diagram: of bins of equally many, the share that is right over what was told; ± one deviation."""
    if "held" not in parts:
        return []
    import matplotlib as mpl

    mpl.use("svg")
    from matplotlib import pyplot as plt

    rows = parts["held"].rows
    told = [row for row in rows if row.told == BELIEVED]
    with mpl.rc_context(STYLE):
        figure, axis = plt.subplots(figsize=(4.2, 4.0), layout="constrained")
        axis.plot([0, 1], [0, 1], color="#999999", linewidth=0.8, label="true")
        for some, count, colour, label in (
            (rows, BINS, "#7f7f7f", "all candidates"), (told, BINS_TOLD, "#0b5fa5", "detections")
        ):  # fmt: skip
            said, right = arrays(some)
            at = [(said[k].mean(), right[k].mean(), len(k)) for k in bins(said, count) if len(k)]
            x, y, n = (np.array(each) for each in zip(*at, strict=True))
            spread = np.sqrt(np.maximum(x * (1.0 - x), 0.0) / n)
            axis.errorbar(x, y, spread, fmt="o", markersize=3.5, color=colour, linewidth=0.8, label=label)
        axis.set_xlabel("probability told")
        axis.set_ylabel("share that is right")
        axis.legend(frameon=False, loc="upper left")
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / "calibration.svg"
        figure.savefig(path, metadata={"Date": None, "Creator": None})
        plt.close(figure)
    return [path]
