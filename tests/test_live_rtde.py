"""Joints of a UR robot: a controller's stand-in that sends by RTDE."""

from __future__ import annotations

import itertools
import signal
import socket
import threading
import time
from pathlib import Path

import pytest

from tests.helpers.live import MjpegServer
from tests.helpers.logs import jpeg_of
from tests.helpers.recorder import by_topic, ended, recorder, wait_for
from tests.helpers.ur_robot import UrRobot
from tooltip_cli.errors import TooltipError
from tooltip_cli.log.messages import decode
from tooltip_cli.sources.joints import joint_samples

NAMES = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)


def angles(time_s: float) -> tuple[float, ...]:
    return 0.1 * time_s, -1.0, 1.5, -0.5, 0.25, 3.0


def test_the_arm_is_recorded_beside_a_camera(tmp_path: Path) -> None:
    out, server = tmp_path / "out.mcap", MjpegServer()
    with UrRobot(angles) as robot:
        listener = recorder("camera", out, "--camera", server.url, "--joints", robot.spec)
        assert server.connected.wait(30)
        wait_for(lambda: robot.sent > 0, "a client")
        before = robot.sent
        server.show(jpeg_of(0))
        time.sleep(1.0)
        sent = robot.sent - before
        ended(listener, signal.SIGINT)
    server.close()
    states = [decode(m.datatype, m.payload) for m in by_topic(out)["/joint_states"]]
    assert len(states) >= sent > 20
    assert {tuple(state.name) for state in states} == {NAMES}
    assert {tuple(state.position)[1:] for state in states} == {angles(0)[1:]}
    first = [state.position[0] for state in states]
    assert first == sorted(set(first))


def test_an_arm_that_goes_away_is_an_error_of_a_line() -> None:
    with UrRobot(angles) as robot:
        samples = joint_samples(robot.spec)(threading.Event())
        assert len(list(itertools.islice(samples, 3))) == 3
    with pytest.raises(TooltipError, match=f"{robot.spec}: was lost"):
        list(samples)
    with pytest.raises(TooltipError, match="cannot be reached"):
        list(joint_samples(robot.spec)(threading.Event()))


@pytest.mark.parametrize(
    ("answers", "said"),
    [
        (b"\x00\x04V\x00", "does not speak version 2 of RTDE"),
        (b"HTTP/1.1 400 Bad Request\r\n\r\n" * 1000, "was lost"),
        (b"\x00\x01V", "does not speak RTDE"),
        (b"\x00\x04V\x01\x00\x13v" + bytes(16) + b"\x00\x0dO\x01NOT_FOUND", "does not offer"),
        (b"\x00\x04V\x01\x00\x13v" + bytes(16) + b"\x00\x0cO\x01VECTOR6D\x00\x04S\x00", "start"),
        (b"", "was lost"),
    ],
)
def test_nonsense_is_told_in_a_line(answers: bytes, said: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def answer() -> None:
            with listener.accept()[0] as connection:
                connection.sendall(answers)
                connection.shutdown(socket.SHUT_WR)
                connection.settimeout(10)
                while connection.recv(1000):
                    pass

        threading.Thread(target=answer, daemon=True).start()
        spec = f"rtde://127.0.0.1:{listener.getsockname()[1]}"
        with pytest.raises(TooltipError, match=said):
            list(joint_samples(spec)(threading.Event()))


def test_the_end_of_a_recording_does_not_wait_for_a_silent_controller() -> None:
    halt = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as listener:
        spec = f"rtde://127.0.0.1:{listener.getsockname()[1]}"
        threading.Timer(0.3, halt.set).start()
        assert list(joint_samples(spec)(halt)) == []
    with pytest.raises(TooltipError, match="no robot; expected"):
        joint_samples("rtde://")
