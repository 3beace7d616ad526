"""Work in chunks on threads, results in order."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from itertools import islice
from typing import TypeVar

import numpy as np

_KEPT_BYTES = 16 << 20

_Result = TypeVar("_Result")


def in_order(
    work: Callable[[int], list[_Result]], starts: Iterable[int], jobs: int
) -> Iterator[_Result]:
    """Yield what ``work`` returns for each start, in their order, whatever the number of threads.

    At most ``jobs + 1`` chunks are under way, so memory does not grow with their number.
    """
    remaining = iter(starts)
    with threads_are_ours(), ThreadPoolExecutor(jobs) as pool:

        def submit(count: int) -> list[Future[list[_Result]]]:
            return [pool.submit(work, start) for start in islice(remaining, count)]

        pending = submit(jobs + 1)
        try:
            while pending:
                yield from pending.pop(0).result()
                pending += submit(1)
        finally:
            for future in pending:
                future.cancel()


@contextmanager
def threads_are_ours() -> Iterator[None]:
    """Let every piece of work have one core, and keep its memory.

    OpenCV would divide each image among all cores, on top of the chunks that run side by side. And
    glibc returns memory to the system as soon as twice the largest array ever freed lies idle,
    which with arrays of a few megabytes is after every image: clearing it again for the next one
    takes 5 % of the time. Having freed one larger array stops that.
    """
    import cv2

    np.empty(_KEPT_BYTES, np.uint8)
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
