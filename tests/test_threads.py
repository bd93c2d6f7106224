"""Work on threads: in order, whatever their number; what is computed once, of several instances at a time."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import pytest

from scanfind.threads import each_in_threads, in_threads, once

BOTH = Barrier(2)


class Asked:
    """Something with a costly answer."""

    def __init__(self) -> None:
        self.times = 0

    @once
    def answer(self) -> int:
        """Told."""
        self.times += 1
        return 42

    @once
    def together(self) -> int:
        """Only while another instance is asked as well."""
        return BOTH.wait(timeout=20.0)


@pytest.mark.parametrize("jobs", [1, 2, 3])
def test_pieces_come_back_in_order(jobs: int) -> None:
    pieces = in_threads(jobs, 17, lambda start, stop: list(range(start, stop)))
    assert [number for piece in pieces for number in piece] == list(range(17))
    assert each_in_threads(jobs, range(17), lambda number: -number) == [-number for number in range(17)]
    assert in_threads(jobs, 0, lambda start, stop: start + stop) == []


def test_what_is_computed_once_is_computed_once_an_instance() -> None:
    one, other = Asked(), Asked()
    assert one.answer == one.answer == 42
    assert (one.times, other.times) == (1, 0)
    assert other.answer == 42


def test_two_instances_compute_at_the_same_time() -> None:
    with ThreadPoolExecutor(2) as threads:
        assert sorted(threads.map(lambda asked: asked.together, [Asked(), Asked()])) == [0, 1]
