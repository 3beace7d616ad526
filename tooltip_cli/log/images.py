"""Pixels from image messages."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import numpy.typing as npt

from tooltip_cli.errors import TooltipError, one_of
from tooltip_cli.log.messages import IMAGE

Image = npt.NDArray[np.uint8]

_MAX_PIXELS = 1 << 25  # 7680x4320 and a little more: decoding takes up to 9 bytes for each
_HEADER_BYTES = 1 << 20  # in which the size of a JPEG stands, behind thumbnails and profiles


def decode_compressed(message: Any, gray: bool, source: str) -> Image:
    """Decode a CompressedImage message to (H, W, 3) BGR or (H, W) gray.

    Args:
        source: what to call it in messages.

    Raises:
        TooltipError: not an image, or one too large.
    """
    import cv2

    size = declared_size(bytes(message.data[:_HEADER_BYTES]))
    if size is not None and size[0] * size[1] > _MAX_PIXELS:
        raise TooltipError(
            f"{source} claims {size[0]}x{size[1]} pixels, more than are read; it is damaged, or "
            "needs a smaller resolution"
        )
    data = np.frombuffer(message.data, dtype=np.uint8)
    mode = cv2.IMREAD_GRAYSCALE if gray else cv2.IMREAD_COLOR
    try:
        # the log's word on orientation is the pixels' own; EXIF would turn the intrinsics
        image = cv2.imdecode(data, mode | cv2.IMREAD_IGNORE_ORIENTATION) if len(data) else None
    except cv2.error:  # raised for sizes beyond OpenCV's limit
        image = None
    if image is None:
        kind = message.format or "no format"
        raise TooltipError(
            f"{source} ({kind}) cannot be decoded; it is damaged, so record it again"
        )
    return np.asarray(image, dtype=np.uint8)


def declared_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height by the head of a JPEG or PNG file; None where it does not say.

    Source: ITU-T T.81, annex B (frame headers SOF0 to SOF15); PNG specification, IHDR.
    """
    if data.startswith(b"\x89PNG\r\n\x1a\n") and len(data) >= 24:
        width, height = struct.unpack_from(">II", data, 16)
        return width, height
    place = 2 if data.startswith(b"\xff\xd8") else len(data)
    while place + 9 <= len(data):
        if data[place] != 0xFF:
            return None
        marker = data[place + 1]
        if marker == 0xFF:  # padding
            place += 1
        elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", data, place + 5)
            return width, height
        elif marker == 0x01 or 0xD0 <= marker <= 0xD9:  # stand alone
            place += 2
        else:
            place += 2 + int.from_bytes(data[place + 2 : place + 4], "big")
    return None


_VIEWABLE = {b"\xff\xd8\xff": "image/jpeg", b"\x89PNG\r\n\x1a\n": "image/png"}


def viewable(message: Any, datatype: str, source: str) -> tuple[bytes, str]:
    """Return an image message as a file that browsers show, and its media type.

    JPEG and PNG pass byte for byte, whatever the message calls its format; anything else becomes
    a PNG.

    Raises:
        TooltipError: it cannot be decoded.
    """
    if datatype != IMAGE:
        data = bytes(message.data)
        for magic, media_type in _VIEWABLE.items():
            if data.startswith(magic):
                return data, media_type
        image = decode_compressed(message, False, source)
    else:
        image = decode_raw(message, False, source)
    import cv2

    return bytes(cv2.imencode(".png", image)[1]), "image/png"


_RAW: dict[str, tuple[int, str | None, str | None]] = {
    # encoding: channels, cv2 conversion to BGR, to gray (sensor_msgs/image_encodings)
    "mono8": (1, "COLOR_GRAY2BGR", None),
    "8UC1": (1, "COLOR_GRAY2BGR", None),
    "bgr8": (3, None, "COLOR_BGR2GRAY"),
    "8UC3": (3, None, "COLOR_BGR2GRAY"),
    "rgb8": (3, "COLOR_RGB2BGR", "COLOR_RGB2GRAY"),
    "bgra8": (4, "COLOR_BGRA2BGR", "COLOR_BGRA2GRAY"),
    "rgba8": (4, "COLOR_RGBA2BGR", "COLOR_RGBA2GRAY"),
    # OpenCV names a Bayer pattern by its second row, ROS by its first
    "bayer_rggb8": (1, "COLOR_BayerBG2BGR", "COLOR_BayerBG2GRAY"),
    "bayer_bggr8": (1, "COLOR_BayerRG2BGR", "COLOR_BayerRG2GRAY"),
    "bayer_gbrg8": (1, "COLOR_BayerGR2BGR", "COLOR_BayerGR2GRAY"),
    "bayer_grbg8": (1, "COLOR_BayerGB2BGR", "COLOR_BayerGB2GRAY"),
}


def decode_raw(message: Any, gray: bool, source: str) -> Image:
    """Decode an Image message to (H, W, 3) BGR or (H, W) gray.

    Args:
        source: what to call it in messages.

    Raises:
        TooltipError: an encoding that is not read, or a size that does not fit the data.
    """
    import cv2

    encoding = str(message.encoding)
    if encoding not in _RAW:
        raise TooltipError(f"{source}: " + one_of("image encoding", encoding, _RAW))
    channels, to_bgr, to_gray = _RAW[encoding]
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.frombuffer(message.data, dtype=np.uint8)
    size_known = 0 < width * channels <= step and height > 0 and width * height <= _MAX_PIXELS
    if not size_known or len(data) < height * step:
        raise TooltipError(
            f"{source}: {width}x{height} {encoding} with rows of {step} bytes does not fit its "
            f"{len(data)} bytes"
        )
    rows = data[: height * step].reshape(height, step)[:, : width * channels]
    pixels = rows.reshape(height, width, channels) if channels > 1 else rows
    conversion = to_gray if gray else to_bgr
    if conversion is None:
        return np.ascontiguousarray(pixels)
    code = getattr(cv2, conversion)
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), code), dtype=np.uint8)
