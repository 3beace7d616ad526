"""``tooltip record ros1``: a real master, and nodes of rospy that publish.

They are Debian's ``python3-rosmaster``, ``python3-rospy`` and ``python3-sensor-msgs``; the tests
that need them skip where they are not installed. Others speak to a master written here.
"""

from __future__ import annotations

import signal
import socket
import struct
import sys
import threading
import time
import xmlrpc.server
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("rosbags")

from tests.helpers import ros1_robot
from tests.helpers.cli import tooltip
from tests.helpers.live import free_port
from tests.helpers.recorder import by_topic, ended, grown, recorder, wait_for
from tests.helpers.robot import URDF
from tests.helpers.robots import (
    has_ros1,
    network_at,
    ros1_master,
)
from tests.helpers.ros1_robot import DESCRIPTION, IMAGE, INFO, STATES
from tooltip_cli.log import messages
from tooltip_cli.log.messages import Message, decode
from tooltip_cli.sources import ros1types
from tooltip_cli.sources.base import SourceReport
from tooltip_cli.sources.bus import HeardTopic
from tooltip_cli.sources.live import ArrivalClock
from tooltip_cli.sources.ros1 import Ros1Bus
from tooltip_cli.sources.ros1types import definition_sum

needs_ros1 = pytest.mark.skipif(
    not has_ros1(), reason="needs Debian's python3-rosmaster, python3-rospy and python3-sensor-msgs"
)


@pytest.fixture
def master() -> Iterator[str]:
    with ros1_master() as (uri, _):
        yield uri


