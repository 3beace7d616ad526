"""ROS 2 messages as CDR bytes: definitions, encoding and decoding.

The definitions are the files under ``schemas/``; a known type is always decoded with ours, never
with text that came inside a log.
"""

from __future__ import annotations

import functools
import re
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic

from tooltip_cli.errors import TooltipError
from tooltip_cli.resources import resource
from tooltip_cli.rig.camera import CameraModel

COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
IMAGE = "sensor_msgs/msg/Image"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
JOINT_STATE = "sensor_msgs/msg/JointState"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
STRING = "std_msgs/msg/String"
IMAGE_ANNOTATIONS = "foxglove_msgs/msg/ImageAnnotations"
SCENE_UPDATE = "foxglove_msgs/msg/SceneUpdate"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"
TIP_DETECTION = "tooltip_msgs/msg/TipDetection"
MOVING_EDGES = "tooltip_msgs/msg/MovingEdges"
SILHOUETTE = "tooltip_msgs/msg/Silhouette"

_PRIMITIVE = re.compile(r"^(bool|byte|char|w?string|float(32|64)|u?int(8|16|32|64))\b")
_SEPARATOR = "=" * 80


@dataclass(frozen=True, slots=True)
class Message:
    """One message on its way into a log."""

    topic: str
    datatype: str  # ROS 2 type name, e.g. sensor_msgs/msg/JointState
    log_time_ns: int  # when it was received; orders the log, nothing else
    payload: bytes  # CDR with its four-byte encapsulation header
    publish_time_ns: int | None = None  # None: the same as log_time_ns
    qos: str | None = None  # offered_qos_profiles as YAML; None: this program's default


def definition(datatype: str) -> str:
    """Return the text of one message definition.

    Raises:
        KeyError: the type is not among ``schemas/``.
    """
    package, _, name = datatype.partition("/msg/")
    try:
        return resource("schemas", package, "msg", f"{name}.msg").read_text(encoding="utf-8")
    except FileNotFoundError:
        raise KeyError(datatype) from None


@functools.cache
def schema_text(datatype: str) -> str:
    """Return a definition followed by all that it needs, as the ``ros2msg`` encoding wants it.

    Source: MCAP format registry, schema encoding ``ros2msg``.
    """
    texts = [definition(datatype)]
    pending, seen = _dependencies(texts[0]), {datatype}
    while pending:
        name = pending.pop(0)
        if name in seen:
            continue
        seen.add(name)
        text = definition(name)
        short = name.replace("/msg/", "/")
        texts.append(f"{_SEPARATOR}\nMSG: {short}\n{text}")
        pending += _dependencies(text)
    return "".join(texts)


def _dependencies(text: str) -> list[str]:
    names = []
    for line in text.splitlines():
        field = line.partition("#")[0].strip()
        if field and not _PRIMITIVE.match(field):
            package, _, name = field.split()[0].partition("[")[0].partition("/")
            names.append(f"{package}/msg/{name}")
    return names


@functools.cache
def _encoder(datatype: str) -> Callable[[Any], bytes]:
    encoder: Callable[[Any], bytes] = serialize_dynamic(datatype, schema_text(datatype))[datatype]
    return encoder


@functools.cache
def _decoder(datatype: str) -> Callable[[bytes], Any]:
    decoder: Callable[[bytes], Any] = generate_dynamic(datatype, schema_text(datatype))[datatype]
    return decoder


def encode(datatype: str, fields: Mapping[str, Any]) -> bytes:
    """Return the CDR bytes of a message given as (nested) mappings; missing fields are zero."""
    return _encoder(datatype)(fields)


def decode(datatype: str, payload: bytes) -> Any:
    """Return a message as an object with the definition's fields as attributes.

    Raises:
        Exception: whatever the decoder meets in bytes that are not such a message.
    """
    return _decoder(datatype)(payload)


