"""Candidates of simulated scenes, and the curves they make.

python -m benchmarks.calibration --part fit       # the scenes the curves are made from
python -m benchmarks.calibration --part held      # those they are held against
python -m benchmarks.calibration --part curves    # from the rows of fit what evidence.confidence.CURVES are to be
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import cyclopts

from benchmarks.calibration.candidates import Row, candidates
from benchmarks.calibration.fit import curves
from benchmarks.calibration.questions import question
from benchmarks.common import RESULTS, seeds_of
from benchmarks.ledger import Ledger, read_rows
from benchmarks.paper.systems import warm_up
from scanfind.errors import ScanfindError

SEEDS = {"fit": "8000-8390", "held": "9100-9454"}


def main(part: str = "fit", seeds: str = "", out: Path = RESULTS, *, fresh: bool = False, date: str = "") -> None:
    """Search the scenes of one part; seeds already there are not searched again. Or print the curves.

    :param part: fit, held or curves.
    :param seeds: of the scenes; left out, those of the part.
    :param out: folder for calibration_<part>.csv.
    :param fresh: replace what is there.
    :param date: written to the CSV.
    """
    if part == "curves":
        print(*curves(read_rows(Row, out / "calibration_fit.csv")[1]).items(), sep="\n")
        return
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
