"""What a process has freed, given back to the system, where the C library is glibc."""

from __future__ import annotations

import ctypes
import sys
from typing import Any

_MMAP_THRESHOLD = -3  # M_MMAP_THRESHOLD of glibc's malloc.h
MANY_RECORDINGS = 1 << 20  # bytes
ONE_RECORDING = 8 << 20  # bytes: about as little is held, and fewer pages are taken anew


def give_back_large_arrays(above: int) -> None:
    """Let arrays above a size leave the process when they are freed.

    By itself glibc raises that threshold to 32 MiB as large arrays come and go, and then keeps
    them between the smaller things of the next recording: 100 MB after three.

    Args:
        above: bytes; `MANY_RECORDINGS` or `ONE_RECORDING`.
    """
    mallopt = _of_the_c_library("mallopt")
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, above)


def give_back_freed() -> None:
    """Let go of the free pages between what is still held; takes some milliseconds.

    Threads that work on images leave 40 MB of them.
    """
    trim = _of_the_c_library("malloc_trim")
    if trim is not None:
        trim(0)


def _of_the_c_library(name: str) -> Any:
    """Return a function of glibc; None where the C library is another."""
    if not sys.platform.startswith("linux"):
        return None
    return getattr(ctypes.CDLL(None), name, None)
