"""Robots on each network that is recorded from, with what they need: a router, a master."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import itertools
import os
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tests.helpers import ros1_robot
from tests.helpers.live import free_port
from tests.helpers.recorder import ROOT, wait_for
from tests.helpers.robot import CAMERA_FRAME, JOINTS, URDF
from tooltip_cli.log import messages

SYSTEM_PYTHON = "/usr/bin/python3"
TRANSPORTS = ("ros2", "zenoh", "ros1")
LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General><Discovery>"
    "<ParticipantIndex>auto</ParticipantIndex><Peers><Peer address='127.0.0.1'/></Peers>"
    "</Discovery></Domain></CycloneDDS>"
)
_PACKAGES = {"ros2": "cyclonedds", "zenoh": "zenoh", "ros1": "rosbags"}
_NUMBERS = itertools.count(30)


@dataclass(frozen=True)
class Network:
    """How to record from a network, and how to start a robot on it."""

    options: Sequence[str]  # of ``tooltip record``
    robot: Sequence[str]  # a command that lacks KIND WIDTH HEIGHT FPS JOINT_HZ SECONDS
    environment: dict[str, str] = field(default_factory=dict)

    def start(self, *arguments: object) -> subprocess.Popen[str]:
        """Start a robot; it prints how many images and joints it has sent."""
        process = subprocess.Popen(
            [*self.robot, *map(str, arguments)],
            cwd=ROOT,
            env={**os.environ, **self.environment},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert process.stdin is not None
        process.stdin.write(URDF)
        process.stdin.close()
        process.stdin = None
        return process


def network_at(transport: str, place: str) -> Network:
    """Return the network of a DDS domain, or where a Zenoh router or a ROS 1 master runs."""
    if transport == "ros1":
        robot = [SYSTEM_PYTHON, "tests/helpers/ros1_robot.py"]
        return Network(["--master", place], robot, ros1_environment(place))
    option = "--router" if transport == "zenoh" else "--domain"
    return Network(
        [option, place], [sys.executable, "-m", f"tests.helpers.{transport}_robot", place]
    )


@contextlib.contextmanager
def network(transport: str, domain: int = 77) -> Iterator[Network]:
    """Provide one of :data:`TRANSPORTS`; Zenoh's router and ROS 1's master run meanwhile.

    ``fastdds`` is ``ros2`` with a robot that uses another DDS than the recorder.
    """
    if transport == "zenoh":
        router = Router()
        yield network_at(transport, router.address)
        router.stop()
    elif transport == "ros1":
        with ros1_master() as (uri, _):
            yield network_at(transport, uri)
    else:
        yield network_at(transport, str(domain))


class Router:
    """A Zenoh router that can go away and come back under the same address."""

    def __init__(self) -> None:
        self.address = f"tcp/127.0.0.1:{free_port()}"
        self.start()

    def start(self) -> None:
        """Start it, and wait until it listens."""
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.helpers.zenoh_robot", self.address],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == "ready\n"

    def stop(self) -> None:
        """Kill it."""
        self.process.kill()
        self.process.communicate()


def can_use(transport: str) -> bool:
    """Return whether what a recorder and a robot need on a network is installed."""
    installed = importlib.util.find_spec(_PACKAGES[transport]) is not None
    return installed and (transport != "ros1" or has_ros1())


def own_domain(worker_id: str) -> int:
    """Return a DDS domain for one test alone, which no other one's publishers are heard in."""
    worker = int(worker_id.removeprefix("gw")) if worker_id != "master" else 8
    return 20 * (worker % 9) + next(_NUMBERS)


def on_the_wire(payload: bytes) -> bytes:
    """Return CDR bytes as DDS sends them, in whole words."""
    return payload + bytes(-len(payload) % 4)


def image_of(
    transport: str, kind: str, width: int, height: int, fps: float
) -> Callable[[int], bytes]:
    """Return what gives the stored bytes of a robot's image with a number."""
    if transport != "ros1":
        from tests.helpers.ros2_robot import image_payload

        made = [image_payload(kind, width, height, number) for number in range(30)]
        if transport != "zenoh":
            made = [on_the_wire(payload) for payload in made]
        return lambda number: made[number % len(made)]
    count = ros1_robot.PICTURES
    pictures = [ros1_robot.picture(kind, width, height, number) for number in range(count)]

    def converted(number: int) -> bytes:
        stamp_ns, data = ros1_robot.stamp_ns(fps, number), pictures[number % count]
        if kind == "jpeg":
            return messages.compressed_image(stamp_ns, CAMERA_FRAME, "jpeg", data)
        fields = {"height": height, "width": width, "encoding": "bgr8", "step": 3 * width}
        header = messages.header(stamp_ns, CAMERA_FRAME)
        return messages.encode(messages.IMAGE, {"header": header, **fields, "data": data})

    return converted


def joint_of(transport: str, hz: float, number: int) -> bytes:
    """Return the stored bytes of a robot's joint state with a number."""
    if transport == "ros1":
        header = messages.header(ros1_robot.stamp_ns(hz, number), CAMERA_FRAME)
        fields = {"name": list(JOINTS), "position": list(ros1_robot.angles(number))}
        return messages.encode(messages.JOINT_STATE, {"header": header, **fields})
    from tests.helpers.ros2_robot import joint_payload

    payload = joint_payload(number)
    return payload if transport == "zenoh" else on_the_wire(payload)


@functools.cache
def has_ros1() -> bool:
    """Return whether a master and rospy are installed."""
    if shutil.which("rosmaster") is None or not Path(SYSTEM_PYTHON).exists():
        return False
    command = [SYSTEM_PYTHON, "-c", "import rospy, sensor_msgs.msg"]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


@contextlib.contextmanager
def ros1_master() -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Provide a ROS 1 master: its address, and its process."""
    port = free_port()
    uri = f"http://127.0.0.1:{port}"
    environment = {**os.environ, **ros1_environment(uri)}
    process = subprocess.Popen(
        ["rosmaster", "--core", "-p", str(port)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=environment,
    )

    def answers() -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", port)) == 0

    wait_for(answers, "a master")
    yield uri, process
    process.terminate()
    process.wait(30)


def ros1_environment(uri: str) -> dict[str, str]:
    """Return what a node needs to find a master on this machine."""
    logs = {"ROS_LOG_DIR": str(Path(tempfile.gettempdir()) / "tooltip-ros1-logs")}
    return {"ROS_MASTER_URI": uri, "ROS_IP": "127.0.0.1", **logs}
