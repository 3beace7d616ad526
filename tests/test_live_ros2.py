"""``tooltip record ros2``: another process publishes over DDS, on the loopback interface alone."""

from __future__ import annotations

import os
import signal
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
from tests.helpers.recorder import by_topic, ended, grown, recorder, wait_for
from tests.helpers.robot import URDF
from tests.helpers.robots import LOOPBACK, network_at, on_the_wire, own_domain
from tests.helpers.ros2_robot import IMAGE, ROBOT, STATES, Publisher, heard
from tooltip_cli.log import messages
from tooltip_cli.sources.dds import dds_type_name, ros_type_name


@pytest.fixture
def domain(worker_id: str, monkeypatch: pytest.MonkeyPatch) -> int:
    """Return a domain for one test alone, which no other one's publishers are heard in."""
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    return own_domain(worker_id)


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
    wait_for(lambda: heard(images, states), "a subscription to both")
    for i in range(50):
        images.send(ros2_robot.image_payload("jpeg", 32, 24, i))
        states.send(ros2_robot.joint_payload(i))
        time.sleep(0.02)  # the other side knows of it a little later
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
    first = network_at("ros2", str(domain)).start("jpeg", 64, 48, 30, 100, 60)
    wait_for(grown(out, 20_000), "a recording")
    first.kill()
    first.communicate()
    time.sleep(2)  # so that the silence is noticed
    second = network_at("ros2", str(domain)).start("jpeg", 64, 48, 30, 100, 1.5)
    second.communicate(timeout=90)
    err = ended(listener, signal.SIGINT)
    payloads = [m.payload for m in by_topic(out)[IMAGE]]
    assert payloads.count(on_the_wire(ros2_robot.image_payload("jpeg", 64, 48, 0))) >= 2
    assert f"nothing on {IMAGE} any more" in err
    assert f"{IMAGE} is heard again after" in err


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
    sender = network_at("fastdds", str(domain)).start("jpeg", 320, 240, 30, 200, 2.0)
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
