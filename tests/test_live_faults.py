"""What goes wrong while a robot is recorded: told in a line, and the log keeps the rest."""

from __future__ import annotations

import contextlib
import itertools
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.live import MjpegServer, free_port, joint_line, udp_joints
from tests.helpers.logs import IMAGE_TOPIC, JOINT_TOPIC, image_message, joint_message, jpeg_of
from tests.helpers.recorder import ROOT, by_topic, ended, interruptible, recorder, wait_for
from tests.helpers.robot import JOINTS, RIG
from tests.helpers.robots import SYSTEM_PYTHON, TRANSPORTS, can_use, ros1_environment
from tests.helpers.ros2_robot import IMAGE, STATES
from tests.test_live_recording import Robot
from tooltip_cli.log import messages
from tooltip_cli.log.crashsafe import CrashSafeWriter
from tooltip_cli.log.messages import Message, decode, ns_from_time
from tooltip_cli.log.stopping import Stop
from tooltip_cli.sources.live import Deliver
from tooltip_cli.stages.calibrate import write_rig
from tooltip_cli.stages.live import LiveOptions, record_live

CUT_S = 5.0
_HERE, _THERE = "10.213.77.1", "10.213.77.2"


def can_cut() -> bool:
    """Return whether networks of our own can be made: as root, on Linux, with ``ip``."""
    if shutil.which("ip") is None or not hasattr(os, "geteuid") or os.geteuid() != 0:
        return False
    name = f"tooltip-probe-{os.getpid()}"
    made = subprocess.run(["ip", "netns", "add", name], capture_output=True, check=False)
    subprocess.run(["ip", "netns", "del", name], capture_output=True, check=False)
    return made.returncode == 0


class Cable:
    """Two networks of one machine each, and the cable between them."""

    def __init__(self) -> None:
        self.here, self.there = (f"tooltip-{side}-{os.getpid()}" for side in "ab")

    def __enter__(self) -> Cable:
        for side in (self.here, self.there):
            ip("netns", "add", side)
            ip("-n", side, "link", "set", "lo", "up")
        ip(
            "-n",
            self.here,
            "link",
            "add",
            "eth0",
            "type",
            "veth",
            "peer",
            "eth0",
            "netns",
            self.there,
        )
        for side, address in ((self.here, _HERE), (self.there, _THERE)):
            ip("-n", side, "address", "add", f"{address}/24", "dev", "eth0")
            ip("-n", side, "link", "set", "eth0", "up")
        return self

    def __exit__(self, *error: object) -> None:
        for side in (self.here, self.there):
            ip("netns", "del", side)

    def plug(self, state: str) -> None:
        """Pull it (``down``) or put it back (``up``)."""
        ip("-n", self.there, "link", "set", "eth0", state)

    def start(
        self, side: str, command: list[str], environment: dict[str, str], **pipes: int
    ) -> subprocess.Popen[str]:
        """Start a program on one of the sides."""
        process: subprocess.Popen[str] = subprocess.Popen(
            ["ip", "netns", "exec", side, *command],
            cwd=ROOT,
            env={**os.environ, **environment},
            text=True,
            preexec_fn=interruptible,  # noqa: PLW1509 - nothing else happens in between
            **pipes,  # type: ignore[call-overload]
        )
        return process


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


ROBOT = ("jpeg", "320", "240", "30", "100", "11")


@contextlib.contextmanager
def robot_over(cable: Cable, transport: str) -> Iterator[tuple[list[str], subprocess.Popen[str]]]:
    """Provide the recorder's options, and a robot at the cable's other end that sends for 11 s."""
    module = [sys.executable, "-m", f"tests.helpers.{transport}_robot"]
    environment, around = dict[str, str](), list[subprocess.Popen[str]]()
    if transport == "ros2":
        options, command = ["--domain", "9"], [*module, "9"]
        environment["CYCLONEDDS_URI"] = (
            "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='eth0'/></Interfaces>"
            "</General></Domain></CycloneDDS>"
        )
    elif transport == "zenoh":
        options = ["--router", f"tcp/{_THERE}:7447"]
        command = [*module, f"tcp/{_THERE}:7447"]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        around.append(cable.start(cable.there, [*module, "tcp/0.0.0.0:7447"], {}, **pipes))
        assert around[0].stdout is not None
        assert around[0].stdout.readline() == "ready\n"
    else:
        options = ["--master", f"http://{_THERE}:11311"]
        environment = {**ros1_environment(f"http://{_THERE}:11311"), "ROS_IP": _THERE}
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        master = ["rosmaster", "--core", "-p", "11311"]
        around.append(cable.start(cable.there, master, environment, **quiet))
        command = [SYSTEM_PYTHON, "tests/helpers/ros1_robot.py"]
        time.sleep(2)  # until the master answers; nothing can be asked from this side
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE}
    robot = cable.start(cable.there, [*command, *ROBOT], environment, **pipes)
    try:
        yield options, robot
    finally:
        for process in (robot, *around):
            process.kill()
            process.communicate()