def decode_foreign(datatype: str, payload: bytes, source: str) -> Any:
    """Decode a message that somebody else may have written.

    Raises:
        TooltipError: it is none of that type; ``source`` says where it stands.
    """
    try:
        return decode(datatype, payload)
    except MemoryError:  # says nothing of the message: what it holds is bounded by its size
        raise
    except Exception as error:  # the decoder meets arbitrary bytes
        raise TooltipError(
            f"{source}: a message is not a {datatype} ({error!r}); record it again, or leave the "
            "topic out"
        ) from error


def time_from_ns(stamp_ns: int) -> dict[str, int]:
    """Return a ``builtin_interfaces/Time`` for integer nanoseconds."""
    sec, nanosec = divmod(int(stamp_ns), 1_000_000_000)
    return {"sec": sec, "nanosec": nanosec}


def ns_from_time(time: Any) -> int:
    """Return integer nanoseconds for a decoded ``builtin_interfaces/Time``."""
    return int(time.sec) * 1_000_000_000 + int(time.nanosec)


def header_stamp_ns(payload: bytes) -> int | None:
    """Return the stamp of a message that begins with a std_msgs/Header; None: it is too short."""
    if len(payload) < 12:
        return None
    sec, nanosec = struct.unpack_from("<iI" if payload[1] & 1 else ">iI", payload, 4)
    return int(sec) * 1_000_000_000 + int(nanosec)


def header(stamp_ns: int, frame_id: str = "") -> dict[str, Any]:
    """Return a ``std_msgs/Header``."""
    return {"stamp": time_from_ns(stamp_ns), "frame_id": frame_id}


def compressed_image(stamp_ns: int, frame_id: str, image_format: str, data: bytes) -> bytes:
    """Return a CompressedImage; ``image_format`` is exactly ``jpeg`` or ``png``."""
    return encode(
        COMPRESSED_IMAGE,
        {"header": header(stamp_ns, frame_id), "format": image_format, "data": data},
    )


def joint_state(stamp_ns: int, names: Sequence[str], positions: Sequence[float]) -> bytes:
    """Return a JointState with positions (rad or m) only."""
    return encode(
        JOINT_STATE,
        {
            "header": header(stamp_ns),
            "name": list(names),
            "position": [float(value) for value in positions],
        },
    )


def pose_stamped(
    stamp_ns: int, frame_id: str, position: Sequence[float], quaternion_xyzw: Sequence[float]
) -> bytes:
    """Return a PoseStamped: ``frame_id``_from_hand, metres and a unit quaternion (x, y, z, w)."""
    x, y, z, w = (float(value) for value in quaternion_xyzw)
    return encode(
        POSE_STAMPED,
        {
            "header": header(stamp_ns, frame_id),
            "pose": {
                "position": dict(zip("xyz", map(float, position), strict=True)),
                "orientation": {"x": x, "y": y, "z": z, "w": w},
            },
        },
    )


def string(data: str) -> bytes:
    """Return a ``std_msgs/String``."""
    return encode(STRING, {"data": data})


def camera_info(stamp_ns: int, frame_id: str, camera: CameraModel) -> bytes:
    """Return the CameraInfo of a camera model; P is K without a baseline (a single camera)."""
    k = camera.matrix
    p = np.hstack([k, np.zeros((3, 1))])
    return encode(
        CAMERA_INFO,
        {
            "header": header(stamp_ns, frame_id),
            "height": camera.height,
            "width": camera.width,
            "distortion_model": camera.distortion_model,
            "d": list(camera.distortion),
            "k": k.ravel().tolist(),
            "r": np.eye(3).ravel().tolist(),
            "p": p.ravel().tolist(),
        },
    )


def camera_from_info(message: Any, source: str) -> CameraModel | None:
    """Return the camera model of a decoded CameraInfo, or None where it says "uncalibrated".

    ``k[0] == 0`` means uncalibrated (sensor_msgs/CameraInfo).

    Raises:
        TooltipError: the model is one that this program does not know; ``source`` names it.
    """
    if message.k[0] == 0.0:
        return None
    return CameraModel.create(
        width=int(message.width),
        height=int(message.height),
        matrix=np.asarray(message.k, dtype=float).reshape(3, 3),
        distortion_model=str(message.distortion_model),
        distortion=[float(value) for value in message.d],
        source=source,
    )
