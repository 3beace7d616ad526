"""What sources that send by themselves have in common: receivers, their clock, the queue."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

from tooltip_cli.log.messages import Message
from tooltip_cli.log.recording import IMAGE_TYPES
from tooltip_cli.rig.rigfile import Rig
from tooltip_cli.sources.base import SourceReport

Deliver = Callable[[Message], None]

QUEUE_BYTES = 256_000_000
_RESERVE = 0.1  # of the queue, which images leave to everything else
_OVERHEAD_BYTES = 300  # of a message in memory, besides its payload


class Receiver(Protocol):
    """One thing that is listened to, in a thread of its own."""

    @property
    def name(self) -> str:
        """What to call it in messages, such as ``camera udp://:5000``."""

    def run(self, deliver: Deliver, halt: threading.Event) -> None:
        """Deliver messages as they come, until ``halt`` is set or nothing more can come.

        Called again to connect again.

        Raises:
            TooltipError: it cannot be reached, or was lost.
        """


class LiveSource(Protocol):
    """Receivers that together make a recording."""

    @property
    def image_topic(self) -> str:
        """The topic whose silence ends the recording."""

    @property
    def expected_topics(self) -> Sequence[str]:
        """Topics that should be heard, images included; their silence is reported."""

    @property
    def rig(self) -> Rig | None:
        """A rig to store in the log, or None."""

    @property
    def report(self) -> SourceReport:
        """What was read and left out; receivers may add to it."""

    def first_messages(self) -> Sequence[Message]:
        """Return what is known before anything is heard, such as the robot description."""

    def receivers(self) -> Sequence[Receiver]:
        """Return what is to be listened to."""

    def metadata(self) -> Mapping[str, str]:
        """Return how stamps came about, for whoever reads the log."""


class ArrivalClock:
    """Times of arrival: the wall clock's time at the start, carried on by the monotonic clock.

    Somebody who sets the wall clock meanwhile does not reach it.
    """

    def __init__(self) -> None:
        self.wall_ns, self.monotonic_ns = time.time_ns(), time.monotonic_ns()

    def now_ns(self) -> int:
        """Return nanoseconds since 1970."""
        return self.wall_ns + time.monotonic_ns() - self.monotonic_ns

    def metadata(self) -> dict[str, str]:
        """Return how this clock stands to the machine's two."""
        return {
            "log_time": "arrival, by the monotonic clock, which was set once to the wall clock",
            "wall_clock_at_start_ns": str(self.wall_ns),
            "monotonic_clock_at_start_ns": str(self.monotonic_ns),
        }


class Backlog:
    """A queue between receiving and writing that is bounded in bytes and never blocks a receiver.

    What does not fit is dropped and counted by topic. Other messages may still enter where images
    no longer fit, so that a flood of images does not cost the joints.

    Args:
        limit_bytes: of all messages that wait.
    """

    def __init__(self, limit_bytes: int = QUEUE_BYTES) -> None:
        self._limit = limit_bytes
        self._condition = threading.Condition()
        self._waiting: deque[Message] = deque()
        self._bytes = 0
        self._received: dict[str, int] = {}
        self._dropped: dict[str, int] = {}

    def put(self, message: Message) -> None:
        """Add a message, or drop and count it."""
        size = len(message.payload) + _OVERHEAD_BYTES
        limit = self._limit * (1 - _RESERVE if message.datatype in IMAGE_TYPES else 1)
        with self._condition:
            topic = message.topic
            self._received[topic] = self._received.get(topic, 0) + 1
            if self._bytes + size > limit:
                self._dropped[topic] = self._dropped.get(topic, 0) + 1
                return
            self._waiting.append(message)
            self._bytes += size
            self._condition.notify()

    def take(self, timeout_s: float) -> list[Message]:
        """Return everything that waits, as soon as there is something; empty after the timeout."""
        with self._condition:
            if not self._waiting:
                self._condition.wait(timeout_s)
            taken = list(self._waiting)
            self._waiting.clear()
        return taken

    def written(self, message: Message) -> None:
        """Give back the room of a message that was taken."""
        with self._condition:
            self._bytes -= len(message.payload) + _OVERHEAD_BYTES

    @property
    def waiting_bytes(self) -> int:
        """Bytes that were received and not yet written."""
        return self._bytes

    def counts(self) -> tuple[dict[str, int], dict[str, int]]:
        """Return messages received and messages dropped, by topic."""
        with self._condition:
            return dict(self._received), dict(self._dropped)
