"""The lines of recognition: one row a search, in results/recognition_<line>.csv.

python -m benchmarks.recognition --line alarms --seeds 7400-7449     # goes on where it was interrupted
python -m benchmarks.recognition --line choice --seeds 3 --cases rating --out /tmp/tuning --fresh
"""

from __future__ import annotations

import sys
from pathlib import Path

import cyclopts

from benchmarks.common import RESULTS, seeds_of
from benchmarks.ledger import Ledger
from benchmarks.paper.systems import warm_up
from benchmarks.recognition.judge import answer
from benchmarks.recognition.lines import LINES
from benchmarks.recognition.trial import Key, Row
from scanfind.errors import ScanfindError, UsageError


def main(
    line: str = ",".join(LINES), seeds: str = "7400-7419", cases: str = "", out: Path = RESULTS, *,
    fresh: bool = False, date: str = "",
) -> None:  # fmt: skip
    """Search the scenes of some lines; rows already there are not searched again.

    :param line: alarms, instances, occlusion, likeness, pose, library, choice, sensors; several with commas.
    :param seeds: of the scenes; 0-99 are for tuning, 7400 and up for publication.
    :param cases: only cases of these names, such as "pipe_spool without,rating".
    :param out: folder for recognition_<line>.csv.
    :param fresh: replace what is there.
    :param date: written to the CSV.
    """
    only = cases.split(",") if cases else []
    if unknown := [name for name in line.split(",") if name not in LINES]:
        msg = f"no line {unknown[0]!r}; there are {', '.join(LINES)}"
        raise UsageError(msg)
    warm_up()
    for name in line.split(","):
        ledger = Ledger(Row, out / f"recognition_{name}.csv", date, fresh)

        def wants(key: Key, kept: Ledger[Row] = ledger) -> bool:
            return key not in kept.keys and (not only or key[1] in only)

        for seed in seeds_of(seeds):
            for trial in LINES[name](seed, wants):
                ledger.add(row := answer(trial))
                print(told(row), file=sys.stderr, flush=True)


def told(row: Row) -> str:
    """A row on a line."""
    return (
        f"{row.line} {row.case} seed {row.seed}: {row.right} of {row.instances} right, {row.false} false, "
        f"occlusion {row.occlusion:.2f}, telling {row.telling:.0f}, {row.error_mm:.2f} mm {row.error_deg:.3f} deg, "
        f"{row.total_s:.2f} s{': ' * bool(row.note)}{row.note}"
    )


if __name__ == "__main__":
    try:
        cyclopts.run(main)
    except ScanfindError as error:
        sys.exit(f"error: {error}")
