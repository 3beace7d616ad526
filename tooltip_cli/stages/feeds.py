"""Where watched messages come from: a live source, or a recording that is played."""

from __future__ import annotations

import time
from collections.abc import Generator, Sequence
from dataclasses import replace
from typing import Protocol

from tooltip_cli.log.container import LoggedMessage, iterate
from tooltip_cli.log.messages import Message
from tooltip_cli.log.recording import Recording
from tooltip_cli.rig.rigfile import Rig
from tooltip_cli.sources.live import ArrivalClock, LiveSource
from tooltip_cli.stages.listening import Listening

_STATUS_EVERY_S = 0.25
_LONGEST_WAIT_S = 0.05  # of a take, so that whoever asks can look after other things


class Feed(Protocol):
    """Messages as they come; their log times are arrivals by :attr:`clock`."""

    @property
    def clock(self) -> ArrivalClock:
        """The clock of the arrivals."""

    @property
    def paced(self) -> bool:
        """Whether messages come whether or not they are taken; else they wait."""

    @property
    def image_topic(self) -> str:
        """The topic of the images."""

    def take(self) -> list[Message]:
        """Return what has come, after a moment at the latest."""

    def ended(self) -> str:
        """Return why nothing more will come; empty while something may."""

    def close(self) -> list[Message]:
        """Stop, and return what had come before."""

    def news(self) -> Sequence[str]:
        """Return sentences for a person that were not returned before."""

    def dropped(self) -> int:
        """Return how many messages were lost because they were not taken in time."""


class LiveFeed:
    """A live source, listened to.

    Args:
        reconnect: wait for receivers that end, instead of ending.
        patience_s: without images, after which it ends.
    """

    def __init__(
        self, source: LiveSource, *, reconnect: bool = False, patience_s: float = 10.0
    ) -> None:
        self.clock, self.paced = ArrivalClock(), True
        self.image_topic = source.image_topic
        self._source, self._patience_s = source, patience_s
        self._heard = Listening(source, reconnect=reconnect)
        self._first = list(source.first_messages())
        self._looked = time.monotonic()
        self._heard.start()

    def take(self) -> list[Message]:
        """Return what has come, after a moment at the latest."""
        now = time.monotonic()
        if now - self._looked > _STATUS_EVERY_S:
            self._looked = now
            self._heard.streams()
        first, self._first = self._first, []
        found = first + self._heard.backlog.take(_LONGEST_WAIT_S)
        for message in found[len(first) :]:
            self._heard.backlog.written(message)
        return found

    def ended(self) -> str:
        """Return why nothing more will come."""
        if self._heard.ended or self._heard.patience_is_over(self._patience_s):
            return "; ".join(self._heard.ends)
        return ""

    def close(self) -> list[Message]:
        """Stop, and return what had come before."""
        self._heard.halt()
        self._heard.count_drops("taken")
        return self._heard.backlog.take(0.0)

    def news(self) -> Sequence[str]:
        """Return sentences for a person."""
        return self._heard.news()

    def dropped(self) -> int:
        """Return how many messages did not fit in the queue."""
        return sum(self._heard.backlog.counts()[1].values())


class PlayedFeed:
    """A recording, played by its log times.

    Args:
        speed: times its own speed; 0: as fast as it is taken.
    """

    def __init__(self, recording: Recording, rig: Rig, speed: float) -> None:
        self.clock, self.paced = ArrivalClock(), speed > 0
        self.image_topic = recording.image_topic
        self._recording, self._speed = recording, speed
        topics = {recording.image_topic, recording.joint_topic}
        self._messages = _messages(recording, topics | {recording.pose_topic or rig.pose_topic})
        self._next = next(self._messages, None)
        self._began: tuple[int, int] | None = None  # log time and arrival of the first message

    def take(self) -> list[Message]:
        """Return what is due; unpaced, all up to the next image."""
        found: list[Message] = []
        until_ns = self.clock.now_ns() + round(_LONGEST_WAIT_S * 1e9)
        while self._next is not None:
            due_ns = self._due_ns(self._next)
            if due_ns > until_ns:
                break
            time.sleep(max(due_ns - self.clock.now_ns(), 0) / 1e9)
            message = self._next
            found.append(replace(message, log_time_ns=due_ns))
            self._next = next(self._messages, None)
            if message.topic == self.image_topic:
                return found
        if not found and self._next is not None:
            time.sleep(_LONGEST_WAIT_S)
        return found

    def ended(self) -> str:
        """Say that it is over."""
        return "the recording is over" if self._next is None else ""

    def close(self) -> list[Message]:
        """Play no further."""
        self._messages.close()
        return []

    def news(self) -> Sequence[str]:
        """Say nothing."""
        return ()

    def dropped(self) -> int:
        """Lose nothing."""
        return 0

    def _due_ns(self, message: Message) -> int:
        now_ns = self.clock.now_ns()
        if not self.paced:
            return now_ns
        if self._began is None:
            self._began = (message.log_time_ns, now_ns)
        since_ns = message.log_time_ns - self._began[0]
        return self._began[1] + round(since_ns / self._speed)


def _messages(recording: Recording, topics: set[str | None]) -> Generator[Message, None, None]:
    for item in iterate(recording.path):
        if isinstance(item, LoggedMessage) and item.topic in topics and item.encoding == "cdr":
            yield Message(item.topic, item.datatype, item.log_time_ns, item.payload)
