"""Open rivals of scanfind, each in an environment of its own, asked all in the same way.

from benchmarks.rivals import available, run

for name in available():
    print(name, run(name, points, origins, station, mesh))
"""

from __future__ import annotations

from benchmarks.rivals.answer import Answer
from benchmarks.rivals.runner import run
from benchmarks.rivals.table import RIVALS, Rival, available

__all__ = ["RIVALS", "Answer", "Rival", "available", "run"]
