"""``tooltip record ros2``: another process publishes over DDS, on the loopback interface alone."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("cyclonedds")

from cyclonedds.core import Policy
from cyclonedds.domain import DomainParticipant

from tests.helpers import ros2_robot
from tests.helpers.cli import tooltip
from tests.helpers.fastdds_robot import has_fastdds, program
from tests.helpers.recorder import ROOT, by_topic, ended, grown, recorder, wait_for
from tests.helpers.robot import URDF
from tests.helpers.ros2_robot import IMAGE, INFO, RAW, ROBOT, STATES, Publisher
from tooltip_cli.log import messages
from tooltip_cli.sources.dds import dds_type_name, ros_type_name

_NUMBERS = itertools.count(30)
LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General><Discovery>"
    "<ParticipantIndex>auto</ParticipantIndex><Peers><Peer address='127.0.0.1'/></Peers>"
    "</Discovery></Domain></CycloneDDS>"
)


@pytest.fixture
def domain(worker_id: str, monkeypatch: pytest.MonkeyPatch) -> int:
    """Return a domain for one test alone, which no other one's publishers are heard in."""
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    worker = int(worker_id.removeprefix("gw")) if worker_id != "master" else 8
    return 20 * (worker % 9) + next(_NUMBERS)


def robot(domain: int, *arguments: object, kind: str = "ros2") -> subprocess.Popen[str]:
    module = f"tests.helpers.{kind}_robot"
    command = [sys.executable, "-m", module, str(domain), *map(str, arguments)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)


def on_the_wire(payload: bytes) -> bytes:
    """Return CDR bytes as they are sent, in whole words."""
    return payload + bytes(-len(payload) % 4)


@pytest.mark.parametrize(
    ("kind", "topic", "datatype"),
    [("jpeg", IMAGE, messages.COMPRESSED_IMAGE), ("raw", RAW, messages.IMAGE)],
)
def test_every_message_arrives_byte_for_byte(
    kind: str, topic: str, datatype: str, domain: int, tmp_path: Path
) -> None:
    out = tmp_path / "out.mcap"
    sender = robot(domain, kind, 320, 240, 30, 200, 2.0)
    listener = recorder(
        "ros2", out, "--domain", domain, "--image", topic, "--joints", STATES, "--patience", 3
    )
    sent, _ = sender.communicate(timeout=90)
    ended(listener)
    images, joints = map(int, sent.split())
    found = by_topic(out)
    assert [m.payload for m in found[topic]] == [
        on_the_wire(ros2_robot.image_payload(kind, 320, 240, i % 30)) for i in range(images)
    ]
    assert [m.payload for m in found[STATES]] == [
        on_the_wire(ros2_robot.joint_payload(i)) for i in range(joints)
    ]
    assert {m.datatype for m in found[topic]} == {datatype}
    assert all(0 < m.publish_time_ns <= m.log_time_ns for m in found[topic])
    if INFO in found:  # those that were heard of before the recording began
        assert len(found[INFO]) == images
        assert [m.payload for m in found[ROBOT]] == [on_the_wire(messages.string(URDF))]


def test_topics_are_found_and_latched_ones_are_read(domain: int, tmp_path: Path) -> None:
    participant = DomainParticipant(domain)
    sensor = Policy.Reliability.BestEffort
    images = Publisher(participant, IMAGE, messages.COMPRESSED_IMAGE, sensor)
    states = Publisher(participant, STATES, messages.JOINT_STATE, sensor)
    described = Publisher(
        participant,
        ROBOT,
        messages.STRING,
        Policy.Reliability.Reliable(10**9),
        Policy.Durability.TransientLocal,
    )
    described.send(messages.string(URDF))
    listener = recorder("ros2", tmp_path / "out.mcap", "--domain", domain)
    for i in range(3000):
        images.send(ros2_robot.image_payload("jpeg", 32, 24, i))
        states.send(ros2_robot.joint_payload(i))
        time.sleep(0.01)
        if images.writer.get_matched_subscriptions() and i % 100 == 99:
            break
    time.sleep(0.5)
    ended(listener, signal.SIGINT)
    found = by_topic(tmp_path / "out.mcap")
    assert set(found) == {IMAGE, STATES, ROBOT}
    assert [m.payload for m in found[ROBOT]] == [on_the_wire(messages.string(URDF))]


