"""Live recordings of a robot without ROS: one camera, and one stream of joints."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence

from tooltip_cli.log import messages
from tooltip_cli.log.messages import Message
from tooltip_cli.rig.rigfile import Rig
from tooltip_cli.sources.base import SourceReport
from tooltip_cli.sources.cameras import camera_frames
from tooltip_cli.sources.joints import joint_samples
from tooltip_cli.sources.live import ArrivalClock, Deliver, Receiver
from tooltip_cli.sources.streams import (
    IMAGE_TOPIC,
    JOINT_TOPIC,
    image_messages,
    robot_message,
    with_robot,
)

_FAR_NS = 500_000_000  # between a joint's stamp and its arrival, for a clock to be another


class CameraSource:
    """A camera and a stream of joints, both on this machine's clock where they have none.

    Images are stamped when they arrive. Joints keep the sender's stamps, or are stamped when they
    arrive; the log keeps their arrival in any case.

    Args:
        camera: see :func:`tooltip_cli.sources.cameras.camera_frames`.
        joints: see :func:`tooltip_cli.sources.joints.joint_samples`; None: images alone.
        joints_by_arrival: take no notice of the sender's stamps.
        rig: stored in the log; its intrinsics are written beside every image.
        urdf: a robot description that takes the place of the rig's.

    Raises:
        TooltipError: ``joints`` is nothing that could be listened to.
    """

    def __init__(
        self,
        camera: str,
        joints: str | None = None,
        *,
        joints_by_arrival: bool = False,
        rig: Rig | None = None,
        urdf: str | None = None,
    ) -> None:
        self._rig = with_robot(rig, urdf)
        self._urdf = urdf if urdf is not None else (rig.urdf if rig is not None else None)
        self._report = SourceReport()
        self._clock = ArrivalClock()
        self._by_arrival = joints_by_arrival
        self._receivers: list[Receiver] = [_Camera(camera, self._rig, self._clock)]
        if joints is None:
            self._report.notes.append(
                "no joint angles: tips can be detected in this recording, not located"
            )
        else:
            by_arrival, report = joints_by_arrival, self._report
            self._receivers.append(_Joints(joints, by_arrival, self._clock, report))

    @property
    def image_topic(self) -> str:
        """The topic of the images."""
        return IMAGE_TOPIC

    @property
    def expected_topics(self) -> Sequence[str]:
        """Images, and joints where there is a source of them."""
        return (IMAGE_TOPIC, JOINT_TOPIC)[: len(self._receivers)]

    @property
    def rig(self) -> Rig | None:
        """The rig that was given."""
        return self._rig

    @property
    def report(self) -> SourceReport:
        """What was read and left out."""
        return self._report

    def first_messages(self) -> Sequence[Message]:
        """Return the robot description."""
        return [] if self._urdf is None else [robot_message(self._clock.now_ns(), self._urdf)]

    def receivers(self) -> Sequence[Receiver]:
        """Return the camera and the joints."""
        return self._receivers

    def metadata(self) -> Mapping[str, str]:
        """Say whose clock the stamps are."""
        return {
            **self._clock.metadata(),
            "image_stamps": "arrival",
            "joint_stamps": "arrival" if self._by_arrival else "the sender's where it gave one",
        }


class _Camera:
    def __init__(self, spec: str, rig: Rig | None, clock: ArrivalClock) -> None:
        self.name = "the camera"
        self._spec, self._clock = spec, clock
        self._frame_id = (rig.camera_frame if rig is not None else None) or "camera"
        self._camera = rig.camera if rig is not None else None

    def run(self, deliver: Deliver, halt: threading.Event) -> None:
        """Deliver images."""
        last_ns = -1
        for stamp_ns, kind, data in camera_frames(self._spec, self._clock, halt):
            last_ns = max(stamp_ns, last_ns + 1)
            for message in image_messages(last_ns, self._frame_id, kind, data, self._camera):
                deliver(message)


class _Joints:
    def __init__(
        self, spec: str, by_arrival: bool, clock: ArrivalClock, report: SourceReport
    ) -> None:
        self.name = f"the joints' source {spec}"
        self._samples = joint_samples(spec)
        self._by_arrival, self._clock, self._report = by_arrival, clock, report
        self._warned = False

    def run(self, deliver: Deliver, halt: threading.Event) -> None:
        """Deliver joint states."""
        for sample in self._samples(halt):
            arrival_ns = self._clock.now_ns()
            if isinstance(sample, str):
                self._report.drop(f"{sample} from {self.name}")
                continue
            stamp_ns = arrival_ns
            if sample.stamp_ns is not None and not self._by_arrival:
                stamp_ns = sample.stamp_ns
                self._compare(stamp_ns, arrival_ns)
            names, positions = list(sample.positions), list(sample.positions.values())
            payload = messages.joint_state(stamp_ns, names, positions)
            deliver(Message(JOINT_TOPIC, messages.JOINT_STATE, arrival_ns, payload, stamp_ns))

    def _compare(self, stamp_ns: int, arrival_ns: int) -> None:
        """Say once where images and joints cannot meet."""
        if abs(stamp_ns - arrival_ns) > _FAR_NS and not self._warned:
            self._warned = True
            self._report.notes.append(
                f"{self.name} stamps {(stamp_ns - arrival_ns) / 1e9:+.1f} s off this machine's "
                "clock, so images and joints do not meet; give --joint-stamps arrival, or set "
                "time_offset in the rig file"
            )
