"""The record stage: a source's messages into one log, with the rig beside them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tooltip_cli.errors import TooltipError
from tooltip_cli.log.writer import LogWriter
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
    on_image: Callable[[], None] = lambda: None,
) -> Recorded:
    """Write everything that a source yields to ``out``, whole or not at all.

    Args:
        rig: stored in the log; default: the source's own.
        on_image: called after every image, for progress.

    Raises:
        TooltipError: the output exists or cannot be written, or the source fails.
    """
    images = 0
    rig = rig or source.rig
    with LogWriter(out, overwrite=overwrite) as writer:
        for message in source.messages():
            writer.write(message)
            if message.topic == source.image_topic:
                images += 1
                on_image()
        if not images:
            raise TooltipError(f"the source of {out} holds no images, so nothing was written")
        files = {name: text.encode() for name, text in rig_files(rig).items()} if rig else {}
        for name, data in {**files, **source.attachments()}.items():
            media_type = _MEDIA_TYPES.get(Path(name).suffix, "application/octet-stream")
            writer.attach(name, media_type, data)
    return Recorded(out, source.report)
