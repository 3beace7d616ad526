"""Recordings from ROS 1 bags, ROS 2 bags and any other MCAP file with ROS messages."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from tooltip_cli.errors import MissingExtraError, TooltipError
from tooltip_cli.log import messages
from tooltip_cli.log.messages import Message
from tooltip_cli.log.recording import IMAGE_TYPES, Topics
from tooltip_cli.log.topics import choose_info, choose_topic, info_siblings
from tooltip_cli.rig.rigfile import Rig
from tooltip_cli.sources.bagfiles import StoredMessage, StoredTopic, open_bag
from tooltip_cli.sources.base import SourceReport
from tooltip_cli.sources.ros1types import cdr_from_ros1
from tooltip_cli.sources.streams import image_kind, plural, robot_message, with_robot

_ENCODINGS = ("cdr", "ros1")
_DEPTH = "/compressedDepth"  # image_transport's name for depth images, which are no pictures
_LISTED = 12


class BagSource:
    """The streams of a bag that a recording needs, under their own names.

    ROS 2 messages pass byte for byte, with both of their times; ROS 1 messages become CDR. The
    one thing that changes is ``CompressedImage.format``, which becomes exactly ``jpeg`` or
    ``png`` by what the data is.

    Args:
        path: a ROS 1 ``.bag``, a ROS 2 folder, a ``.db3`` or an ``.mcap`` file.
        topics: which topic to take for each role; None: the only one of its type.
        rig: stored in the log; names the pose topic where poses stand for joints.
        urdf: a robot description that takes the place of the bag's own and the rig's.

    Raises:
        TooltipError: no such bag, a damaged one, no image topic, or several for one role.
        MissingExtraError: the bag's format needs ``rosbags``, which is not installed.
    """

    def __init__(
        self,
        path: Path,
        topics: Topics | None = None,
        rig: Rig | None = None,
        urdf: str | None = None,
    ) -> None:
        self._path, self._rig = path, with_robot(rig, urdf)
        self._urdf = urdf if urdf is not None else (rig.urdf if rig is not None else None)
        self._report = SourceReport()
        self._replaced: list[str] = []  # the bag's own robot descriptions
        self._bag = open_bag(path)
        self._stored = {name: topic for name, topic in self._bag.topics().items() if topic.count}
        self._report.notes += self._bag.notes
        self._image, chosen = self._choose(topics or Topics())
        self._chosen = {topic: self._stored[topic] for topic in chosen}
        self._note_left_out()

    @property
    def frames(self) -> int | None:
        """Number of messages on the image topic."""
        return self._stored[self._image].count

    @property
    def image_topic(self) -> str | None:
        """The bag's own name for it."""
        return self._image

    @property
    def rig(self) -> Rig | None:
        """The rig that was given, naming the robot and the pose topic that were chosen."""
        return self._rig

    @property
    def report(self) -> SourceReport:
        """Filled while the messages are taken."""
        return self._report

    def messages(self) -> Iterator[Message]:
        """Yield the chosen topics' messages in the bag's order.

        Raises:
            TooltipError: the bag is damaged.
        """
        described = self._urdf is None
        for stored in self._bag.messages(self._chosen.keys()):
            if not described and self._urdf is not None:
                robot = robot_message(max(stored.log_time_ns, 0), self._urdf)
                self._report.count(robot.topic)
                yield robot
                described = True
            topic = self._chosen[stored.topic]
            payload = self._payload(stored, topic)
            if payload is None:
                continue
            self._report.count(stored.topic)
            times = stored.log_time_ns, stored.publish_time_ns
            yield Message(stored.topic, topic.datatype, times[0], payload, times[1], topic.qos)
        if not self._report.read.get(self._image):
            reasons = "; ".join(f"{count} {why}" for why, count in self._report.dropped.items())
            raise TooltipError(f"{self._path}: no image on {self._image} can be kept ({reasons})")

    def attachments(self) -> Mapping[str, bytes]:
        """A bag brings no files of its own."""
        return {}

    def _payload(self, stored: StoredMessage, topic: StoredTopic) -> bytes | None:
        """Return the message as it goes into the log; None, counted, where it cannot."""
        payload = stored.payload
        if stored.log_time_ns < 0 or stored.publish_time_ns < 0:
            self._report.drop(f"messages on {stored.topic} from before 1970")
            return None
        try:
            if topic.encoding == "ros1":
                payload = cdr_from_ros1(payload, topic.datatype)
            if topic.datatype != messages.COMPRESSED_IMAGE:
                return payload
            image = messages.decode(messages.COMPRESSED_IMAGE, payload)
        except MissingExtraError:
            raise
        except Exception:  # the decoders meet arbitrary bytes
            self._report.drop(f"messages on {stored.topic} that are no {topic.datatype}")
            return None
        kind = image_kind(image.data)
        if kind is None:
            reason = f"images on {stored.topic} that are neither JPEG nor PNG"
            if reason not in self._report.dropped:
                self._report.notes.append(f"{stored.topic} names the format '{image.format:.40}'")
            self._report.drop(reason)
            return None
        if image.format == kind:
            return payload
        stamp_ns = messages.ns_from_time(image.header.stamp)
        return messages.compressed_image(stamp_ns, image.header.frame_id, kind, image.data)

    def _choose(self, topics: Topics) -> tuple[str, list[str]]:
        """Return the image topic and all chosen topics."""
        source = str(self._path)
        types = {
            name: topic.datatype
            for name, topic in self._stored.items()
            if topic.encoding in _ENCODINGS
        }
        foreign = [
            f"topic {name} is encoded as {topic.encoding or 'nothing'}, not as a ROS message"
            for name, topic in self._stored.items()
            if topic.encoding not in _ENCODINGS
        ]
        pictures = {
            name: kind
            for name, kind in types.items()
            if not name.endswith(_DEPTH) or name == topics.image
        }
        image = choose_topic(
            pictures, "image", IMAGE_TYPES, topics.image, source, required=True, notes=foreign
        )
        assert image is not None  # noqa: S101 - required
        info = choose_info(types, image, topics.info, source)
        if info and not topics.info and info not in info_siblings(image):
            self._report.notes.append(
                f"intrinsics are taken from {info}, the only CameraInfo; it does not stand beside "
                f"{image}"
            )
        chosen = [image, info, *self._choose_motion(types, topics), self._choose_robot(types)]
        return image, [topic for topic in chosen if topic is not None]

    def _choose_motion(self, types: Mapping[str, str], topics: Topics) -> list[str | None]:
        """Return the topics that say where the hand is: joints, poses, or both."""
        source = str(self._path)
        named_pose = topics.pose or (self._rig.pose_topic if self._rig is not None else None)
        if named_pose and not topics.joints:
            # joints beside poses are kept where it is clear which, and not asked for
            known = [name for name, kind in types.items() if kind == messages.JOINT_STATE]
            joints = known[0] if len(known) == 1 else None
        else:
            joints = choose_topic(types, "joints", (messages.JOINT_STATE,), topics.joints, source)
        pose = None
        if named_pose or joints is None:
            pose = choose_topic(types, "pose", (messages.POSE_STAMPED,), named_pose, source)
        if joints is None and pose is None:
            self._report.notes.append(
                "no JointState and no PoseStamped topic: tips can be detected in this recording, "
                "not located"
            )
        by_pose = pose is not None and (topics.pose is not None or joints is None)
        if self._rig is not None and by_pose and self._rig.pose_topic != pose:
            self._rig = replace(self._rig, pose_topic=pose)
            self._report.notes.append(f"the stored rig takes the hand's poses from {pose}")
        return [joints, pose]

    def _choose_robot(self, types: Mapping[str, str]) -> str | None:
        known = [
            name
            for name, kind in types.items()
            if kind == messages.STRING and name.rsplit("/", 1)[-1] == "robot_description"
        ]
        if self._urdf is not None:
            for name in known:
                self._replaced.append(name)
                self._report.notes.append(f"the URDF of --robot or --rig takes the place of {name}")
            return None
        if len(known) > 1:
            raise TooltipError(
                f"{self._path} describes several robots: {', '.join(sorted(known))}; name a URDF "
                "file with --robot"
            )
        return known[0] if known else None

    def _note_left_out(self) -> None:
        others = sorted(self._stored.keys() - self._chosen.keys() - set(self._replaced))
        if others:
            more = f" and {len(others) - _LISTED} more" if len(others) > _LISTED else ""
            listing = ", ".join(others[:_LISTED])
            self._report.notes.append(f"{plural(len(others), 'topic')} left out: {listing}{more}")
