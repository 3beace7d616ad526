"""Images as a camera sends them: HTTP-MJPEG as received, everything else through OpenCV."""

from __future__ import annotations

import base64
import http.client
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from tooltip_cli.errors import TooltipError
from tooltip_cli.sources.live import ArrivalClock
from tooltip_cli.sources.streams import encode_jpeg, image_kind, one_line

_TIMEOUT_S = 5.0
_MAX_IMAGE_BYTES = 1 << 25
_MAX_LINE = 1 << 16
_END_OF_IMAGE = b"\xff\xd9"  # of JPEG
_LOST_READS = 50  # in a row without a frame
_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
_AT_ONCE = "fflags;nobuffer|flags;low_delay"

Frame = tuple[int, str, bytes]  # arrival, nanoseconds; jpeg or png; data


def camera_frames(spec: str, clock: ArrivalClock, halt: threading.Event) -> Iterator[Frame]:
    """Yield images as they arrive, until ``halt`` is set or the stream ends.

    Args:
        spec: the number of a USB camera, an address (http, https, rtsp, udp, ...) or a video file,
            which plays at its own pace.

    Raises:
        TooltipError: it cannot be opened, or was lost.
    """
    if spec.startswith(("http://", "https://")):
        response = _request(spec)
        with response:
            boundary = _boundary(response)
            if boundary is not None:
                yield from _parts(response, boundary, spec, clock, halt)
                return
    yield from _captured(spec, clock, halt)


def _request(url: str) -> http.client.HTTPResponse:
    try:
        parts = urlsplit(url)
        kind = (
            http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
        )
        connection = kind(parts.hostname or "", parts.port, timeout=_TIMEOUT_S)
        headers = {}
        if parts.username is not None:
            user = f"{unquote(parts.username)}:{unquote(parts.password or '')}"
            headers["Authorization"] = "Basic " + base64.b64encode(user.encode()).decode()
        path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
        connection.request("GET", path, headers=headers)
        response = connection.getresponse()
    except (OSError, ValueError, http.client.HTTPException) as error:
        raise TooltipError(f"{_plain(url)}: cannot be reached ({one_line(error)})") from error
    if response.status != http.client.OK:
        raise TooltipError(f"{_plain(url)}: answers {response.status} {response.reason}")
    return response


def _plain(url: str) -> str:
    """Return an address without the password that it may hold."""
    head, _, tail = url.partition("://")
    host, slash, path = tail.partition("/")
    return f"{head}://{host.rpartition('@')[2]}{slash}{path}"


def _boundary(response: http.client.HTTPResponse) -> bytes | None:
    """Return what separates the images; None: it is no multipart stream."""
    if response.headers.get_content_maintype() != "multipart":
        return None
    boundary = response.headers.get_boundary()
    # some servers repeat the dashes here, others do not
    return b"--" + boundary.strip('"').removeprefix("--").encode() if boundary else b"--"


def _parts(
    response: http.client.HTTPResponse,
    boundary: bytes,
    url: str,
    clock: ArrivalClock,
    halt: threading.Event,
) -> Iterator[Frame]:
    """Yield the JPEG parts of a multipart/x-mixed-replace stream byte for byte (RFC 2046, 5.1)."""
    try:
        line = b""
        while not halt.is_set():
            while not line.startswith(boundary):
                line = response.readline(_MAX_LINE)
                if not line:
                    return
            length = _content_length(response)
            # the head comes with its image, while some servers send a boundary behind the last one
            arrival_ns = clock.now_ns()
            if length is None:
                data, line = _until(response, boundary)
                if not line and not data.endswith(_END_OF_IMAGE):
                    return  # cut short
            else:
                data, line = response.read(length), b""
                if len(data) < length:
                    return
            kind = image_kind(data)
            if kind is None:
                raise TooltipError(f"{_plain(url)}: sends something else than JPEG images")
            yield arrival_ns, kind, data
    except (OSError, http.client.HTTPException) as error:
        raise TooltipError(f"{_plain(url)}: was lost ({one_line(error)})") from error
    except ValueError as error:
        raise TooltipError(f"{_plain(url)}: is no stream of images ({error})") from error


def _content_length(response: http.client.HTTPResponse) -> int | None:
    """Read the head of a part and return the length that it names.

    Raises:
        ValueError: it names none that an image can have.
    """
    length: int | None = None
    while (line := response.readline(_MAX_LINE)).strip():
        name, _, value = line.partition(b":")
        if name.strip().lower() == b"content-length":
            length = int(value)
            if not 0 < length <= _MAX_IMAGE_BYTES:
                raise ValueError(f"an image of {length} bytes")
    return length


def _until(response: http.client.HTTPResponse, boundary: bytes) -> tuple[bytes, bytes]:
    """Return what comes before the next boundary, and the boundary's line; empty at the end."""
    lines: list[bytes] = []
    size = 0
    while line := response.readline(_MAX_LINE):
        if line.startswith(boundary):
            break
        lines.append(line)
        size += len(line)
        if size > _MAX_IMAGE_BYTES:
            raise ValueError(f"an image of more than {_MAX_IMAGE_BYTES} bytes")
    data = b"".join(lines)
    # the line break before a boundary belongs to it
    return data.removesuffix(b"\n").removesuffix(b"\r"), line


def _captured(spec: str, clock: ArrivalClock, halt: threading.Event) -> Iterator[Frame]:
    """Yield the frames that OpenCV decodes, each encoded as JPEG once."""
    import cv2

    capture = _open(cv2, spec)
    try:
        paced = Path(spec).is_file()
        period_s = 1 / (capture.get(cv2.CAP_PROP_FPS) or 30.0)
        start = time.monotonic()
        shown = missed = 0
        while not halt.is_set():
            done, pixels = capture.read()
            arrival_ns = clock.now_ns()
            if not done or pixels is None:
                if paced:
                    return
                missed += 1
                if missed == _LOST_READS:
                    raise TooltipError(f"{_plain(spec)}: was lost (no more frames)")
                halt.wait(0.02)
                continue
            missed = 0
            yield arrival_ns, "jpeg", encode_jpeg(pixels)
            shown += 1
            if paced:
                halt.wait(max(start + shown * period_s - time.monotonic(), 0))
    finally:
        capture.release()


def _open(cv2: Any, spec: str) -> Any:
    # else what came during the first look at a stream is delivered late; the user's own wins
    os.environ.setdefault(_OPTIONS, _AT_ONCE)
    if spec.isdecimal():
        capture = cv2.VideoCapture(int(spec))
    else:
        limits = [
            cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
            int(2000 * _TIMEOUT_S),
            cv2.CAP_PROP_READ_TIMEOUT_MSEC,
            int(1000 * _TIMEOUT_S),
        ]
        local = spec.startswith("/dev/")
        capture = (
            cv2.VideoCapture(spec) if local else cv2.VideoCapture(spec, cv2.CAP_FFMPEG, limits)
        )
    if not capture.isOpened():
        raise TooltipError(
            f"{_plain(spec) if '://' in spec else spec}: no camera, stream or video that can be "
            "opened; expected a camera's number, an address such as http://, rtsp:// or udp://, or "
            "a video file"
        )
    return capture
