"""Rows of candidates, and what is made of them.

python -m benchmarks.calibration --part fit            # seeds 8000-8159: what the map is made from
python -m benchmarks.calibration --part held           # seeds 9000-9099: what it is held against
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import cyclopts

from benchmarks.calibration.candidates import Row, candidates
from benchmarks.calibration.questions import question
from benchmarks.common import RESULTS, seeds_of
from benchmarks.ledger import Ledger
from benchmarks.paper.systems import warm_up
from scanfind.errors import ScanfindError

SEEDS = {"fit": "8000-8159", "held": "9000-9099"}


def main(part: str = "fit", seeds: str = "", out: Path = RESULTS, *, fresh: bool = False, date: str = "") -> None:
    """Search the scenes of one part; seeds already there are not searched again.

    :param part: fit or held.
    :param seeds: of the scenes; left out, those of the part.
    :param out: folder for calibration_<part>.csv.
    :param fresh: replace what is there.
    :param date: written to the CSV.
    """
    warm_up()
    ledger = Ledger(Row, out / f"calibration_{part}.csv", date, fresh)
    done = {row.seed for row in ledger.rows}
    for seed in seeds_of(seeds or SEEDS[part]):
        if seed in done:
            continue
        asked = question(seed)
        rows = candidates(asked)
        for row in rows:
            ledger.add(row)
        print(f"{seed} {asked.scene} {asked.sensor}: {told(rows)}", file=sys.stderr, flush=True)


def told(rows: Sequence[Row]) -> str:
    """What a search came to, on a line."""
    counts = Counter((row.told, "right" if row.right else "wrong") for row in rows)
    return ", ".join(f"{count} {how} and {label}" for (how, label), count in counts.items()) or "no candidate"


if __name__ == "__main__":
    try:
        cyclopts.run(main)
    except ScanfindError as error:
        sys.exit(f"error: {error}")
