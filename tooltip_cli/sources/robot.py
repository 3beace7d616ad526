"""Live recordings of a robot that publishes ROS messages, without ROS."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from tooltip_cli.errors import TooltipError
from tooltip_cli.log import messages
from tooltip_cli.log.messages import Message
from tooltip_cli.log.recording import IMAGE_TYPES, Topics
from tooltip_cli.log.topics import choose_info, choose_topic
from tooltip_cli.rig.rigfile import Rig
from tooltip_cli.sources.base import SourceReport
from tooltip_cli.sources.bus import DISCOVERY_S, RECORDED_TYPES, Bus, HeardTopic
from tooltip_cli.sources.live import ArrivalClock, Receiver
from tooltip_cli.sources.streams import robot_message, with_robot

_EXPECTED = (*IMAGE_TYPES, messages.JOINT_STATE, messages.POSE_STAMPED)


class RobotSource:
    """Images, intrinsics, joints or poses and the robot description of a robot on a network.

    Topics that are named need not be there yet; others are the only ones of their types that are
    heard in the first seconds.

    Args:
        bus: the network that the robot publishes on.
        topics: which topic to take for each role.
        rig: stored in the log; names the pose topic where poses stand for joints.
        urdf: a robot description that takes the place of the robot's own and the rig's.
        wait_s: seconds in which topics are looked for.

    Raises:
        TooltipError: no images are heard, or several topics could be meant.
    """

    def __init__(
        self,
        bus: Bus,
        topics: Topics | None = None,
        rig: Rig | None = None,
        urdf: str | None = None,
        wait_s: float = DISCOVERY_S,
    ) -> None:
        self._rig = with_robot(rig, urdf)
        self._urdf = urdf if urdf is not None else (rig.urdf if rig is not None else None)
        self._report, self._clock, self._bus = SourceReport(), ArrivalClock(), bus
        if self._urdf is None:
            self._urdf = bus.robot_description()
        self._topics = self._choose(bus.heard(wait_s), topics or Topics())
        self._image = self._topics[0].name

    @property
    def image_topic(self) -> str:
        """The robot's own name for it."""
        return self._image

    @property
    def expected_topics(self) -> Sequence[str]:
        """Images and joints or poses."""
        return [topic.name for topic in self._topics if topic.datatype in _EXPECTED]

    @property
    def rig(self) -> Rig | None:
        """The rig that was given."""
        return self._rig

    @property
    def report(self) -> SourceReport:
        """What was read and left out."""
        return self._report

    def first_messages(self) -> Sequence[Message]:
        """Return the robot description, where it is known beforehand."""
        return [] if self._urdf is None else [robot_message(self._clock.now_ns(), self._urdf)]

    def receivers(self) -> Sequence[Receiver]:
        """Return one receiver a topic."""
        return [self._bus.receiver(topic, self._clock, self._report) for topic in self._topics]

    def metadata(self) -> Mapping[str, str]:
        """Say whose clocks the stamps are."""
        return {
            **self._clock.metadata(),
            "header_stamps": "the publishers'",
            **self._bus.metadata(),
        }

    def _choose(self, heard: Iterable[HeardTopic], wanted: Topics) -> list[HeardTopic]:
        known = {(topic.name, topic.datatype): topic for topic in heard}
        where = self._bus.where
        types = self._types(known, wanted)
        image = choose_topic(types, "image", IMAGE_TYPES, wanted.image, where, required=True)
        assert image is not None  # noqa: S101 - required
        named_pose = wanted.pose or (self._rig.pose_topic if self._rig is not None else None)
        joints = None
        if wanted.joints or not named_pose:
            joints = choose_topic(types, "joints", (messages.JOINT_STATE,), wanted.joints, where)
        pose = None
        if named_pose or joints is None:
            pose = choose_topic(types, "pose", (messages.POSE_STAMPED,), named_pose, where)
        if joints is None and pose is None:
            self._report.notes.append(
                "no JointState and no PoseStamped topic is heard: tips can be detected in this "
                "recording, not located"
            )
        chosen: list[str | None] = [
            image,
            choose_info(types, image, wanted.info, where),
            joints,
            pose,
        ]
        if self._urdf is None:
            chosen += [name for name in types if types[name] == messages.STRING][:1]
        return [
            known.get((name, types[name]), HeardTopic(name, types[name]))
            for name in chosen
            if name is not None
        ]

    def _types(self, known: Mapping[tuple[str, str], HeardTopic], wanted: Topics) -> dict[str, str]:
        """Return the types by topic of what is heard or asked for by name."""
        types: dict[str, str] = {}
        for name, datatype in known:
            if datatype in RECORDED_TYPES and (
                datatype != messages.STRING or name.endswith("/robot_description")
            ):
                types[name] = datatype
        raw = not (wanted.image or "").endswith("/compressed")
        roles = (
            (wanted.image, messages.IMAGE if raw else messages.COMPRESSED_IMAGE),
            (wanted.joints, messages.JOINT_STATE),
            (wanted.info, messages.CAMERA_INFO),
            (wanted.pose, messages.POSE_STAMPED),
        )
        for named, expected in roles:
            allowed = IMAGE_TYPES if expected in IMAGE_TYPES else (expected,)
            if named is None or types.get(named) in allowed:
                continue
            others = [kind for other, kind in known if other == named]
            if others:
                raise TooltipError(
                    f"{named} carries {', '.join(others)}, expected {expected}; name another topic"
                )
            types[named] = expected
            self._report.notes.append(f"{named} is not published yet")
        return types
