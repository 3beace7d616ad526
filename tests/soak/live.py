"""Half an hour of ``tooltip record`` from a robot that goes away and comes back every two minutes.

The recorder's memory must stay flat within 5 %, and the log must hold what was sent.

    python -m tests.soak.live [camera|ros2|zenoh|ros1] [--minutes 30]
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from tests.helpers.live import free_port
from tests.helpers.robot import RIG
from tests.helpers.robots import TRANSPORTS, Network, network
from tests.helpers.ros2_robot import IMAGE, STATES
from tooltip_cli.log import messages
from tooltip_cli.log.container import LoggedMessage, iterate
from tooltip_cli.stages.calibrate import write_rig

PATHS = ("camera", *TRANSPORTS)
FPS, JOINT_HZ = 30, 100
ALLOWED = 0.05  # of the memory after the first tenth
LOST_IMAGES = 0.002  # of those sent: what was on its way when the robot went
_SESSION_S = 120.0
_AWAY_S = 3.0
_EVERY_S = 1.0


@contextlib.contextmanager
def joined(path: str) -> Iterator[tuple[Sequence[str], Callable[[float], subprocess.Popen[str]]]]:
    """Provide the recorder's options, and what starts a robot for some seconds."""
    if path == "camera":
        http, udp = str(free_port()), str(free_port(socket.SOCK_DGRAM))
        robot = Network([], [sys.executable, "-m", "tests.helpers.camera_robot", http, udp])
        options = ["--camera", f"http://127.0.0.1:{http}/", "--joints", f"udp://127.0.0.1:{udp}"]
        yield options, lambda seconds: robot.start(FPS, JOINT_HZ, seconds)
        return
    with network(path, 78) as joined:
        names = ["--image", IMAGE, "--joints", STATES]
        yield (
            [*joined.options, *names],
            lambda seconds: joined.start("jpeg", 640, 480, FPS, JOINT_HZ, seconds),
        )


def main() -> None:
    """Print one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("path", nargs="?", choices=PATHS, default="camera")
    parser.add_argument("--minutes", type=float, default=30.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name, joined(options.path) as (chosen, start):
        folder = Path(name)
        out = folder / "out.mcap"
        command = [sys.executable, "-m", "tooltip_cli.cli.main", "record", options.path, str(out)]
        command += [*chosen, "--rig", str(write_rig(RIG, folder)), "--reconnect"]
        recorder = subprocess.Popen(command, stderr=subprocess.PIPE)
        sent, memory = Counter[str](), list[int]()
        end = time.monotonic() + 60 * options.minutes
        while time.monotonic() < end:
            seconds = min(_SESSION_S, max(end - time.monotonic(), 1.0))
            sent += session(start(seconds), recorder.pid, memory)
            time.sleep(_AWAY_S)
        recorder.send_signal(signal.SIGTERM)  # SIGINT may be ignored, under nohup
        errors = recorder.stderr.read().decode() if recorder.stderr is not None else ""
        _, status, used = os.wait4(recorder.pid, 0)
        kept = Counter(item.datatype for item in iterate(out) if isinstance(item, LoggedMessage))
        size = out.stat().st_size
    report(sent, memory, kept, used.ru_utime + used.ru_stime, size)
    assert os.waitstatus_to_exitcode(status) == 0, errors
    assert "again after" in errors, errors


def session(process: subprocess.Popen[str], recorder: int, memory: list[int]) -> Counter[str]:
    """Let a robot send for its time; return how many images and joints it sent."""
    while process.poll() is None:
        memory.append(private_bytes(recorder))
        time.sleep(_EVERY_S)
    assert process.stdout is not None
    images, joints = map(int, process.stdout.read().split())
    return Counter({messages.COMPRESSED_IMAGE: images, messages.JOINT_STATE: joints})


def private_bytes(process: int) -> int:
    """Return the memory of a process that no file stands behind."""
    for line in Path(f"/proc/{process}/status").read_text().splitlines():
        if line.startswith("RssAnon:"):
            return 1024 * int(line.split()[1])
    raise SystemExit(f"process {process} has ended")


def report(
    sent: Counter[str], memory: list[int], kept: Counter[str], used_s: float, size: int
) -> None:
    """Print the figures and hold the promises."""
    tenth = max(len(memory) // 10, 1)
    early = statistics.median(memory[tenth : 2 * tenth])
    late = statistics.median(memory[-tenth:])
    images, joints = messages.COMPRESSED_IMAGE, messages.JOINT_STATE
    summary = {
        "images_sent": sent[images],
        "images_kept": kept[images],
        "joints_sent": sent[joints],
        "joints_kept": kept[joints],
        "memory_early_mb": round(early / 1e6, 1),
        "memory_late_mb": round(late / 1e6, 1),
        "memory_max_mb": round(max(memory) / 1e6, 1),
        "memory_by_minute_mb": [round(size / 1e6, 1) for size in memory[::60]],
        "growth": round(late / early - 1, 4),
        "processor_s": round(used_s, 1),
        "log_mb": round(size / 1e6),
    }
    print(json.dumps(summary), flush=True)
    assert late < early * (1 + ALLOWED)
    assert kept[images] >= sent[images] * (1 - LOST_IMAGES)


if __name__ == "__main__":
    main()
