"""Pixels from image messages."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
import numpy.typing as npt

from tooltip_cli.errors import TooltipError, one_of
from tooltip_cli.log.imagefiles import declared_size
from tooltip_cli.log.messages import IMAGE

Image = npt.NDArray[np.uint8]

_MAX_PIXELS = 1 << 25  # 7680x4320 and a little more: decoding takes up to 9 bytes for each


def decode_compressed(message: Any, gray: bool, source: str) -> Image:
    """Decode a CompressedImage message to (H, W, 3) BGR or (H, W) gray.

    Args:
        source: what to call it in messages.

    Raises:
        TooltipError: neither JPEG nor PNG, damaged, or too large.
    """
    import cv2

    data = memoryview(message.data)
    size = declared_size(data)
    if size is not None and size[0] * size[1] > _MAX_PIXELS:
        raise TooltipError(
            f"{source} claims {size[0]}x{size[1]} pixels, more than are read; it is damaged, or "
            "needs a smaller resolution"
        )
    mode = cv2.IMREAD_GRAYSCALE if gray else cv2.IMREAD_COLOR
    image = None
    if size is not None:
        # the log's word on orientation is the pixels' own; EXIF would turn the intrinsics
        mode |= cv2.IMREAD_IGNORE_ORIENTATION
        with contextlib.suppress(cv2.error):
            image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), mode)
    if image is None:
        kind = message.format or "no format"
        raise TooltipError(
            f"{source} ({kind}) cannot be decoded; it is damaged, so record it again"
        )
    return np.asarray(image, dtype=np.uint8)


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
