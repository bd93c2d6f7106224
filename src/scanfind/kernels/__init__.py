"""Compiled loops: arrays in, arrays out; the only place that imports numba."""

from __future__ import annotations

from pathlib import Path

COMPILE_S = 20.0  # roughly, on two cores, for the kernels of one search


def use_threads(jobs: int) -> None:
    """Let the parallel kernels, those of isolation, use so many threads, and no more than the machine offers."""
    import numba

    numba.set_num_threads(max(1, min(jobs, numba.config.NUMBA_NUM_THREADS)))


def compiled() -> bool:
    """Have the kernels been compiled on this machine before, so that they only need loading?"""
    from scanfind.kernels.search import test_pairs

    # Numba has no public way to ask; without its cache every start compiles, and saying so is right.
    cache = getattr(test_pairs, "_cache", None)
    folder = getattr(cache, "cache_path", None)
    return folder is not None and any(Path(folder).glob("search.test_pairs-*.nbc"))
