"""Rows as the page needs them: by system and row of a table, the paper's own figures among them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.common import median
from benchmarks.ledger import read_rows
from benchmarks.paper.experiments import EXPERIMENTS
from benchmarks.paper.rows import Row
from benchmarks.paper.targets import paper, target

TARGETS = {"PS": "pipe spool", "BF": "box frame"}
PAPER = "paper"
# scanfind first; then as the paper had it; rivals by name.
FIRST = ("scanfind", "sharif2017")
TABLES = {"density": (5, 6), "clutter": (7, 8), "completeness": (9, 10)}
RATIOS = {"density": "density_ratio", "clutter": "clutter_ratio", "completeness": "completeness_ratio"}


@dataclass(frozen=True)
class Printed:
    """A row as the paper prints it; NaN for what it does not say."""

    success: float
    rr: float
    rms_cm: float
    seconds: float


@dataclass(frozen=True)
class Results:
    """Everything measured.

    rows : by system; comments : the origin lines of each system's file
    """

    rows: dict[str, list[Row]]
    comments: dict[str, list[str]]

    def of(self, system: str, experiment: str, target_key: str, row: str | None = None) -> list[Row]:
        """The rows of one table, or of one row of it."""
        return [
            one
            for one in self.rows.get(system, [])
            if (one.experiment, one.target) == (experiment, target_key) and row in (None, one.row)
        ]

    def systems(self, experiment: str, target_key: str) -> list[str]:
        """Who took part."""
        return [system for system in self.rows if self.of(system, experiment, target_key)]

    def row_names(self, experiment: str, target_key: str) -> list[str]:
        """The rows of a table that anybody ran, in the table's order."""
        ran = {one.row for rows in self.rows.values() for one in rows
               if (one.experiment, one.target) == (experiment, target_key)}  # fmt: skip
        return [row.name for row in EXPERIMENTS[experiment](target(target_key)) if row.name in ran]


def read(folder: Path) -> Results:
    """All of results/paper_<system>.csv."""
    files = {path.stem.removeprefix("paper_"): path for path in folder.glob("paper_*.csv")}
    names = sorted((name for name in files if not name.startswith("set_")), key=lambda name: (_rank(name), name))
    tables = {name: read_rows(Row, files[name]) for name in names}
    return Results({name: rows for name, (_, rows) in tables.items()}, {name: c for name, (c, _) in tables.items()})


def printed(experiment: str, target_key: str) -> dict[str, Printed]:
    """The paper's rows of a table, by their ratio as written."""
    if experiment not in TABLES:
        return {}
    number = TABLES[experiment][target_key == "BF"]
    table = paper()[f"table{number}_{experiment}_{target_key}"][0]
    rows = {}
    for k, ratio in enumerate(table[RATIOS[experiment]]):
        seconds = _number(table["time_s"][k])
        found = float(table["SR"][k]) if "SR" in table else float(not math.isnan(seconds))
        rr, rms = (_number(table[name][k]) if name in table else math.nan for name in ("RR", "RMS_cm"))
        rows[f"{ratio:g}"] = Printed(found, rr, rms, seconds)
    return rows


def success(rows: Sequence[Row]) -> float:
    """Share of all scenes; NaN for none."""
    return sum(row.success for row in rows) / len(rows) if rows else math.nan


def middle(rows: Sequence[Row], value: Callable[[Row], float]) -> float:
    """Median over those rows that have the value."""
    return median([number for row in rows if not math.isnan(number := value(row))])


def _number(value: Any) -> float:
    return float(value) if isinstance(value, (int, float)) else math.nan


def _rank(name: str) -> int:
    return FIRST.index(name) if name in FIRST else len(FIRST)
