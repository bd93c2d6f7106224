"""Where the time goes: seconds by stage, and how far a pass over the points has come."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from scanfind.cloud import PointChunk
    from scanfind.progress import Progress

# As results.json has them, with the total beside; "place": what the design has, tried where it has it.
STAGES = ("read", "library", "grid", "place", "search", "verify", "refine", "isolate", "measure", "write")


class Clock:
    """Seconds by stage; a stage begun inside another stops the outer one's clock."""

    def __init__(self) -> None:
        self._began = self._since = time.perf_counter()
        self._seconds = dict.fromkeys((*STAGES, "total"), 0.0)
        self._stack = ["total"]

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Charge the block's time to a stage."""
        self._charge()
        self._stack.append(stage)
        try:
            yield
        finally:
            self._charge()
            self._stack.pop()

    def _charge(self) -> None:
        now = time.perf_counter()
        self._seconds[self._stack[-1]] += now - self._since
        self._since = now

    def elapsed(self, *stages: str) -> float:
        """Seconds charged to some stages so far."""
        return sum(self._seconds[stage] for stage in stages)

    def timings(self) -> dict[str, float]:
        """Seconds by stage and in total."""
        self._charge()
        return {**self._seconds, "total": time.perf_counter() - self._began}


def watched(
    chunks: Iterator[PointChunk], clock: Clock, tell: Progress, stage: str, expected: int
) -> Iterator[PointChunk]:
    """The chunks; their reading charged to "read", their points told as progress of a stage."""
    done = 0
    while True:
        with clock("read"):
            chunk = next(chunks, None)
        if chunk is None:
            return
        yield chunk
        done += len(chunk) + chunk.dropped
        tell(stage, done, expected)


def say_if_compiling(tell: Progress) -> None:
    """Tell the stage "compile" where the kernels of a search or of isolation must be compiled first: once a machine."""
    from scanfind.kernels import COMPILE_S, compiled
    from scanfind.kernels.distance import distances
    from scanfind.kernels.search import test_pairs
    from scanfind.kernels.surfels import fit_cells

    if not compiled(distances, test_pairs, fit_cells):
        tell("compile", 0.0, COMPILE_S)
