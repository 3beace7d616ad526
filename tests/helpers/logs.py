"""Small recordings of the wrist, made message by message so that tests can spoil them."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from tests.helpers.robot import CAMERA, CAMERA_FRAME, JOINTS, RIG, URDF, WRIST, tip_in_camera
from tooltip_cli.labels.files import TipLabels, write_labels
from tooltip_cli.log import messages
from tooltip_cli.log.messages import Message
from tooltip_cli.log.writer import LogWriter
from tooltip_cli.rig.camera import CameraModel
from tooltip_cli.rig.rigfile import Rig, rig_files

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]
Parts = dict[str, list[Message]]

IMAGE_TOPIC = "/camera/image/compressed"
INFO_TOPIC = "/camera/camera_info"
JOINT_TOPIC = "/joint_states"
POSE_TOPIC = "/hand_pose"
ROBOT_TOPIC = "/robot_description"
START_NS = 1_700_000_000_123_456_789
FRAME_NS = 33_333_333
JOINT_NS = 10_000_000
FRAMES = 40


def stamp_of(frame: int) -> int:
    """Return the stamp of an image."""
    return START_NS + 50_000_000 + frame * FRAME_NS


def angles(stamp_ns: int) -> tuple[float, float]:
    """Return pitch and roll at a time, radians: smooth and about two axes."""
    t = (stamp_ns - START_NS) / 1e9
    return 0.4 * np.sin(2 * np.pi * 0.9 * t), 0.4 * np.sin(2 * np.pi * 0.7 * t + 1.0)


@functools.cache
def true_pixels(frames: int = FRAMES) -> Array:
    """Return (frames, 2) where the tip is in each image."""
    tips = [tip_in_camera(*angles(stamp_of(frame))) for frame in range(frames)]
    return CAMERA.project(np.array(tips))


@functools.cache
def _background() -> Image:
    noise = np.random.default_rng(5).uniform(0, 255, (CAMERA.height, CAMERA.width))
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.5)
    return np.asarray(cv2.normalize(smooth, None, 60, 220, cv2.NORM_MINMAX), dtype=np.uint8)


@functools.cache
def image_of(frame: int) -> Image:
    """Return the (H, W) gray image: a dark stick from the wrist to the tip before clutter."""
    image: Image = _background().copy()
    ends = [CAMERA.project(WRIST), true_pixels(frame + 1)[frame]]
    (u1, v1), (u2, v2) = (np.round(np.array(end) * 16).astype(int).tolist() for end in ends)
    cv2.line(image, (u1, v1), (u2, v2), 15, 5, cv2.LINE_AA, 4)
    return image


@functools.cache
def jpeg_of(frame: int) -> bytes:
    """Return the image as JPEG."""
    return encoded(image_of(frame), ".jpg")


def logged_image(frame: int) -> Image:
    """Return the (H, W) gray image as JPEG has kept it."""
    return decoded(jpeg_of(frame))


def decoded(data: bytes, mode: int = cv2.IMREAD_GRAYSCALE) -> Image:
    """Return the image in a file."""
    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), mode), dtype=np.uint8)


def encoded(image: Image, suffix: str) -> bytes:
    """Return an image as a file of this kind."""
    done, data = cv2.imencode(suffix, image)
    assert done
    return bytes(data.tobytes())


def image_message(
    stamp_ns: int, data: bytes, topic: str = IMAGE_TOPIC, image_format: str = "jpeg"
) -> Message:
    """Return a CompressedImage on its way into a log."""
    payload = messages.compressed_image(stamp_ns, CAMERA_FRAME, image_format, data)
    return Message(topic, messages.COMPRESSED_IMAGE, stamp_ns, payload)


def joint_message(
    stamp_ns: int, names: Iterable[str], positions: Iterable[float], topic: str = JOINT_TOPIC
) -> Message:
    """Return a JointState on its way into a log."""
    payload = messages.joint_state(stamp_ns, list(names), list(positions))
    return Message(topic, messages.JOINT_STATE, stamp_ns, payload)


def info_message(
    camera: CameraModel = CAMERA, topic: str = INFO_TOPIC, stamp_ns: int = START_NS
) -> Message:
    """Return a CameraInfo on its way into a log."""
    payload = messages.camera_info(stamp_ns, CAMERA_FRAME, camera)
    return Message(topic, messages.CAMERA_INFO, stamp_ns, payload)


def robot_message(urdf: str = URDF, topic: str = ROBOT_TOPIC) -> Message:
    """Return a robot description on its way into a log."""
    return Message(topic, messages.STRING, START_NS, messages.string(urdf))


def wrist_parts(frames: int = FRAMES) -> Parts:
    """Return the messages of a recording by role: images, info, joints, robot."""
    last = stamp_of(frames) + 50_000_000
    return {
        "images": [image_message(stamp_of(i), jpeg_of(i)) for i in range(frames)],
        "info": [info_message()],
        "joints": [
            joint_message(stamp, (JOINTS[1], "grip", JOINTS[0]), _shuffled(stamp))
            for stamp in range(START_NS, last, JOINT_NS)
        ],
        "robot": [robot_message()],
    }


def _shuffled(stamp_ns: int) -> tuple[float, float, float]:
    pitch, roll = angles(stamp_ns)
    return roll, 0.01, pitch


@dataclass(frozen=True)
class Log:
    """A recording on disk."""

    path: Path
    frames: int

    @property
    def labels(self) -> Path:
        """The label file that belongs to it."""
        return self.path.with_name(f"{self.path.stem}.labels.csv")


def write_log(
    path: Path,
    parts: Parts | Iterable[Message],
    attachments: Mapping[str, bytes] | None = None,
    rig: Rig | None = RIG,
) -> Path:
    """Write messages in the order of their log time, and a rig beside them."""
    chosen = (
        [item for part in parts.values() for item in part] if isinstance(parts, dict) else (parts)
    )
    path.parent.mkdir(exist_ok=True)
    with LogWriter(path) as writer:
        for message in sorted(chosen, key=lambda message: message.log_time_ns):
            writer.write(message)
        for name, text in (rig_files(rig) if rig is not None else {}).items():
            writer.attach(name, "text/plain", text.encode())
        for name, data in (attachments or {}).items():
            writer.attach(name, "application/octet-stream", data)
    return path


def write_true_labels(path: Path, frames: Iterable[int]) -> Path:
    """Write the true pixels of some frames as visible labels."""
    chosen = list(frames)
    pixels = true_pixels(max(chosen, default=0) + 1)[chosen]
    stamps = np.array([stamp_of(frame) for frame in chosen], dtype=np.int64)
    states, names = ("visible",) * len(chosen), ("me",) * len(chosen)
    write_labels(path, TipLabels(stamps, pixels.reshape(-1, 2), states, names))
    return path
