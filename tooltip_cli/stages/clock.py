"""Where the processor time goes, while somebody asks."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Lap = Callable[[str], None]
"""Told the name of each step when it ends."""


class Stopwatch:
    """Adds up the processor time of all threads by what it was spent on.

    Attributes:
        seconds: step -> processor seconds, in the order in which the steps first ended.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._lock = threading.Lock()
        self._start = time.process_time()

    def laps(self) -> Lap:
        """Return a lap counter that starts now, for the thread that calls it."""
        last = time.thread_time()

        def lap(step: str) -> None:
            nonlocal last
            now = time.thread_time()
            with self._lock:
                self.seconds[step] = self.seconds.get(step, 0.0) + now - last
            last = now

        return lap

    def total(self) -> float:
        """Return the processor seconds of this process since the stopwatch was made."""
        return time.process_time() - self._start


_running: Stopwatch | None = None


@contextmanager
def measuring(wanted: bool = True) -> Iterator[Stopwatch | None]:
    """Measure what the stages do until the block ends; nothing where it is not wanted."""
    global _running  # noqa: PLW0603  (one run is measured at a time, and its stages are many)
    before, _running = _running, Stopwatch() if wanted else None
    try:
        yield _running
    finally:
        _running = before


def laps() -> Lap:
    """Return a lap counter of the stopwatch that runs, or one that does nothing."""
    return _running.laps() if _running is not None else _ignore


def _ignore(step: str) -> None:
    """Nobody measures."""
