"""Frames of a video file with their own times, through PyAV."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tooltip_cli.errors import TooltipError
from tooltip_cli.sources.base import SourceReport
from tooltip_cli.sources.streams import missing_extra, one_line


@dataclass(frozen=True)
class VideoFrame:
    """One decoded frame."""

    time_ns: int | None  # on the video's own clock; None where the file gives none
    pixels: npt.NDArray[np.uint8]  # (H, W, 3) BGR


def require_av(feature: str, extra: str) -> Any:
    """Return the PyAV module.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        import av
    except ImportError as error:
        raise missing_extra(feature, extra, error) from error
    return av


def count_frames(av: Any, path: Path) -> int | None:
    """Return the number of frames that the file's header claims, None where it claims none.

    Raises:
        TooltipError: the file is no video.
    """
    with _opened(av, path) as (_, stream):
        return int(stream.frames) or None


def decode_frames(
    av: Any, path: Path, report: SourceReport, span_ns: tuple[int, int] | None = None
) -> Iterator[VideoFrame]:
    """Yield the frames of a video in the order in which they are shown.

    Args:
        av: what :func:`require_av` returned.
        report: counts the packets that cannot be decoded.
        span_ns: first and last time wanted, on the video's clock; None: all.

    Raises:
        TooltipError: the file is no video.
    """
    with _opened(av, path) as (container, stream):
        stream.thread_type = "AUTO"
        if span_ns is not None and span_ns[0] > 0:
            # lands on the key frame at or before that time
            container.seek(int(Fraction(span_ns[0], 10**9) / stream.time_base), stream=stream)
        turned = False
        for frame in _decoded(av, container, stream, report):
            time_ns = None if frame.pts is None else round(frame.pts * frame.time_base * 10**9)
            if span_ns is not None and time_ns is not None:
                if time_ns < span_ns[0]:
                    continue
                if time_ns > span_ns[1]:
                    return
            if frame.rotation and not turned:
                turned = True
                report.notes.append(
                    f"{path} asks to be shown turned by {frame.rotation} degrees; its pixels are "
                    "stored as the camera read them, as the intrinsics expect"
                )
            yield VideoFrame(time_ns, frame.to_ndarray(format="bgr24"))


def _decoded(av: Any, container: Any, stream: Any, report: SourceReport) -> Iterator[Any]:
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
        except StopIteration:
            return
        except av.error.FFmpegError as error:
            report.notes.append(f"the video ends early: {one_line(error)}")
            return
        try:
            frames = packet.decode()
        except av.error.FFmpegError:
            report.drop("packets of the video that cannot be decoded")
            continue
        yield from frames


@contextmanager
def _opened(av: Any, path: Path) -> Iterator[tuple[Any, Any]]:
    try:
        container = av.open(str(path), metadata_errors="replace")
    except (OSError, av.error.FFmpegError) as error:
        raise TooltipError(f"{path} cannot be read as a video ({one_line(error)})") from error
    with container:
        if not container.streams.video:
            raise TooltipError(f"{path} holds no video stream")
        yield container, container.streams.video[0]
