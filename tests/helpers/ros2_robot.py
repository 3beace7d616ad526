"""A ROS 2 robot as the network sees it: a process that publishes over DDS, stamped and numbered.

python -m tests.helpers.ros2_robot DOMAIN KIND WIDTH HEIGHT FPS JOINT_HZ SECONDS
"""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic

from tests.helpers.pacing import pace, play_file
from tests.helpers.robot import CAMERA, CAMERA_FRAME, JOINTS, URDF
from tooltip_cli.log import messages
from tooltip_cli.sources.dds import dds_type

IMAGE, RAW, INFO = "/camera/image/compressed", "/camera/image_raw", "/camera/camera_info"
STATES, ROBOT = "/joint_states", "/robot_description"
START_NS = 1_700_000_000 * 10**9
MATCHED_S = 30.0


def image_payload(kind: str, width: int, height: int, number: int) -> bytes:
    """Return the CDR bytes of an image; each number has other pixels."""
    stamp_ns = START_NS + number * 10**7
    rng = np.random.default_rng(number)
    if kind == "jpeg":
        data = b"\xff\xd8\xff" + rng.bytes(width * height // 8) + b"\xff\xd9"
        return messages.compressed_image(stamp_ns, CAMERA_FRAME, "jpeg", data)
    fields = {"height": height, "width": width, "encoding": "bgr8", "step": 3 * width}
    pixels = rng.bytes(3 * width * height)
    header = messages.header(stamp_ns, CAMERA_FRAME)
    return messages.encode(messages.IMAGE, {"header": header, **fields, "data": pixels})


def joint_payload(number: int) -> bytes:
    """Return the CDR bytes of a joint state."""
    return messages.joint_state(START_NS + number * 10**6, JOINTS, (0.001 * number, -0.5))


class Publisher:
    """Publishes ready-made CDR bytes under a ROS 2 name and type."""

    def __init__(self, participant: Any, name: str, datatype: str, *policies: Any) -> None:
        self._raw = dds_type(datatype)
        self._raw.serialize = lambda sample, *_, **__: sample.raw
        topic = Topic(participant, f"rt{name}", self._raw)
        self.writer = DataWriter(participant, topic, qos=Qos(*policies))

    def send(self, payload: bytes) -> None:
        sample = object.__new__(self._raw)
        sample.raw = payload
        self.writer.write(sample)


def heard(*publishers: Publisher) -> bool:
    """Return whether somebody subscribes to each of them."""
    return all(item.writer.get_matched_subscriptions() for item in publishers)


def main(domain: int, kind: str, width: int, height: int, fps: float, hz: float, s: float) -> None:
    participant = DomainParticipant(domain)
    sensor = (Policy.Reliability.BestEffort, Policy.History.KeepLast(10))
    latched = (
        Policy.Reliability.Reliable(10**9),
        Policy.Durability.TransientLocal,
        Policy.History.KeepLast(1),
    )
    images = (
        Publisher(participant, IMAGE, messages.COMPRESSED_IMAGE, *sensor)
        if kind == "jpeg"
        else Publisher(participant, RAW, messages.IMAGE, *sensor)
    )
    infos = Publisher(participant, INFO, messages.CAMERA_INFO, *sensor)
    default = (Policy.Reliability.Reliable(10**9), Policy.History.KeepLast(10))
    states = Publisher(participant, STATES, messages.JOINT_STATE, *default)
    robot = Publisher(participant, ROBOT, messages.STRING, *latched)
    robot.send(messages.string(URDF))
    payloads = [image_payload(kind, width, height, number) for number in range(30)]
    end = time.monotonic() + MATCHED_S
    while not heard(images, states):
        if time.monotonic() > end:
            raise SystemExit("nobody listens")
        time.sleep(0.01)
    time.sleep(0.5)  # the other side knows of it a little later

    def image(number: int) -> None:
        infos.send(messages.camera_info(START_NS + number * 10**7, CAMERA_FRAME, CAMERA))
        images.send(payloads[number % len(payloads)])

    print(*pace(fps, hz, s, image, lambda number: states.send(joint_payload(number))), flush=True)
    time.sleep(1.0)  # what is on its way still arrives


def play(domain: int, path: str) -> None:
    """Publish the messages of a file; see tests.helpers.pacing."""
    participant = DomainParticipant(domain)
    reliable = (Policy.Reliability.Reliable(10**9), Policy.History.KeepLast(100))
    play_file(path, lambda name, kind: Publisher(participant, name, kind, *reliable).send)


if __name__ == "__main__":
    if sys.argv[2] == "play":
        play(int(sys.argv[1]), sys.argv[3])
    else:
        domain, kind, width, height, fps, hz, seconds = sys.argv[1:]
        main(int(domain), kind, int(width), int(height), float(fps), float(hz), float(seconds))
