"""Make docs/benchmarks.md and its plots from benchmarks/results: paper_*.csv, recognition_*.csv, calibration_*.csv.

python -m benchmarks.page
python -m benchmarks.page --pictures 5000      # also those of found poses, which takes a search each
"""

from __future__ import annotations

import sys
from pathlib import Path

import cyclopts

from benchmarks.common import RESULTS, ROOT
from benchmarks.page import calibration, plots
from benchmarks.page import pictures as photographs
from benchmarks.page.recognition import read_lines
from benchmarks.page.results import read
from benchmarks.page.text import page


def main(results: Path = RESULTS, docs: Path = ROOT / "docs", pictures: int | None = None) -> None:
    """Write the page and its plots.

    :param results: folder of paper_<system>.csv, recognition_<line>.csv and calibration_<part>.csv.
    :param docs: folder for benchmarks.md and pictures/.
    :param pictures: seed of the scene whose pictures are made anew; left out, they stay as they are.
    """
    found = read(results)
    if not found.rows:
        sys.exit(f"error: no paper_<system>.csv in {results}: make them with `make paper-quick` or `make paper`")
    parts = calibration.read_parts(results)
    drawn = [*plots.draw(found, docs / "pictures"), *calibration.draw(parts, docs / "pictures")]
    if pictures is not None:
        drawn += photographs.draw(docs / "pictures", pictures)
    path = docs / "benchmarks.md"
    path.write_text(page(found, read_lines(results)) + calibration.section(parts), encoding="utf-8")
    print(path, *drawn, sep="\n")


if __name__ == "__main__":
    cyclopts.run(main)
