"""``offered_qos_profiles``: what ``ros2 bag play`` and ``rosbags`` read."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from rosbags.interfaces import ConnectionExtRosbag2, QosDurability, QosReliability
from rosbags.rosbag2 import Reader

from tests.helpers.logs import JOINT_TOPIC, joint_message, robot_message
from tooltip_cli.log.container import LoggedMessage, iterate
from tooltip_cli.log.messages import Message
from tooltip_cli.log.qos import (
    Qos,
    default_qos,
    known_qos,
    latched_qos,
    qos_of_profiles,
    qos_yaml,
)
from tooltip_cli.log.writer import LogWriter
from tooltip_cli.sources.bag import BagSource

# every field that rosbag2's decoder asks for (rosbag2_storage/qos.cpp)
FIELDS = [
    *("history", "depth", "reliability", "durability", "deadline", "lifespan", "liveliness"),
    *("liveliness_lease_duration", "avoid_ros_namespace_conventions"),
]
SENSOR = qos_yaml([Qos(depth=5, reliability=2)])
WORDS = """
- history: keep_last
  depth: 5
  reliability: best_effort
  durability: volatile
  deadline: {sec: 0, nsec: 0}
  lifespan: {sec: 0, nsec: 0}
  liveliness: automatic
  liveliness_lease_duration: {sec: 0, nsec: 0}
  avoid_ros_namespace_conventions: false
"""


@pytest.mark.parametrize("topic", ["/joint_states", "/robot_description", "/tf_static"])
def test_every_field_is_there_and_policies_are_numbers(topic: str) -> None:
    (profile,) = yaml.safe_load(default_qos(topic))
    assert list(profile) == FIELDS
    for name in ("history", "depth", "reliability", "durability", "liveliness"):
        assert isinstance(profile[name], int)
    for name in ("deadline", "lifespan", "liveliness_lease_duration"):
        assert profile[name] == {"sec": 0, "nsec": 0}


def test_another_program_reads_it(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap") as writer:
        writer.write(robot_message())
        writer.write(joint_message(5, ("a",), (0.5,)))
    with Reader(tmp_path / "a.mcap") as reader:
        found = {
            item.topic: item.ext.offered_qos_profiles[0]
            for item in reader.connections
            if isinstance(item.ext, ConnectionExtRosbag2)
        }
    assert found["/robot_description"].durability is QosDurability.TRANSIENT_LOCAL
    assert found[JOINT_TOPIC].durability is QosDurability.VOLATILE
    assert {item.reliability for item in found.values()} == {QosReliability.RELIABLE}


def test_words_become_numbers() -> None:
    assert known_qos(WORDS) == SENSOR
    assert known_qos(SENSOR) == SENSOR


@pytest.mark.parametrize(
    "text",
    [
        "",
        "  \n",
        "[]",
        "{}",
        "5",
        "[5]",
        "- history: 1",
        "&a [*a]",
        "[",
        WORDS.replace("keep_last", "keep_most"),
        WORDS.replace("volatile", "9"),
        WORDS.replace("depth: 5", "depth: many"),
        "x" * 200_000,
    ],
)
def test_what_is_no_profile_is_not_taken_over(text: str) -> None:
    assert known_qos(text) is None


@given(st.text(max_size=60))
def test_any_text(text: str) -> None:
    found = known_qos(text)
    assert found is None or yaml.safe_load(found)


@pytest.mark.parametrize("stated", [SENSOR, WORDS, ""])
def test_an_import_keeps_what_the_bag_says(stated: str, wrist_file: Path, tmp_path: Path) -> None:
    with LogWriter(tmp_path / "bag.mcap") as writer:
        for item in iterate(wrist_file):
            if isinstance(item, LoggedMessage):
                writer.write(
                    Message(item.topic, item.datatype, item.log_time_ns, item.payload, None, stated)
                )
    expected = SENSOR if stated else None
    assert {message.qos for message in BagSource(tmp_path / "bag.mcap").messages()} == {expected}


def test_profiles_as_rosbags_reads_them(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap") as writer:
        message = robot_message()
        writer.write(
            Message(message.topic, message.datatype, 5, message.payload, None, latched_qos())
        )
    with Reader(tmp_path / "a.mcap") as reader:
        (connection,) = reader.connections
    assert isinstance(connection.ext, ConnectionExtRosbag2)
    assert qos_of_profiles(connection.ext.offered_qos_profiles) == latched_qos()
    assert qos_of_profiles([]) is None
