"""Hear a live source in threads: its messages, its silences, and why it ended."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from dataclasses import dataclass, field

from tooltip_cli.errors import TooltipError
from tooltip_cli.log.messages import Message
from tooltip_cli.sources.live import QUEUE_BYTES, Backlog, LiveSource, Receiver

_LOG = logging.getLogger(__name__)
_RATE_OVER_S = 2.0
_SILENT_S = 1.0  # reported
_RETRY_S = 1.0
_JOIN_S = 2.0


@dataclass(frozen=True)
class StreamStatus:
    """One topic while it is heard."""

    topic: str
    received: int
    dropped: int
    rate_hz: float  # over the last two seconds
    silent: bool  # nothing for a second
    expected: bool  # images, joints or poses


@dataclass
class _Heard:
    received: int = 0
    since: float = field(default_factory=time.monotonic)  # last message, or the start
    silent: bool = False
    history: deque[tuple[float, int]] = field(default_factory=deque)


class Listening:
    """The receivers of a source at work, each in a thread, and a bounded queue behind them.

    Args:
        reconnect: run a receiver that ends again, and wait for it, instead of ending.
        queue_bytes: of the messages that wait to be taken.

    Attributes:
        ends: why receivers have ended.
    """

    def __init__(
        self, source: LiveSource, *, reconnect: bool = False, queue_bytes: int = QUEUE_BYTES
    ) -> None:
        self._source, self._reconnect = source, reconnect
        self.backlog = Backlog(queue_bytes)
        self._halt = threading.Event()
        self._threads: list[threading.Thread] = []
        self._heard = {topic: _Heard() for topic in source.expected_topics}
        self._lock = threading.Lock()
        self._told = 0  # notes of the report, which the receivers' threads add to as well
        self.ends: list[str] = []

    def note(self, text: str) -> None:
        """Keep a sentence for a person, who is told soon."""
        self._source.report.notes.append(text)

    def news(self) -> list[str]:
        """Return the notes that have not been returned before."""
        notes = self._source.report.notes[self._told :]
        self._told += len(notes)
        return notes

    def start(self) -> None:
        """Begin to listen."""
        for receiver in self._source.receivers():
            thread = threading.Thread(target=self._listen, args=(receiver,), daemon=True)
            self._threads.append(thread)
            thread.start()

    def halt(self) -> None:
        """Stop listening; what was received before still waits in the backlog."""
        self._halt.set()
        for thread in self._threads:
            thread.join(_JOIN_S)

    @property
    def ended(self) -> bool:
        """Whether a receiver has ended for good."""
        with self._lock:
            return bool(self.ends)

    def patience_is_over(self, patience_s: float) -> bool:
        """Whether no image has come for too long, as of the last :meth:`streams`; it is an end."""
        topic = self._source.image_topic
        if self._reconnect or time.monotonic() - self._heard[topic].since <= patience_s:
            return False
        reason = f"no image on {topic} for {patience_s:.0f} s"
        if reason not in self.ends:
            self.ends.append(reason)
        return True

    def streams(self) -> list[StreamStatus]:
        """Return how every topic stands, and note those that fall silent or are back."""
        received, dropped = self.backlog.counts()
        return [
            self._stream(topic, received.get(topic, 0), dropped.get(topic, 0))
            for topic in {**self._heard, **dict.fromkeys(received)}
        ]

    def count_drops(self, what: str) -> None:
        """Enter what did not fit in the queue into the report; ``what`` was not done in time."""
        for topic, count in sorted(self.backlog.counts()[1].items()):
            reason = f"messages on {topic} that came faster than they could be {what}"
            self._source.report.dropped[reason] = count

    def _listen(self, receiver: Receiver) -> None:
        """Run a receiver in its thread, again and again where that is asked for."""
        told = ""
        while not self._halt.is_set():
            try:
                receiver.run(self._deliver, self._halt)
                reason = f"{receiver.name} has ended"
            except TooltipError as error:
                reason = str(error)
            except Exception as error:  # of a driver or of a user's own joint source
                _LOG.debug("receiver failed", exc_info=True)
                reason = f"{receiver.name} failed ({type(error).__name__}: {error})"
            if self._halt.is_set():
                return
            with self._lock:
                if not self._reconnect:
                    self.ends.append(reason)
                    return
                if reason != told:
                    self.note(f"{reason}; waiting for it")
                    told = reason
            self._halt.wait(_RETRY_S)

    def _deliver(self, message: Message) -> None:
        if not self._halt.is_set():
            self.backlog.put(message)

    def _stream(self, topic: str, received: int, dropped: int) -> StreamStatus:
        now = time.monotonic()
        heard = self._heard.setdefault(topic, _Heard())
        expected = topic in self._source.expected_topics
        if received > heard.received:
            if heard.silent:
                again = "again " if heard.received else ""
                self.note(f"{topic} is heard {again}after {now - heard.since:.1f} s")
            heard.received, heard.since, heard.silent = received, now, False
        elif expected and not heard.silent and now - heard.since > _SILENT_S:
            heard.silent = True
            self.note(f"nothing on {topic} " + ("yet" if not received else "any more"))
        heard.history.append((now, received))
        while now - heard.history[0][0] > _RATE_OVER_S:
            heard.history.popleft()
        before, count = heard.history[0]
        rate = (received - count) / (now - before) if now > before else 0.0
        return StreamStatus(topic, received, dropped, rate, heard.silent, expected)
