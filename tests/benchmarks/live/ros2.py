"""Publish over DDS from one process, record in another: what arrives, at what cost.

python -m tests.benchmarks.live.ros2 jpeg 640 480 30 500 60
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.helpers import ros2_robot
from tooltip_cli.log.container import LoggedMessage, iterate

DOMAIN = "77"


def main(kind: str, width: str, height: str, fps: str, hz: str, seconds: str) -> None:
    out = Path(tempfile.mkdtemp()) / "out.mcap"
    topic = ros2_robot.IMAGE if kind == "jpeg" else ros2_robot.RAW
    robot = [sys.executable, "-m", "tests.helpers.ros2_robot", DOMAIN, kind, width, height]
    record = [sys.executable, "-m", "tooltip_cli.cli.main", "record", "ros2", str(out)]
    record += ["--domain", DOMAIN, "--image", topic, "--joints", ros2_robot.STATES]
    listener = subprocess.Popen([*record, "--patience", "15"])
    start = time.monotonic()
    done = subprocess.run([*robot, fps, hz, seconds], stdout=subprocess.PIPE, text=True, check=True)
    listener.terminate()
    _, _, usage = os.wait4(listener.pid, 0)
    images, joints = map(int, done.stdout.split())
    expected = [pad(ros2_robot.image_payload(kind, int(width), int(height), i)) for i in range(30)]
    found: dict[str, list[bytes]] = {topic: [], ros2_robot.STATES: []}
    for item in iterate(out):
        if isinstance(item, LoggedMessage) and item.topic in found:
            found[item.topic].append(item.payload)
    same = sum(data in expected for data in found[topic])
    print(f"images {len(found[topic])} of {images}, {same} byte for byte")
    print(f"joints {len(found[ros2_robot.STATES])} of {joints}")
    used = usage.ru_utime + usage.ru_stime
    print(
        f"processor {used:.1f} s in {time.monotonic() - start:.0f} s, "
        f"{used / float(seconds):.2f} of a core; memory {usage.ru_maxrss / 1024:.0f} MiB"
    )
    out.unlink()


def pad(payload: bytes) -> bytes:
    """Return CDR bytes as they are sent, in whole words."""
    return payload + bytes(-len(payload) % 4)


if __name__ == "__main__":
    main(*sys.argv[1:])
