"""The record stage for sources that send by themselves: receive, queue, write, watch."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tooltip_cli.errors import LowDiskError, TooltipError
from tooltip_cli.log.crashsafe import MIN_FREE_BYTES, CrashSafeWriter, leftovers
from tooltip_cli.log.messages import Message
from tooltip_cli.log.stopping import Stop
from tooltip_cli.method.voting.watching import Verdict
from tooltip_cli.sources.live import QUEUE_BYTES, LiveSource
from tooltip_cli.stages.listening import Listening, StreamStatus
from tooltip_cli.stages.record import Recorded, attach_rig
from tooltip_cli.stages.watching import MotionObserver

METADATA = "tooltip_recording"
_STATUS_EVERY_S = 0.25


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
class Status:
    """A recording while it is made."""

    elapsed_s: float  # since the first image
    streams: tuple[StreamStatus, ...]
    queued_bytes: int
    size_bytes: int
    free_bytes: int  # on the disk
    verdict: Verdict | None  # None: without a rig the motion is not judged


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
        recorder.heard.note(
            f"{place} is what an earlier recording left; 'tooltip salvage' recovers it"
        )
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
            reasons = "; ".join(recorder.heard.ends) or "it was stopped before"
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
        self.heard = Listening(source, reconnect=options.reconnect, queue_bytes=options.queue_bytes)
        self._first_image: float | None = None

    def run(self, writer: CrashSafeWriter, out: Path) -> None:
        """Receive and write until an end is reached."""
        for message in self._source.first_messages():
            self._write(writer, message)
        self.heard.start()
        shown = 0.0
        try:
            while not self._ended():
                self._drain(writer, 0.05)
                if time.monotonic() - shown > _STATUS_EVERY_S:
                    shown = time.monotonic()
                    self._tell_news()
                    self._on_status(self._status(writer, out))
        finally:
            self.heard.halt()
        while self._drain(writer, 0.0):
            pass

    def close(self) -> None:
        """Say what was lost and why it ended."""
        self.heard.count_drops("written")
        for reason in self.heard.ends:
            self.heard.note(f"ended: {reason}")
        if self._observer is not None and self._observer.problem:
            self.heard.note(f"the motion was not judged: {self._observer.problem}")
        self._tell_news()

    def _drain(self, writer: CrashSafeWriter, timeout_s: float) -> bool:
        """Write what waits; return whether there was anything."""
        messages = self.heard.backlog.take(timeout_s)
        for message in messages:
            self._write(writer, message)
            self.heard.backlog.written(message)
        return bool(messages)

    def _write(self, writer: CrashSafeWriter, message: Message) -> None:
        writer.write(message)
        self._source.report.count(message.topic)
        if self._first_image is None and message.topic == self._source.image_topic:
            self._first_image = time.monotonic()
        if self._observer is not None:
            self._observer.take(message)

    def _ended(self) -> bool:
        """Whether an end is reached; its reason is then in ``ends``, or was the user's own."""
        options = self._options
        if self.heard.ended:
            return True
        if self._stop.requested:
            return True
        if self._first_image is not None and options.duration_s is not None:
            return time.monotonic() - self._first_image >= options.duration_s
        if options.until_enough and self._observer is not None and self._observer.ample:
            self.heard.ends.append("the motion is enough")
            return True
        return self.heard.patience_is_over(options.patience_s)

    def _tell_news(self) -> None:
        for note in self.heard.news():
            self._on_note(note)

    def _status(self, writer: CrashSafeWriter, out: Path) -> Status:
        return Status(
            elapsed_s=(0.0 if self._first_image is None else time.monotonic() - self._first_image),
            streams=tuple(self.heard.streams()),
            queued_bytes=self.heard.backlog.waiting_bytes,
            size_bytes=writer.written_bytes,
            free_bytes=shutil.disk_usage(out.parent).free,
            verdict=self._observer.verdict() if self._observer is not None else None,
        )
