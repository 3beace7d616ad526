"""The hand's pose at each image while messages arrive."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from tooltip_cli.errors import TooltipError
from tooltip_cli.log import messages
from tooltip_cli.log.messages import Message, decode, header_stamp_ns, ns_from_time
from tooltip_cli.log.recording import IMAGE_TYPES
from tooltip_cli.log.sync import interpolate, interpolate_poses
from tooltip_cli.log.views import MAX_GAP_NS, Stamps
from tooltip_cli.method.types import Array
from tooltip_cli.rig.camera import CameraModel
from tooltip_cli.rig.kinematics import KinematicChain, inverse_transform, rotation_from_quaternion
from tooltip_cli.rig.rigfile import Rig

_SAMPLES = 4000  # of joints that are remembered: eight seconds at 500 Hz
_PENDING = 120  # images that wait for the joints after them


@dataclass(frozen=True)
class PosedImage:
    """An image and where the hand was."""

    stamp_ns: int  # of its header
    camera_from_hand: Array  # (4, 4); NaN where it is unknown
    root_from_camera: Array  # (3, 3) how the camera is turned, as views have it
    message: Message | None  # None: images are not kept


class PoseFollower:
    """Reads along what arrives and gives the hand's pose at every image.

    Intrinsics and robot description are the rig's, or come with the messages.

    Args:
        rig: which frames are hand and camera.
        keep_images: hand the images' messages on with their poses.
    """

    def __init__(self, rig: Rig, *, keep_images: bool = False) -> None:
        self._rig, self._keep = rig, keep_images
        self.camera: CameraModel | None = rig.camera
        self._urdf = rig.urdf
        self._image_frame: str | None = None
        self._chain: KinematicChain | None = None
        self.ready = False
        self._stamps: list[int] = []
        self._samples: list[tuple[float, ...]] = []  # joints, or a pose
        self._images: deque[tuple[int, Message | None]] = deque(maxlen=_PENDING)
        self._other_joints: tuple[str, ...] = ()
        self._last_image_ns: int | None = None  # on the joints' clock
        self._met = False  # whether an image's pose was ever known

    @property
    def missing(self) -> str:
        """What has not been heard that poses need; empty where they are known."""
        if self.camera is None:
            return "no intrinsics, neither in the rig nor as CameraInfo"
        if not self.ready:
            return "no robot description or no image was heard"
        if self._met or (self._stamps and self._last_image_ns is None):
            return ""
        if self._stamps and self._last_image_ns is not None:
            apart_s = (self._last_image_ns - self._stamps[-1]) / 1e9
            return (
                f"the latest image is stamped {apart_s:+.1f} s off the latest joints or pose, and "
                "none lies between two of these; check the clocks, or set time_offset in the rig"
            )
        if self._rig.pose_topic is not None:
            return f"no hand pose on {self._rig.pose_topic}"
        if self._other_joints:
            assert self._chain is not None  # noqa: S101 - joints are read by the chain
            lacking = [name for name in self._chain.joint_names if name not in self._other_joints]
            return (
                f"the joint states lack {', '.join(lacking)}; heard: "
                f"{', '.join(self._other_joints)}; map other names under 'joints' in the rig file"
            )
        return "no joint states were heard"

    def take(self, message: Message) -> None:
        """Read along.

        Raises:
            TooltipError: rig and messages do not fit together.
            Exception: whatever the decoder meets in arbitrary bytes.
        """
        if message.datatype in IMAGE_TYPES:
            self._take_image(message)
        elif message.datatype == messages.JOINT_STATE and self._chain is not None:
            self._take_joints(self._chain, decode(message.datatype, message.payload))
        elif message.topic == self._rig.pose_topic:
            self._take_pose(decode(message.datatype, message.payload))
        elif message.datatype == messages.CAMERA_INFO and self.camera is None:
            info = decode(message.datatype, message.payload)
            self.camera = messages.camera_from_info(info, message.topic)
        elif message.datatype == messages.STRING and self._urdf is None:
            self._urdf = str(decode(message.datatype, message.payload).data)
        if not self.ready:
            self._prepare()

    def passed(self, *, at_end: bool = False) -> list[PosedImage]:
        """Return the images that lie before the latest joints, in the order of their stamps.

        Args:
            at_end: return all that wait, for no joints will come.
        """
        if not self.ready:
            return []
        last = self._stamps[-1] if self._stamps else None
        shift = round(self._rig.time_offset_s * 1e9)
        images: list[tuple[int, Message | None]] = []
        while self._images and (
            at_end or (last is not None and self._images[0][0] + shift <= last)
        ):
            images.append(self._images.popleft())
        if not images:
            return []
        images.sort(key=lambda image: image[0])
        query = np.array([stamp_ns + shift for stamp_ns, _ in images], dtype=np.int64)
        poses, turns = self._poses(query)
        self._met |= bool(np.isfinite(poses).all(axis=(1, 2)).any())
        return [
            PosedImage(stamp_ns, pose, turned, message)
            for (stamp_ns, message), pose, turned in zip(images, poses, turns, strict=True)
        ]

    def _take_image(self, message: Message) -> None:
        stamp_ns = header_stamp_ns(message.payload)
        if stamp_ns is not None:
            self._last_image_ns = stamp_ns + round(self._rig.time_offset_s * 1e9)
            self._images.append((stamp_ns, message if self._keep else None))
        if self._image_frame is None and self._rig.camera_frame is None:
            self._image_frame = str(decode(message.datatype, message.payload).header.frame_id)

    def _prepare(self) -> None:
        """Begin once everything is known that poses need."""
        rig = self._rig
        if self.camera is None:
            return
        if rig.pose_topic is None:
            frame = rig.camera_frame or self._image_frame
            if self._urdf is None or frame is None:
                return
            self._chain = KinematicChain.from_urdf(
                self._urdf, frame, rig.hand_frame, rig.mount, rig.source
            )
        elif rig.mount is None:
            raise TooltipError(f"{rig.source}: with hand.pose_topic the camera needs camera.mount")
        self.ready = True

    def _take_joints(self, chain: KinematicChain, state: Any) -> None:
        names = (self._rig.joints.get(name, name) for name in state.name)
        positions = dict(zip(names, state.position, strict=False))
        if all(name in positions for name in chain.joint_names):
            self._add(state, tuple(float(positions[name]) for name in chain.joint_names))
        else:
            self._other_joints = tuple(positions)

    def _take_pose(self, message: Any) -> None:
        place, turn = message.pose.position, message.pose.orientation
        self._add(message, (place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w))

    def _add(self, message: Any, sample: tuple[float, ...]) -> None:
        stamp_ns = ns_from_time(message.header.stamp)
        if self._stamps and stamp_ns <= self._stamps[-1]:
            return
        self._stamps.append(stamp_ns)
        self._samples.append(sample)
        if len(self._stamps) > 2 * _SAMPLES:
            del self._stamps[:-_SAMPLES], self._samples[:-_SAMPLES]

    def _poses(self, query_ns: Stamps) -> tuple[Array, Array]:
        """Return (N, 4, 4) camera_from_hand and (N, 3, 3) root_from_camera at ascending times."""
        first = max(bisect_left(self._stamps, int(query_ns[0])) - 1, 0)
        last = bisect_left(self._stamps, int(query_ns[-1])) + 1
        if first >= len(self._stamps):
            unknown = np.full((len(query_ns), 4, 4), np.nan)
            return unknown, unknown[:, :3, :3]
        stamps = np.array(self._stamps[first:last], dtype=np.int64)
        samples = np.array(self._samples[first:last])
        if self._chain is not None:
            joints = [interpolate(stamps, track, query_ns, MAX_GAP_NS) for track in samples.T]
            hand, root = self._chain.camera_poses(np.stack(joints, axis=1))
            return inverse_transform(hand), root[:, :3, :3]
        mount = self._rig.mount
        assert mount is not None  # noqa: S101 - seen to by _prepare
        positions, quaternions = interpolate_poses(
            stamps, samples[:, :3], samples[:, 3:], query_ns, MAX_GAP_NS
        )
        base_from_hand = np.tile(np.eye(4), (len(query_ns), 1, 1))
        base_from_hand[:, :3, :3] = rotation_from_quaternion(quaternions)
        base_from_hand[:, :3, 3] = positions
        still = np.tile(np.eye(3), (len(query_ns), 1, 1))
        return np.asarray(inverse_transform(mount.parent_from_camera) @ base_from_hand), still
