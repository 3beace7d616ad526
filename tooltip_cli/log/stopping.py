"""Ending a recording on Ctrl-C, ``kill`` or a lost terminal, with what was received kept."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")


class Stop:
    """Whether somebody asked for the end; to be looked at between messages."""

    def __init__(self) -> None:
        self._event = threading.Event()
        self.reason = ""  # the signal's name, or what :meth:`request` was told

    @property
    def requested(self) -> bool:
        """Whether the end was asked for."""
        return self._event.is_set()

    def request(self, reason: str) -> None:
        """Ask for the end; the first reason is kept."""
        self.reason = self.reason or reason
        self._event.set()

    def wait(self, timeout_s: float) -> bool:
        """Wait for the request, at most this long; return whether it came."""
        return self._event.wait(timeout_s)


@contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """Yield what SIGINT, SIGTERM and SIGHUP set in place of ending the program.

    A second signal ends it as usual. Outside the main thread, where Python allows no handlers,
    nothing is set.
    """
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    numbers = [getattr(signal, name) for name in _SIGNALS if hasattr(signal, name)]
    before = {number: signal.getsignal(number) for number in numbers}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def handle(number: int, frame: FrameType | None) -> None:
        restore()
        stop.request(signal.Signals(number).name)

    for number in numbers:
        # a hang-up that nohup has ruled out stays ruled out
        if before[number] is not signal.SIG_IGN:
            signal.signal(number, handle)
    try:
        yield stop
    finally:
        restore()