@needs_ros1
def test_topics_are_found_with_the_latched_and_the_description(master: str, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    sender = network_at("ros1", master).start("jpeg", 64, 48, 30, 100, 2.0)
    wait_for(lambda: INFO in [topic.name for topic in Ros1Bus(master).heard(0)], "the robot")
    listener = recorder("ros1", out, "--master", master, "--patience", 3)
    sender.communicate(timeout=90)
    ended(listener)
    found = by_topic(out)
    assert set(found) == {IMAGE, INFO, STATES, DESCRIPTION}
    (info,) = found[INFO]
    assert decode(messages.CAMERA_INFO, info.payload).k[0] == 140.0
    assert "durability: 1" in info.channel.metadata["offered_qos_profiles"]
    assert [m.payload for m in found[DESCRIPTION]] == [messages.string(URDF)]


@needs_ros1
def test_a_master_that_is_not_there_yet_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = free_port()
    monkeypatch.setattr("tests.helpers.robots.free_port", lambda: port)
    out, uri = tmp_path / "out.mcap", f"http://127.0.0.1:{port}"
    names = ("--image", IMAGE, "--joints", STATES, "--reconnect")
    listener = recorder("ros1", out, "--master", uri, *names)
    time.sleep(2)  # in which nothing answers
    with ros1_master() as (master, _):
        assert master == uri
        network_at("ros1", master).start("jpeg", 64, 48, 30, 100, 1.5).communicate(timeout=90)
    err = ended(listener, signal.SIGINT)
    assert err.count("cannot be reached (Connection refused)") == 1
    assert "; waiting for it" in err
    assert by_topic(out)[IMAGE]


@needs_ros1
def test_a_node_that_is_killed_and_restarted_is_heard_again(master: str, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    names = ("--image", IMAGE, "--joints", STATES, "--reconnect")
    first = network_at("ros1", master).start("jpeg", 64, 48, 30, 100, 60)
    listener = recorder("ros1", out, "--master", master, *names)
    wait_for(grown(out, 20_000), "a recording")
    first.kill()  # the master goes on naming it
    first.communicate()
    time.sleep(2)  # so that the silence is noticed
    second = network_at("ros1", master).start("jpeg", 64, 48, 30, 100, 1.5)
    second.communicate(timeout=90)
    err = ended(listener, signal.SIGINT)
    stamps = [
        messages.ns_from_time(decode(m.datatype, m.payload).header.stamp)
        for m in by_topic(out)[IMAGE]
    ]
    assert stamps.count(ros1_robot.stamp_ns(30, 0)) == 2
    assert f"which publishes {IMAGE}, cannot be reached" in err
    assert f"{IMAGE} is heard again after" in err


@needs_ros1
def test_a_master_that_dies_costs_nothing_that_is_connected(tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    names = ("--image", IMAGE, "--joints", STATES, "--patience", 3)
    with ros1_master() as (master, process):
        sender = network_at("ros1", master).start("jpeg", 64, 48, 30, 100, 4.0)
        listener = recorder("ros1", out, "--master", master, *names)
        wait_for(grown(out, 20_000), "a recording")
        process.kill()
        sent, _ = sender.communicate(timeout=90)
    err = ended(listener)
    assert len(by_topic(out)[IMAGE]) == int(sent.split()[0])
    assert err.count("who is connected is recorded on") == 1


def test_nobody_there_says_so(tmp_path: Path) -> None:
    master = f"http://127.0.0.1:{free_port()}"
    done = tooltip("record", "ros1", tmp_path / "out.mcap", "--master", master)
    assert done.code == 1
    assert f"the ROS 1 master at {master} cannot be reached (Connection refused)" in done.error
    done = tooltip("record", "ros1", tmp_path / "out.mcap", "--master", "robot:11311")
    assert "expected e.g. http://robot:11311" in done.error
    assert not list(tmp_path.iterdir())


def test_without_rosbags_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for function in (ros1types.definition_sum, ros1types.typestore):
        function.cache_clear()
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    done = tooltip("record", "ros1", "out.mcap")
    assert done.code == 1
    assert "pip install 'tooltip-cli[ros1]'" in done.error


class Node:
    """A master and the one node that it knows, which sends given bytes to whoever connects."""

    def __init__(self, data: bytes, datatype: str = "sensor_msgs/JointState") -> None:
        self._data, self._stop = data, threading.Event()
        self._server = xmlrpc.server.SimpleXMLRPCServer(("127.0.0.1", 0), logRequests=False)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.uri = f"http://127.0.0.1:{self._server.server_address[1]}"
        port = self._listener.getsockname()[1]
        answers = {
            "getUri": self.uri,
            "getSystemState": [[[STATES, ["/node"]]], [], []],
            "getTopicTypes": [[STATES, datatype]],
            "getParamNames": [],
            "lookupNode": self.uri,
            "requestTopic": ["TCPROS", "127.0.0.1", port],
        }
        for name, answer in answers.items():
            self._server.register_function(lambda *_, answer=answer: (1, "", answer), name)

    def __enter__(self) -> Node:
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        threading.Thread(target=self._send, daemon=True).start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._server.shutdown()
        self._server.server_close()
        self._listener.close()

    def _send(self) -> None:
        try:
            while True:
                connection = self._listener.accept()[0]
                connection.recv(1 << 16)
                connection.sendall(self._data)
                threading.Thread(target=self._close, args=(connection,), daemon=True).start()
        except OSError:
            return

    def _close(self, connection: socket.socket) -> None:
        self._stop.wait(1.0)
        connection.close()


def header(**fields: str) -> bytes:
    lines = [f"{name}={value}".encode() for name, value in fields.items()]
    packed = b"".join(struct.pack("<I", len(line)) + line for line in lines)
    return struct.pack("<I", len(packed)) + packed


GOOD = header(callerid="/node", md5sum=definition_sum(messages.JOINT_STATE), latching="0")


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (header(error="md5sums do not match"), "refuses: md5sums do not match"),
        (b"\x04\x00\x00\x00HTTP", "does not answer as TCPROS does"),
        (b"\xff\xff\xff\xff", "does not answer as TCPROS does"),
        (b"", "does not answer as TCPROS does"),
        (GOOD + b"\xff\xff\xff\xff", "announces a message of 4294967295 bytes"),
        (GOOD + b"\x03\x00\x00\x00abc", "that are no sensor_msgs/msg/JointState"),
    ],
)
def test_nonsense_is_told_in_a_line_and_outlived(data: bytes, said: str) -> None:
    report, taken, halt = SourceReport(), list[Message](), threading.Event()
    with Node(data) as node:
        bus = Ros1Bus(node.uri)
        topic = HeardTopic(STATES, messages.JOINT_STATE)
        receiver = bus.receiver(topic, ArrivalClock(), report)
        thread = threading.Thread(target=receiver.run, args=(taken.append, halt))
        thread.start()
        wait_for(lambda: any(said in text for text in [*report.notes, *report.dropped]), said)
        halt.set()
        thread.join(30)
        assert not thread.is_alive()
    assert not taken
