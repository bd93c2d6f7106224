"""Work on ranges, on several threads; kernels release the interpreter's lock, so threads are enough on one machine."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Result = TypeVar("Result")

# Pieces a thread: a few, so that one slow piece does not leave the others waiting.
PIECES = 4


def in_threads(jobs: int, count: int, work: Callable[[int, int], Result]) -> list[Result]:
    """Call work(start, stop) over 0 … count in pieces and return the results in order.

    What a piece does must not depend on where it begins: then the outcome is the same for any number of jobs.
    """
    if count <= 0:
        return []
    if jobs <= 1:
        return [work(0, count)]
    pieces = min(count, jobs * PIECES)
    bounds = [count * k // pieces for k in range(pieces + 1)]
    with ThreadPoolExecutor(jobs) as pool:
        return list(pool.map(work, bounds[:-1], bounds[1:]))


def side_by_side(jobs: int, *works: Callable[[], None]) -> None:
    """Call works that do not meet, at the same time where there is more than one job."""
    if jobs <= 1:
        for work in works:
            work()
        return
    with ThreadPoolExecutor(len(works)) as pool:
        for running in [pool.submit(work) for work in works]:
            running.result()


def available_cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
