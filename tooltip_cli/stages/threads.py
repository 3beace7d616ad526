"""Work in chunks on threads, results in order."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

_Result = TypeVar("_Result")


def in_order(
    work: Callable[[int], list[_Result]], starts: Iterable[int], jobs: int
) -> Iterator[_Result]:
    """Yield what ``work`` returns for each start, in their order, whatever the number of threads.

    At most ``jobs + 1`` chunks are under way, so memory does not grow with their number.
    """
    remaining = iter(starts)
    with ThreadPoolExecutor(jobs) as pool:

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