def test_a_topic_of_the_wrong_type_is_named(domain: int, tmp_path: Path) -> None:
    participant = DomainParticipant(domain)
    sensor = Policy.Reliability.BestEffort
    kept = (
        Publisher(participant, IMAGE, messages.COMPRESSED_IMAGE, sensor),
        Publisher(participant, STATES, messages.POSE_STAMPED, sensor),
    )
    options = ("--domain", domain, "--joints", STATES)
    done = tooltip("record", "ros2", tmp_path / "out.mcap", *options)
    assert len(kept) == 2
    assert done.code == 1
    assert (
        f"{STATES} carries geometry_msgs/msg/PoseStamped, expected sensor_msgs/msg/JointState"
        in done.error
    )
    assert not list(tmp_path.iterdir())


def test_nothing_heard_says_so(domain: int, tmp_path: Path) -> None:
    done = tooltip("record", "ros2", tmp_path / "out.mcap", "--domain", domain)
    assert done.code == 1
    assert f"DDS domain {domain} has no image topic" in done.error


def test_a_publisher_that_is_killed_and_restarted_is_heard_again(
    domain: int, tmp_path: Path
) -> None:
    out = tmp_path / "out.mcap"
    options = ("--image", IMAGE, "--joints", STATES, "--reconnect")
    listener = recorder("ros2", out, "--domain", domain, *options)
    first = robot(domain, "jpeg", 64, 48, 30, 100, 60)
    wait_for(grown(out, 20_000), "a recording")
    first.kill()
    first.communicate()
    time.sleep(2)  # so that the silence is noticed
    second = robot(domain, "jpeg", 64, 48, 30, 100, 1.5)
    second.communicate(timeout=90)
    err = ended(listener, signal.SIGINT)
    payloads = [m.payload for m in by_topic(out)[IMAGE]]
    assert payloads.count(on_the_wire(ros2_robot.image_payload("jpeg", 64, 48, 0))) >= 2
    assert f"nothing on {IMAGE} any more" in err
    assert f"{IMAGE} is heard again after" in err


def test_list_shows_topics_types_and_rates(domain: int) -> None:
    sender = robot(domain, "jpeg", 64, 48, 20, 100, 4)
    done = tooltip("record", "list", "--on", "ros2", "--domain", domain, "--json")
    for _ in range(10):  # until the robot is up
        if done.code == 0 and len(json.loads(done.out)) == 4:
            break
        done = tooltip("record", "list", "--on", "ros2", "--domain", domain, "--json")
    sender.communicate(timeout=90)
    found = {item["topic"]: item for item in json.loads(done.out)}
    assert set(found) == {IMAGE, INFO, STATES, ROBOT}
    assert found[IMAGE]["type"] == messages.COMPRESSED_IMAGE
    assert found[STATES]["hz"] > found[IMAGE]["hz"] > 1
    assert found[ROBOT]["hz"] == 0


@pytest.mark.parametrize("command", [("ros2", "out.mcap"), ("list", "--on", "ros2")])
def test_without_cyclonedds_the_extra_is_named(
    command: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.startswith("cyclonedds.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "cyclonedds", None)
    done = tooltip("record", *command)
    assert done.code == 1
    assert "pip install 'tooltip-cli[ros2]'" in done.error


def test_names_of_types_on_the_wire() -> None:
    assert dds_type_name(messages.JOINT_STATE) == "sensor_msgs::msg::dds_::JointState_"
    assert ros_type_name("sensor_msgs::msg::dds_::JointState_") == messages.JOINT_STATE
    assert ros_type_name("sensor_msgs::srv::dds_::SetCameraInfo_Request_") is None


@pytest.mark.skipif(not has_fastdds(), reason="needs Debian's libfastrtps-dev, and g++")
def test_another_vendors_dds_is_recorded_byte_for_byte(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    program()  # compiled before the time for finding each other runs
    monkeypatch.setenv("CYCLONEDDS_URI", "<CycloneDDS><Domain/></CycloneDDS>")
    domain, out = 200 + os.getpid() % 30, tmp_path / "out.mcap"
    sender = robot(domain, "jpeg", 320, 240, 30, 200, 2.0, kind="fastdds")
    listener = recorder("ros2", out, "--domain", domain, "--image", IMAGE, "--joints", STATES)
    sent, _ = sender.communicate(timeout=90)
    ended(listener, signal.SIGINT)
    images, joints = map(int, sent.split())
    found = by_topic(out)
    assert [m.payload for m in found[IMAGE]] == [
        on_the_wire(ros2_robot.image_payload("jpeg", 320, 240, i % 30)) for i in range(images)
    ]
    assert [m.payload for m in found[STATES]] == [
        on_the_wire(ros2_robot.joint_payload(i)) for i in range(joints)
    ]
