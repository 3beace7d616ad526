"""The record stage: a source's messages into one log, with the rig beside them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from tooltip_cli.errors import StoppedError, TooltipError
from tooltip_cli.log.crashsafe import FLUSH_EVERY_S, MIN_FREE_BYTES, CrashSafeWriter, leftovers
from tooltip_cli.log.messages import Message
from tooltip_cli.log.stopping import Stop
from tooltip_cli.rig.rigfile import Rig, rig_files
from tooltip_cli.sources.base import Source, SourceReport

_MEDIA_TYPES = {
    ".yaml": "application/yaml",
    ".urdf": "application/xml",
    ".json": "application/json",
}


@dataclass(frozen=True)
class Recorded:
    """A finished recording and what was read for it."""

    path: Path
    report: SourceReport


def record(
    source: Source,
    out: Path,
    *,
    rig: Rig | None = None,
    overwrite: bool = False,
    min_free_bytes: int = MIN_FREE_BYTES,
    flush_every_s: float | None = FLUSH_EVERY_S,
    stop: Stop | None = None,
    keep_unfinished: bool = True,
    on_image: Callable[[], None] = lambda: None,
) -> Recorded:
    """Write everything that a source yields to ``out``.

    Until all of it is there the file is called ``OUT.mcap.unfinished``, and keeps that name when
    the work is cut short: by ``stop``, a full disk, or the end of the process. A source that fails
    leaves nothing, for it can be read again.

    Args:
        rig: stored in the log; default: the source's own.
        min_free_bytes: stop before the disk has less than this left.
        stop: asked between messages.
        keep_unfinished: False for what is made again anyway.
        on_image: called after every image, for progress.

    Raises:
        StoppedError: ``stop`` was requested.
        LowDiskError: less than ``min_free_bytes`` are left on the disk.
        TooltipError: the output exists or cannot be written, or the source fails.
    """
    for place in leftovers(out):
        source.report.notes.append(
            f"{place} is what an earlier recording left; 'tooltip salvage' recovers it"
        )
    images = 0
    rig = rig or source.rig
    with CrashSafeWriter(
        out, overwrite=overwrite, min_free_bytes=min_free_bytes, flush_every_s=flush_every_s
    ) as writer:
        try:
            # first, so that they are in whatever part of the file survives
            if rig is not None:
                attach_rig(writer, rig)
            for message in _messages(source, writer):
                writer.write(message)
                if message.topic == source.image_topic:
                    images += 1
                    on_image()
                if stop is not None and stop.requested:
                    break
            if not images:
                writer.discard()
                raise TooltipError(f"the source of {out} holds no images, so nothing was written")
            _attach(writer, source.attachments())
            if stop is not None and stop.requested:
                raise _stopped(stop, writer, images, source.frames)
        except BaseException:
            if not keep_unfinished:
                writer.discard()
            raise
    return Recorded(out, source.report)


def attach_rig(writer: CrashSafeWriter, rig: Rig) -> None:
    """Store a rig as files beside the messages."""
    _attach(writer, {name: text.encode() for name, text in rig_files(rig).items()})


def _messages(source: Source, writer: CrashSafeWriter) -> Iterator[Message]:
    try:
        yield from source.messages()
    except TooltipError:
        writer.discard()
        raise


def _attach(writer: CrashSafeWriter, files: Mapping[str, bytes]) -> None:
    for name, data in files.items():
        media_type = _MEDIA_TYPES.get(Path(name).suffix, "application/octet-stream")
        writer.attach(name, media_type, data)


def _stopped(stop: Stop, writer: CrashSafeWriter, images: int, total: int | None) -> StoppedError:
    of = f" of {total}" if total is not None else ""
    return StoppedError(
        f"stopped by {stop.reason}: {writer.unfinished_path} holds {images}{of} images; 'tooltip "
        "salvage' makes a recording of it"
    )