@pytest.mark.skipif(not can_cut(), reason="needs root, and Linux' network namespaces")
@pytest.mark.parametrize("transport", TRANSPORTS)
def test_a_network_that_is_cut_for_five_seconds(transport: str, tmp_path: Path) -> None:
    if not can_use(transport):
        pytest.skip(f"what 'record {transport}' and its robot need is not installed")
    out = tmp_path / "out.mcap"
    with Cable() as cable, robot_over(cable, transport) as (options, robot):
        names = ["--image", IMAGE, "--joints", STATES, "--reconnect"]
        command = [sys.executable, "-m", "tooltip_cli.cli.main", "record", transport, str(out)]
        environment = {"CYCLONEDDS_URI": "<CycloneDDS><Domain/></CycloneDDS>"}
        listener = cable.start(
            cable.here, [*command, *options, *names], environment, stderr=subprocess.PIPE
        )
        unfinished = out.with_name("out.mcap.unfinished")
        wait_for(lambda: unfinished.exists() and unfinished.stat().st_size > 100_000, "a recording")
        cable.plug("down")
        time.sleep(CUT_S)
        cable.plug("up")
        sent, _ = robot.communicate(timeout=60)
        time.sleep(1)
        listener.send_signal(signal.SIGINT)
        _, err = listener.communicate(timeout=60)
    assert listener.returncode == 0, err
    found = by_topic(out)
    images, joints = map(int, sent.split())
    arrivals = [m.log_time_ns for m in found[IMAGE]]
    before_and_after = (11 - CUT_S) / 11
    assert images * before_and_after * 0.7 < len(arrivals) <= images
    assert joints * before_and_after * 0.7 < len(found[STATES]) <= joints
    assert max(b - a for a, b in itertools.pairwise(arrivals)) > 4e9
    assert f"nothing on {IMAGE} any more" in err
    assert f"{IMAGE} is heard again after" in err


def test_a_clock_that_is_set_back_is_recorded_as_it_was(tmp_path: Path) -> None:
    out, server, port = tmp_path / "out.mcap", MjpegServer(), free_port()
    sources = ("--camera", server.url, "--joints", f"udp://127.0.0.1:{port}")
    listener = recorder("camera", out, *sources)
    assert server.connected.wait(30)
    stamps = []
    with udp_joints(port) as send:
        for i in range(60):
            server.show(jpeg_of(i))
            stamps.append(time.time_ns() - (2 * 10**9 if i >= 30 else 0))
            send(joint_line({JOINTS[0]: 0.01 * i, JOINTS[1]: 0.0}, stamps[-1]))
            time.sleep(0.02)
    time.sleep(0.5)
    err = ended(listener, signal.SIGINT)
    server.close()
    found = by_topic(out)
    states = found["/joint_states"]
    kept = [ns_from_time(decode(m.datatype, m.payload).header.stamp) for m in states]
    assert kept == stamps
    arrivals = [m.log_time_ns for m in states]
    assert arrivals == sorted(arrivals)
    assert len(found["/camera/image/compressed"]) == 60
    assert "stamps on /joint_states step back by 2.0 s" in err


def test_images_at_twice_the_disks_rate_cost_counted_images_and_no_joints(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rate, size, limit = 200, 50_000, 5_000_000
    write = CrashSafeWriter.write

    def slow(self: CrashSafeWriter, message: Message) -> None:
        if message.topic == IMAGE_TOPIC:
            time.sleep(2 / rate)
        write(self, message)

    monkeypatch.setattr(CrashSafeWriter, "write", slow)
    waiting: list[int] = []

    def run(deliver: Deliver, halt: threading.Event) -> None:
        start = time.monotonic()
        for i in range(3 * rate):
            deliver(image_message(10**18 + i, bytes(size)))
            deliver(joint_message(10**18 + i, ["a"], [0.1]))
            time.sleep(max(start + i / rate - time.monotonic(), 0))

    robot = Robot([run])
    record_live(
        robot,
        tmp_path / "out.mcap",
        LiveOptions(queue_bytes=limit),
        stop=Stop(),
        on_status=lambda status: waiting.append(status.queued_bytes),
    )
    found = by_topic(tmp_path / "out.mcap")
    lost = robot.report.dropped[
        f"messages on {IMAGE_TOPIC} that came faster than they could be written"
    ]
    assert len(found[JOINT_TOPIC]) == 3 * rate
    assert len(found[IMAGE_TOPIC]) + lost == 3 * rate
    assert lost > rate / 2
    assert max(waiting) <= limit


def test_a_message_that_is_not_of_its_topics_type_is_kept_and_told(tmp_path: Path) -> None:
    """Anything may go by the name of JointState; its bytes are stored all the same."""
    pytest.importorskip("zenoh")
    from tests.helpers.robots import Router
    from tests.helpers.zenoh_robot import Publisher, heard, session

    router, out = Router(), tmp_path / "out.mcap"
    peer = session("peer", connect=router.address)
    images = Publisher(peer, IMAGE, messages.COMPRESSED_IMAGE)
    states = Publisher(peer, STATES, messages.JOINT_STATE)
    rig = write_rig(RIG, tmp_path)
    listener = recorder("zenoh", out, "--router", router.address, "--rig", rig)
    wait_for(lambda: heard(images, states), "a subscription to both")
    wrong = b"\x00\x01\x00\x00" + b"\xff" * 40
    for i in range(20):
        images.send(messages.compressed_image(10**18 + i * 10**7, "camera", "jpeg", jpeg_of(i)))
        states.send(wrong)
        time.sleep(0.02)
    time.sleep(0.5)
    err = ended(listener, signal.SIGINT)
    peer.close()
    router.stop()
    assert [m.payload for m in by_topic(out)[STATES]] == [wrong] * 20
    assert f"the motion was not judged: {STATES} carries no sensor_msgs/msg/JointState" in err
