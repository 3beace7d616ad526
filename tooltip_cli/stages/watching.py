"""The hand's pose at each image while messages arrive, for the live verdict on the motion."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

import numpy as np

from tooltip_cli.errors import TooltipError
from tooltip_cli.log import messages
from tooltip_cli.log.messages import Message, decode, header_stamp_ns, ns_from_time
from tooltip_cli.log.recording import IMAGE_TYPES
from tooltip_cli.log.sync import interpolate
from tooltip_cli.log.views import MAX_GAP_NS
from tooltip_cli.method.types import Array
from tooltip_cli.method.voting.params import VotingSettings
from tooltip_cli.method.voting.watching import MotionWatch, Verdict
from tooltip_cli.rig.camera import CameraModel
from tooltip_cli.rig.kinematics import KinematicChain, inverse_transform
from tooltip_cli.rig.rigfile import Rig

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
        self._positions: deque[tuple[float, ...]] = deque(maxlen=_SAMPLES)
        self._images: deque[int] = deque(maxlen=_PENDING)
        self._verdict: Verdict | None = None
        self._judged = 0.0
        self.problem = ""  # why the motion cannot be judged

    def take(self, message: Message) -> None:
        """Read along; what cannot be used is left to later commands to complain about."""
        if self.problem:
            return
        try:
            self._take(message)
        except TooltipError as error:
            self.problem = str(error)
        except Exception as error:  # the decoder meets arbitrary bytes
            self.problem = f"{message.topic} carries no {message.datatype} ({error!r})"

    @property
    def ample(self) -> bool:
        """Whether more motion would not be looked at."""
        return self._watch is not None and self._watch.ample

    def verdict(self, *, now: bool = False) -> Verdict | None:
        """Return the verdict, a second old at most; None: nothing can be said yet."""
        if self._watch is not None:
            self._pass_images()
            if now or time.monotonic() - self._judged > _JUDGE_EVERY_S:
                self._verdict = self._watch.judge()
                self._judged = time.monotonic()
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
        elif message.datatype == messages.CAMERA_INFO and self._camera is None:
            info = decode(message.datatype, message.payload)
            self._camera = messages.camera_from_info(info, message.topic)
        elif message.datatype == messages.STRING and self._urdf is None:
            self._urdf = str(decode(message.datatype, message.payload).data)
        if self._chain is None:
            self._prepare()

    def _prepare(self) -> None:
        """Set up the chain once everything is known that it needs."""
        frame = self._rig.camera_frame or self._image_frame
        if self._urdf is None or self._camera is None or frame is None:
            return
        rig = self._rig
        self._chain = KinematicChain.from_urdf(
            self._urdf, frame, rig.hand_frame, rig.mount, rig.source
        )
        focal_px = float(np.sqrt(self._camera.fx * self._camera.fy))
        self._watch = MotionWatch(focal_px, VotingSettings())

    def _take_joints(self, chain: KinematicChain, state: Any) -> None:
        names = (self._rig.joints.get(name, name) for name in state.name)
        positions = dict(zip(names, state.position, strict=False))
        stamp_ns = ns_from_time(state.header.stamp)
        if not all(name in positions for name in chain.joint_names):
            return
        if self._stamps and stamp_ns <= self._stamps[-1]:
            return
        self._stamps.append(stamp_ns)
        self._positions.append(tuple(float(positions[name]) for name in chain.joint_names))

    def _pass_images(self) -> None:
        """Hand on the pose at every image that lies before the latest joints."""
        if not self._stamps or self._chain is None or self._watch is None:
            return
        ready: list[int] = []
        while self._images and self._images[0] <= self._stamps[-1]:
            ready.append(self._images.popleft())
        if not ready:
            return
        stamps = np.array(self._stamps, dtype=np.int64)
        query = np.array(sorted(ready), dtype=np.int64)
        joints = [
            interpolate(stamps, track, query, MAX_GAP_NS) for track in np.array(self._positions).T
        ]
        poses: Array = inverse_transform(self._chain.hand_from_camera(np.stack(joints, axis=1)))
        for stamp_ns, pose in zip(query, poses, strict=True):
            self._watch.add(pose, int(stamp_ns) / 1e9)
