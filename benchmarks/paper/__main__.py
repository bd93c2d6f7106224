"""The paper's tables on scanfind and on its rivals: one row a scene and system, in results/paper_<system>.csv.

python -m benchmarks.paper --seeds 5000-5019            # goes on where it was interrupted
python -m benchmarks.paper --seeds 0-4 --experiments clutter --targets PS --out /tmp/tuning --fresh
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import cyclopts

from benchmarks.common import RESULTS, median, seeds_of
from benchmarks.ledger import Ledger
from benchmarks.paper.definitions import is_right
from benchmarks.paper.experiments import EXPERIMENTS, Case, Missing, cases
from benchmarks.paper.rows import Row, error_of, judged
from benchmarks.paper.sets import DATA, set_cases
from benchmarks.paper.systems import OURS, System, retries, scanfind_with, systems
from benchmarks.paper.targets import target
from scanfind.errors import ScanfindError


def main(
    seeds: str = "5000-5019", experiments: str = ",".join(EXPERIMENTS), targets: str = "PS,BF",
    system: str = "scanfind,sharif2017,rivals", rows: str = "",
    set_name: Annotated[str, cyclopts.Parameter("--set")] = "", data: Path = DATA, out: Path = RESULTS, *,
    fresh: bool = False, date: str = "",
) -> None:  # fmt: skip
    """Run the paper's experiments; rows already there are not run again.

    :param seeds: of the scenes; 0-99 are for tuning, 5000 and up for publication.
    :param experiments: density (Tables 5, 6), clutter (7, 8), completeness (9, 10), branch, effectiveness (11, 12).
    :param targets: PS (pipe spool), BF (box frame).
    :param system: scanfind, sharif2017, a rival's name, or rivals for all that are installed.
    :param rows: only rows of these names, such as 51.295,500.
    :param set_name: instead of the experiments: milk_kinect, pump_e57, or a folder as benchmarks/paper/sets.py says.
    :param data: folder that holds milk_kinect and pump_e57.
    :param out: folder for paper_<system>.csv.
    :param fresh: replace what is there.
    :param date: written to the CSV.
    """
    chosen, only = systems(system.split(",")), rows.split(",") if rows else []
    stem = f"paper_set_{Path(set_name).resolve().name}" if set_name else "paper"
    ledgers = {name: Ledger(Row, out / f"{stem}_{name}.csv", date, fresh) for name in chosen}

    def missing(experiment: str, key: str, row: str, seed: int, run: int) -> bool:
        if only and row not in only:
            return False
        return any((experiment, key, row, seed, run) not in ledger.keys for ledger in ledgers.values())

    for case in wanted(seeds_of(seeds), experiments.split(","), targets.split(","), set_name, data, missing):
        for name, ledger in ledgers.items():
            if case.key() not in ledger.keys:
                ledger.add(row := ask(case, name, chosen[name]))
                print(told(row), file=sys.stderr, flush=True)
    for name, ledger in ledgers.items():
        print(*summary(name, ledger.rows), sep="\n")


def wanted(
    seeds: Sequence[int], experiments: Sequence[str], targets: Sequence[str], set_name: str, data: Path,
    missing: Missing,
) -> Iterator[Case]:  # fmt: skip
    """The cases asked for that some system has not answered yet."""
    if set_name:
        for seed in seeds:
            yield from (case for case in set_cases(set_name, data, seed) if missing(*case.key()))
        return
    for key in targets:
        for seed in seeds:
            yield from cases(experiments, target(key), seed, missing)


def ask(case: Case, name: str, system: System) -> Row:
    """Put a case to a system and judge what it says."""
    seed = 1000 * case.run + case.seed
    row = judged(case, name, system(case.cloud, case.model, seed))
    if case.experiment != "effectiveness" or row.success or name not in OURS:
        return row
    again = (scanfind_with(parameters, case.cloud, case.model, seed) for parameters in retries(OURS[name]))
    return replace(row, at_all=int(any(one.poses and is_right(error_of(one.poses[0], case)) for one in again)))


def told(row: Row) -> str:
    """A row on a line."""
    return (
        f"{row.system} {row.experiment} {row.target} {row.row} seed {row.seed}: "
        f"{'found' if row.success else 'FAILED'} rr {row.rr:.3f} precision {row.precision:.3f} "
        f"{row.error_mm:.2f} mm {row.error_deg:.3f} deg {row.total_s:.2f} s {row.note}"
    )


def summary(name: str, rows: list[Row]) -> list[str]:
    """Success rate and medians over all scenes, by row of the tables."""
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.experiment, row.target, row.row), []).append(row)
    lines = [f"{name}: experiment, target, row: success, RR, precision, mm, seconds"]
    for (experiment, target_key, row_name), group in groups.items():
        right = [row for row in group if row.success]
        lines.append(
            f"{experiment:13} {target_key} {row_name:>8}: {len(right):3}/{len(group):<3} "
            f"{median([row.rr for row in group]):.3f} {median([row.precision for row in right]):.3f} "
            f"{median([row.error_mm for row in right]):6.2f} {median([row.total_s for row in group]):6.2f}"
        )
    return lines


if __name__ == "__main__":
    try:
        cyclopts.run(main)
    except ScanfindError as error:
        sys.exit(f"error: {error}")
