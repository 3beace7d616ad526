"""Memory of runs over many recordings."""

from __future__ import annotations

import ctypes
import sys

_MMAP_THRESHOLD = -3  # M_MMAP_THRESHOLD of glibc's malloc.h
_LARGE = 1 << 20  # bytes


def give_back_large_arrays() -> None:
    """Let arrays above 1 MiB leave the process when they are freed, where the C library is glibc.

    By itself it raises that threshold to 32 MiB as large arrays come and go, and then keeps them
    between the smaller things of the next recording: 100 MB after three.
    """
    if not sys.platform.startswith("linux"):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # absent from other C libraries
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, _LARGE)
