"""How every kernel is compiled."""

from __future__ import annotations

from numba import njit

# Kept on disk, since compiling takes a third of a second each; free of the interpreter's lock, for threads; dividing as
# NumPy does. No second entry point for C: nothing calls one, and it is a thirtieth of the time to compile.
kernel = njit(cache=True, nogil=True, error_model="numpy", no_cfunc_wrapper=True)
