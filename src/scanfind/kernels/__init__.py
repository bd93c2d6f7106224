"""Compiled loops: arrays in, arrays out; the only place that imports numba."""

from __future__ import annotations

from pathlib import Path
from typing import Any

COMPILE_S = 20.0  # roughly, on two cores, for the kernels of one search


def compiled(*kernels: Any) -> bool:
    """Have kernels been compiled on this machine before, so that they only need loading?"""
    return all(_is_cached(kernel) for kernel in kernels)


def _is_cached(kernel: Any) -> bool:
    # Numba has no public way to ask; without its cache every start compiles, and saying so is right.
    folder = getattr(getattr(kernel, "_cache", None), "cache_path", None)
    name = f"{kernel.__module__.rpartition('.')[2]}.{kernel.__name__}"
    return folder is not None and any(Path(folder).glob(f"{name}-*.nbc"))
