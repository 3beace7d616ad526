"""The record stage for sources that send by themselves: receive, queue, write, watch."""

from __future__ import annotations

import logging
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from tooltip_cli.errors import LowDiskError, TooltipError
from tooltip_cli.log.crashsafe import MIN_FREE_BYTES, CrashSafeWriter, leftovers
from tooltip_cli.log.messages import Message, header_stamp_ns
from tooltip_cli.log.stopping import Stop
from tooltip_cli.method.voting.watching import Verdict
from tooltip_cli.sources.live import QUEUE_BYTES, Backlog, LiveSource, Receiver
from tooltip_cli.stages.record import Recorded, attach_rig
from tooltip_cli.stages.watching import MotionObserver

METADATA = "tooltip_recording"
_LOG = logging.getLogger(__name__)
_STATUS_EVERY_S = 0.25
_RATE_OVER_S = 2.0
_SILENT_S = 1.0  # reported
_RETRY_S = 1.0
_JOIN_S = 2.0
_STEP_NS = 500_000_000  # back in stamps: a clock that was set, not messages that overtook others
_STEPS_TOLD = 3  # of a topic; two senders with clocks apart would be told without end


@dataclass(frozen=True)
class LiveOptions:
    """When a live recording ends, and what it may take up."""

    duration_s: float | None = None  # from the first image on; None: until it is stopped
    until_enough: bool = False  # end when the motion has shown the tip well
    reconnect: bool = False  # wait for a source that disappears, instead of ending
    patience_s: float = 10.0  # without images, after which it ends
    queue_bytes: int = QUEUE_BYTES
    min_free_bytes: int = MIN_FREE_BYTES


@dataclass(frozen=True)
class StreamStatus:
    """One topic while it is recorded."""

    topic: str
    received: int
    dropped: int
    rate_hz: float  # over the last two seconds
    silent: bool  # nothing for a second
    expected: bool  # images, joints or poses


@dataclass(frozen=True)
class Status:
    """A recording while it is made."""

    elapsed_s: float  # since the first image
    streams: tuple[StreamStatus, ...]
    queued_bytes: int
    size_bytes: int
    free_bytes: int  # on the disk
    verdict: Verdict | None  # None: without a rig the motion is not judged


@dataclass
class _Heard:
    received: int = 0
    since: float = field(default_factory=time.monotonic)  # last message, or the start
    silent: bool = False
    history: deque[tuple[float, int]] = field(default_factory=deque)
    latest_ns: int = 0  # header stamp
    steps: int = 0  # of the stamps, backwards


def record_live(
    source: LiveSource,
    out: Path,
    options: LiveOptions,
    *,
    stop: Stop,
    overwrite: bool = False,
    observer: MotionObserver | None = None,
    on_status: Callable[[Status], None] = lambda status: None,
    on_note: Callable[[str], None] = lambda note: None,
) -> Recorded:
    """Write what a source sends to ``out`` until one of several ends is reached.

    It ends when ``stop`` is requested, after the duration, when the motion is enough, or when the
    source ends or falls silent; all of these finish the file, with everything received before.

    Args:
        observer: judges the motion; None: nobody does.
        on_status: called four times a second.
        on_note: called with every note of the report, within a quarter of a second.

    Raises:
        LowDiskError: too little space was left; the file is finished and holds what came before.
        TooltipError: no image came, and no file was made; or the file cannot be written.
    """
    recorder = _Recorder(source, options, stop, observer, on_status, on_note)
    for place in leftovers(out):
        recorder.note(f"{place} is what an earlier recording left; 'tooltip salvage' recovers it")
    low: LowDiskError | None = None
    with CrashSafeWriter(out, overwrite=overwrite, min_free_bytes=options.min_free_bytes) as writer:
        if source.rig is not None:
            attach_rig(writer, source.rig)
        writer.metadata(METADATA, dict(source.metadata()))
        try:
            recorder.run(writer, out)
        except LowDiskError as error:
            low = error
        if not source.report.read.get(source.image_topic):
            writer.discard()
            reasons = "; ".join(recorder.ends) or "it was stopped before"
            raise TooltipError(f"{out} was not written, for no image came: {reasons}")
        recorder.close()
    if low is not None:
        raise low
    return Recorded(out, source.report)


