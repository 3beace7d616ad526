"""The hand's pose at each image while messages arrive, for the live verdict on the motion."""

from __future__ import annotations

import logging
import time
from collections import deque
from typing import Any

import numpy as np

from tooltip_cli.errors import TooltipError
from tooltip_cli.log import messages
from tooltip_cli.log.messages import Message, decode, header_stamp_ns, ns_from_time
from tooltip_cli.log.recording import IMAGE_TYPES
from tooltip_cli.log.sync import interpolate, interpolate_poses
from tooltip_cli.log.views import MAX_GAP_NS, Stamps
from tooltip_cli.method.types import Array
from tooltip_cli.method.voting.params import VotingSettings
from tooltip_cli.method.voting.watching import MotionWatch, Verdict
from tooltip_cli.rig.camera import CameraModel
from tooltip_cli.rig.kinematics import KinematicChain, inverse_transform, rotation_from_quaternion
from tooltip_cli.rig.rigfile import Rig

_LOG = logging.getLogger(__name__)
_JUDGE_EVERY_S = 1.0
_SAMPLES = 4000  # of joints that are remembered: eight seconds at 500 Hz
_PENDING = 120  # images that wait for the joints after them


class MotionObserver:
    """Reads along what is recorded and judges the motion.

    Intrinsics and robot description are the rig's, or come with the messages.

    Args:
        rig: which frames are hand and camera.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._camera: CameraModel | None = rig.camera
        self._urdf = rig.urdf
        self._image_frame: str | None = None
        self._chain: KinematicChain | None = None
        self._watch: MotionWatch | None = None
        self._stamps: deque[int] = deque(maxlen=_SAMPLES)
        self._samples: deque[tuple[float, ...]] = deque(maxlen=_SAMPLES)  # joints, or a pose
        self._images: deque[int] = deque(maxlen=_PENDING)
        self._verdict: Verdict | None = None
        self._judged = 0.0
        self._problem = ""

    def take(self, message: Message) -> None:
        """Read along; what cannot be used is left to later commands to complain about."""
        if self._problem:
            return
        try:
            self._take(message)
        except TooltipError as error:
            self._problem = str(error)
        except Exception as error:  # the decoder meets arbitrary bytes
            self._problem = f"{message.topic} carries no {message.datatype} ({error!r})"

    @property
    def ample(self) -> bool:
        """Whether more motion would not be looked at."""
        return self._watch is not None and self._watch.ample

    @property
    def problem(self) -> str:
        """Why the motion is not judged; empty where it is."""
        if self._problem or self._watch is not None:
            return self._problem
        if self._camera is None:
            return "no intrinsics, neither in the rig nor as CameraInfo"
        return "no robot description or no image was heard"

    def verdict(self, *, now: bool = False) -> Verdict | None:
        """Return the verdict, a second old at most; None: nothing can be said yet."""
        if self._watch is None or self._problem:
            return self._verdict
        try:
            self._pass_images(self._watch)
            if now or time.monotonic() - self._judged > _JUDGE_EVERY_S:
                self._verdict = self._watch.judge()
                self._judged = time.monotonic()
        except Exception as error:  # whatever numbers came: the recording goes on without a verdict
            _LOG.warning("the motion is not judged any more", exc_info=True)
            self._problem = repr(error)
        return self._verdict

    def _take(self, message: Message) -> None:
        if message.datatype in IMAGE_TYPES:
            stamp_ns = header_stamp_ns(message.payload)
            if stamp_ns is not None:
                self._images.append(stamp_ns + round(self._rig.time_offset_s * 1e9))
            if self._image_frame is None and self._rig.camera_frame is None:
                self._image_frame = str(decode(message.datatype, message.payload).header.frame_id)
        elif message.datatype == messages.JOINT_STATE and self._chain is not None:
            self._take_joints(self._chain, decode(message.datatype, message.payload))
        elif message.topic == self._rig.pose_topic:
            self._take_pose(decode(message.datatype, message.payload))
        elif message.datatype == messages.CAMERA_INFO and self._camera is None:
            info = decode(message.datatype, message.payload)
            self._camera = messages.camera_from_info(info, message.topic)
        elif message.datatype == messages.STRING and self._urdf is None:
            self._urdf = str(decode(message.datatype, message.payload).data)
        if self._watch is None:
            self._prepare()

    def _prepare(self) -> None:
        """Begin to watch once everything is known that it needs."""
        rig, camera = self._rig, self._camera
        if camera is None:
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
        self._watch = MotionWatch(float(np.sqrt(camera.fx * camera.fy)), VotingSettings())

    def _take_joints(self, chain: KinematicChain, state: Any) -> None:
        names = (self._rig.joints.get(name, name) for name in state.name)
        positions = dict(zip(names, state.position, strict=False))
        if all(name in positions for name in chain.joint_names):
            self._add(state, tuple(float(positions[name]) for name in chain.joint_names))

    def _take_pose(self, message: Any) -> None:
        place, turn = message.pose.position, message.pose.orientation
        self._add(message, (place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w))

    def _add(self, message: Any, sample: tuple[float, ...]) -> None:
        stamp_ns = ns_from_time(message.header.stamp)
        if not self._stamps or stamp_ns > self._stamps[-1]:
            self._stamps.append(stamp_ns)
            self._samples.append(sample)

    def _pass_images(self, watch: MotionWatch) -> None:
        """Hand on the pose at every image that lies before the latest joints."""
        ready: list[int] = []
        while self._stamps and self._images and self._images[0] <= self._stamps[-1]:
            ready.append(self._images.popleft())
        if not ready:
            return
        query = np.array(sorted(ready), dtype=np.int64)
        for stamp_ns, pose in zip(query, self._camera_from_hand(query), strict=True):
            watch.add(pose, int(stamp_ns) / 1e9)

    def _camera_from_hand(self, query_ns: Stamps) -> Array:
        """Return (N, 4, 4) at some times; NaN where it is unknown."""
        stamps = np.array(self._stamps, dtype=np.int64)
        samples = np.array(self._samples)
        if self._chain is not None:
            joints = [interpolate(stamps, track, query_ns, MAX_GAP_NS) for track in samples.T]
            return inverse_transform(self._chain.hand_from_camera(np.stack(joints, axis=1)))
        mount = self._rig.mount
        assert mount is not None  # noqa: S101 - seen to by _prepare
        positions, quaternions = interpolate_poses(
            stamps, samples[:, :3], samples[:, 3:], query_ns, MAX_GAP_NS
        )
        base_from_hand = np.tile(np.eye(4), (len(query_ns), 1, 1))
        base_from_hand[:, :3, :3] = rotation_from_quaternion(quaternions)
        base_from_hand[:, :3, 3] = positions
        return np.asarray(inverse_transform(mount.parent_from_camera) @ base_from_hand)
