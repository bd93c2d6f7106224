"""Work on ranges, on several threads; kernels release the interpreter's lock, so threads are enough on one machine."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Generic, TypeVar

Owner = TypeVar("Owner")
Result = TypeVar("Result")
Thing = TypeVar("Thing")

# Pieces a thread: a few, so that one slow piece does not leave the others waiting.
PIECES = 4


def in_threads(jobs: int, count: int, work: Callable[[int, int], Result]) -> list[Result]:
    """Call work(start, stop) over 0 … count in pieces and return the results in order.

    What a piece does must not depend on where it begins: then the outcome is the same for any number of jobs. Work must
    not itself ask for threads: it would wait for the one it runs in.
    """
    if count <= 0:
        return []
    if jobs <= 1:
        return [work(0, count)]
    pieces = min(count, jobs * PIECES)
    bounds = [count * k // pieces for k in range(pieces + 1)]
    return list(_threads(jobs).map(work, bounds[:-1], bounds[1:]))


def each_in_threads(jobs: int, things: Sequence[Thing], work: Callable[[Thing], Result]) -> list[Result]:
    """What work(thing) gives of each thing, in order; see `in_threads`."""
    pieces = in_threads(jobs, len(things), lambda start, stop: [work(thing) for thing in things[start:stop]])
    return [result for piece in pieces for result in piece]


def side_by_side(jobs: int, *works: Callable[[], None]) -> None:
    """Call works that do not meet, at the same time where there is more than one job."""
    if jobs <= 1:
        for work in works:
            work()
        return
    for running in [_threads(jobs).submit(work) for work in works]:
        running.result()


@cache
def _threads(jobs: int) -> ThreadPoolExecutor:
    """Threads that stay: a search asks for them 30 times, and starting two takes 3 ms while others compute."""
    return ThreadPoolExecutor(jobs, "scanfind")


if hasattr(os, "register_at_fork"):  # threads do not come along into a child process
    os.register_at_fork(after_in_child=_threads.cache_clear)


class once(Generic[Owner, Result]):  # noqa: N801  it is used as `property` is
    """What is computed when first asked for: `functools.cached_property`, which before Python 3.12 computes for one
    instance of a class at a time, whatever the threads. Two that ask for the same at once may both compute it.
    """

    def __init__(self, compute: Callable[[Owner], Result]) -> None:
        self._compute, self.__doc__ = compute, compute.__doc__

    def __set_name__(self, owner: type[Owner], name: str) -> None:
        self._name = name

    def __get__(self, instance: Owner, owner: type[Owner]) -> Result:
        result = instance.__dict__[self._name] = self._compute(instance)  # where Python looks first
        return result


def available_cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
