"""What every reader returns and every writer is given."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tooltip_cli.errors import TooltipError
from tooltip_cli.labels.book import TipLabel

POINT = "tip"  # what exports call the point
_MAX_FILE_BYTES = 256 * 2**20


@dataclass(frozen=True)
class Mark:
    """What a file of another tool says of one point in one image."""

    image: int | str  # number of a frame, or name of an image file
    point: str | None  # its name; None: whichever point is labelled
    state: str  # visible, occluded or out_of_view
    pixel: tuple[float, float] | None = None  # as the tool counts; None unless visible
    labeler: str | None = None
    size: tuple[int, int] | None = None  # of the image, as the file says


@dataclass(frozen=True)
class Foreign:
    """A file of another tool."""

    source: str
    tool: str
    corner: bool  # (0, 0) is the first pixel's outer corner, not its centre
    marks: tuple[Mark, ...]
    left_out: Mapping[str, int] = field(default_factory=dict)  # why -> how many
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Shown:
    """One frame of an export."""

    image: int  # index in the recording
    stamp_ns: int
    name: str  # of the image file
    label: TipLabel | None


@dataclass(frozen=True)
class Album:
    """What an export is about."""

    name: str  # of the recording
    size: tuple[int, int]  # width, height of the images
    frames: tuple[Shown, ...]


def read_text(path: Path) -> str:
    """Return the text of a file.

    Raises:
        TooltipError: it is absent, too large, or not UTF-8.
    """
    try:
        if path.stat().st_size > _MAX_FILE_BYTES:
            raise TooltipError(f"{path}: too large for a file of labels")
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise TooltipError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise TooltipError(f"{path}: cannot be read (not UTF-8 text)") from error


def parse_json(text: str, source: str) -> Any:
    """Return a JSON document.

    Raises:
        TooltipError: it is none.
    """
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise TooltipError(f"{source}: not JSON ({error})") from error


def malformed(source: str, tool: str, error: Exception) -> TooltipError:
    """Return the error for a file that lacks what its tool writes."""
    return TooltipError(f"{source}: not as {tool} writes it ({error!r})")


def json_text(document: Any) -> str:
    """Return what a JSON export holds."""
    return json.dumps(document, indent=1) + "\n"
