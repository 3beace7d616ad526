"""What the sources share: topic names, stamps, and the messages of our own recordings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tooltip_cli.errors import MissingExtraError, TooltipError
from tooltip_cli.log import messages
from tooltip_cli.log.messages import Message
from tooltip_cli.rig.camera import CameraModel
from tooltip_cli.rig.rigfile import Rig

IMAGE_TOPIC = "/camera/image/compressed"
INFO_TOPIC = "/camera/camera_info"
JOINT_TOPIC = "/joint_states"
POSE_TOPIC = "/hand_pose"
ROBOT_TOPIC = "/robot_description"

EPOCH_NS = 1_600_000_000 * 10**9
"""Stamp of time zero for sources that count from zero; in ROS the stamp 0 means "not set"."""

JPEG_QUALITY = 95
"""For frames of a video, which have no JPEG of their own: nearly free of visible blocks."""

_END_OF_TIME_NS = 2**31 * 10**9  # builtin_interfaces/Time holds seconds as int32
_MAX_URDF_BYTES = 32 * 2**20


def check_stamp(stamp_ns: int, source: str) -> int:
    """Return a stamp that a ROS 2 header can hold.

    Raises:
        TooltipError: it is negative or beyond the year 2038; ``source`` begins the message.
    """
    if not 0 <= stamp_ns < _END_OF_TIME_NS:
        raise TooltipError(
            f"{source}: the stamp {stamp_ns} ns lies outside the times that ROS can hold, 0 to "
            f"{_END_OF_TIME_NS} ns; check its unit"
        )
    return stamp_ns


def image_kind(data: bytes) -> str | None:
    """Return ``jpeg`` or ``png`` by the data's first bytes, None for anything else."""
    if data[:3] == b"\xff\xd8\xff":
        return "jpeg"
    return "png" if data[:8] == b"\x89PNG\r\n\x1a\n" else None


def storable_image(data: bytes) -> tuple[str, bytes] | None:
    """Return (format, data) of an encoded image: JPEG and PNG untouched, others as PNG.

    Returns:
        None where OpenCV cannot decode it.
    """
    kind = image_kind(data)
    if kind is not None:
        return kind, data
    import cv2

    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) if data else None
    if pixels is None:
        return None
    return "png", cv2.imencode(".png", pixels)[1].tobytes()


def encode_jpeg(pixels: npt.NDArray[np.uint8]) -> bytes:
    """Return (H, W, 3) BGR uint8 pixels as JPEG."""
    import cv2

    done, data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise TooltipError(f"a frame of {pixels.shape[1]}x{pixels.shape[0]} is too large for JPEG")
    return bytes(data.tobytes())


def image_messages(
    stamp_ns: int, frame_id: str, image_format: str, data: bytes, camera: CameraModel | None
) -> Iterator[Message]:
    """Yield one image, before it its CameraInfo where the intrinsics are known."""
    if camera is not None:
        info = messages.camera_info(stamp_ns, frame_id, camera)
        yield Message(INFO_TOPIC, messages.CAMERA_INFO, stamp_ns, info)
    payload = messages.compressed_image(stamp_ns, frame_id, image_format, data)
    yield Message(IMAGE_TOPIC, messages.COMPRESSED_IMAGE, stamp_ns, payload)


def joint_message(stamp_ns: int, names: Sequence[str], positions: Sequence[float]) -> Message:
    """Return one JointState, rad or m."""
    payload = messages.joint_state(stamp_ns, names, positions)
    return Message(JOINT_TOPIC, messages.JOINT_STATE, stamp_ns, payload)


def robot_message(stamp_ns: int, urdf: str) -> Message:
    """Return the robot description."""
    return Message(ROBOT_TOPIC, messages.STRING, stamp_ns, messages.string(urdf))


def read_urdf(path: Path) -> str:
    """Return the text of a URDF file.

    Raises:
        TooltipError: it cannot be read, or is no robot description.
    """
    try:
        if path.stat().st_size > _MAX_URDF_BYTES:
            raise TooltipError(f"{path}: too large for a URDF")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not UTF-8 text"
        raise TooltipError(f"{path}: cannot be read ({reason})") from error
    if "<robot" not in text:
        raise TooltipError(f"{path} is no URDF: it has no <robot> element")
    return text


def with_robot(rig: Rig | None, urdf: str | None) -> Rig | None:
    """Return the rig with another robot description, where one is given."""
    return replace(rig, urdf=urdf) if rig is not None and urdf is not None else rig


def missing_extra(feature: str, extra: str, error: ImportError) -> MissingExtraError:
    """Return the error that names the package that an import did not find."""
    return MissingExtraError(feature, extra, str(error.name).partition(".")[0])


def plural(count: int, noun: str) -> str:
    """Return e.g. ``1 frame`` or ``2 frames``."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def one_line(error: BaseException) -> str:
    """Return what an exception says on one line; its kind where it says nothing."""
    text: Any = getattr(error, "strerror", None) or str(error)
    return " ".join(str(text).split()) or type(error).__name__
