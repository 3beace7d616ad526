"""Robots on each network that is recorded from, with what they need: a router, a master."""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tests.helpers.live import free_port
from tests.helpers.recorder import ROOT, wait_for
from tests.helpers.robot import URDF

SYSTEM_PYTHON = "/usr/bin/python3"
TRANSPORTS = ("ros2", "zenoh", "ros1")


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


@contextlib.contextmanager
def network(transport: str, domain: int = 77) -> Iterator[Network]:
    """Provide one of :data:`TRANSPORTS`; Zenoh's router and ROS 1's master run meanwhile.

    ``fastdds`` is ``ros2`` with a robot that uses another DDS than the recorder.
    """
    module = [sys.executable, "-m", f"tests.helpers.{transport}_robot"]
    if transport in ("ros2", "fastdds"):
        yield Network(["--domain", str(domain)], [*module, str(domain)])
    elif transport == "zenoh":
        router = Router()
        yield Network(["--router", router.address], [*module, router.address])
        router.stop()
    else:
        with ros1_master() as (uri, process):
            robot = [SYSTEM_PYTHON, "tests/helpers/ros1_robot.py"]
            yield Network(["--master", uri], robot, ros1_environment(uri))
            process.terminate()


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