class _Recorder:
    def __init__(
        self,
        source: LiveSource,
        options: LiveOptions,
        stop: Stop,
        observer: MotionObserver | None,
        on_status: Callable[[Status], None],
        on_note: Callable[[str], None],
    ) -> None:
        self._source, self._options, self._stop = source, options, stop
        self._observer, self._on_status, self._on_note = observer, on_status, on_note
        self._backlog = Backlog(options.queue_bytes)
        self._halt = threading.Event()
        self._threads: list[threading.Thread] = []
        self._heard = {topic: _Heard() for topic in source.expected_topics}
        self._first_image: float | None = None
        self._lock = threading.Lock()
        self._told = 0  # notes of the report, which the receivers' threads add to as well
        self.ends: list[str] = []

    def note(self, text: str) -> None:
        """Keep a sentence for a person, who is told soon."""
        self._source.report.notes.append(text)

    def run(self, writer: CrashSafeWriter, out: Path) -> None:
        """Receive and write until an end is reached."""
        for message in self._source.first_messages():
            self._write(writer, message)
        for receiver in self._source.receivers():
            thread = threading.Thread(target=self._listen, args=(receiver,), daemon=True)
            self._threads.append(thread)
            thread.start()
        shown = 0.0
        try:
            while not self._ended():
                self._drain(writer, 0.05)
                if time.monotonic() - shown > _STATUS_EVERY_S:
                    shown = time.monotonic()
                    self._tell_news()
                    self._on_status(self._status(writer, out))
        finally:
            self._halt.set()
        for thread in self._threads:
            thread.join(_JOIN_S)
        while self._drain(writer, 0.0):
            pass

    def close(self) -> None:
        """Say what was lost and why it ended."""
        for topic, count in sorted(self._backlog.counts()[1].items()):
            reason = f"messages on {topic} that came faster than they could be written"
            self._source.report.dropped[reason] = count
        for reason in self.ends:
            self.note(f"ended: {reason}")
        if self._observer is not None and self._observer.problem:
            self.note(f"the motion was not judged: {self._observer.problem}")
        self._tell_news()

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
                if not self._options.reconnect:
                    self.ends.append(reason)
                    return
                if reason != told:
                    self.note(f"{reason}; waiting for it")
                    told = reason
            self._halt.wait(_RETRY_S)

    def _deliver(self, message: Message) -> None:
        if not self._halt.is_set():
            self._backlog.put(message)

    def _drain(self, writer: CrashSafeWriter, timeout_s: float) -> bool:
        """Write what waits; return whether there was anything."""
        messages = self._backlog.take(timeout_s)
        for message in messages:
            self._write(writer, message)
            self._backlog.written(message)
        return bool(messages)

    def _write(self, writer: CrashSafeWriter, message: Message) -> None:
        writer.write(message)
        self._source.report.count(message.topic)
        if self._first_image is None and message.topic == self._source.image_topic:
            self._first_image = time.monotonic()
        if message.topic in self._source.expected_topics:
            self._follow_clock(message)
        if self._observer is not None:
            self._observer.take(message)

    def _follow_clock(self, message: Message) -> None:
        """Say where the stamps of a topic step back."""
        heard, stamp_ns = self._heard[message.topic], header_stamp_ns(message.payload)
        if stamp_ns is None:
            return
        back_ns = heard.latest_ns - stamp_ns
        if back_ns > _STEP_NS and heard.steps < _STEPS_TOLD:
            heard.steps += 1
            self.note(
                f"stamps on {message.topic} step back by {back_ns / 1e9:.1f} s: the sender's clock "
                "was set, or it has started again"
            )
        heard.latest_ns = stamp_ns

    def _ended(self) -> bool:
        """Whether an end is reached; its reason is then in ``ends``, or was the user's own."""
        options, now = self._options, time.monotonic()
        with self._lock:
            if self.ends:
                return True
        if self._stop.requested:
            return True
        if self._first_image is not None and options.duration_s is not None:
            return now - self._first_image >= options.duration_s
        if options.until_enough and self._observer is not None and self._observer.ample:
            self.ends.append("the motion is enough")
            return True
        heard = self._heard[self._source.image_topic]
        if not options.reconnect and now - heard.since > options.patience_s:
            self.ends.append(
                f"no image on {self._source.image_topic} for {options.patience_s:.0f} s"
            )
            return True
        return False

    def _tell_news(self) -> None:
        notes = self._source.report.notes
        while self._told < len(notes):
            self._on_note(notes[self._told])
            self._told += 1

    def _status(self, writer: CrashSafeWriter, out: Path) -> Status:
        now = time.monotonic()
        received, dropped = self._backlog.counts()
        streams = [
            self._stream(topic, now, received.get(topic, 0), dropped.get(topic, 0))
            for topic in {**self._heard, **dict.fromkeys(received)}
        ]
        return Status(
            elapsed_s=0.0 if self._first_image is None else now - self._first_image,
            streams=tuple(streams),
            queued_bytes=self._backlog.waiting_bytes,
            size_bytes=writer.written_bytes,
            free_bytes=shutil.disk_usage(out.parent).free,
            verdict=self._observer.verdict() if self._observer is not None else None,
        )

    def _stream(self, topic: str, now: float, received: int, dropped: int) -> StreamStatus:
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
