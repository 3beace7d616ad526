"""Publish from one process, record in another: what arrives, and at what cost.

python -m tests.benchmarks.live.robot ros2|fastdds|zenoh|ros1 jpeg|raw 640 480 30 500 60
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.helpers import ros2_robot
from tests.helpers.recorder import by_topic
from tests.helpers.robots import image_of, network


def main(transport: str, kind: str, width: str, height: str, fps: str, hz: str, s: str) -> None:
    out = Path(tempfile.mkdtemp()) / "out.mcap"
    topic = ros2_robot.IMAGE if kind == "jpeg" else ros2_robot.RAW
    names = ["--image", topic, "--joints", ros2_robot.STATES, "--patience", "15"]
    with network(transport) as joined:
        kind_of_recording = "ros2" if transport == "fastdds" else transport
        command = [sys.executable, "-m", "tooltip_cli.cli.main", "record", kind_of_recording, out]
        listener = subprocess.Popen([*map(str, command), *joined.options, *names])
        robot = joined.start(kind, width, height, fps, hz, s)
        start = time.monotonic()
        images, joints = map(int, robot.communicate()[0].split())
        listener.terminate()
        _, _, usage = os.wait4(listener.pid, 0)
    expected = image_of(transport, kind, int(width), int(height), float(fps))
    found = by_topic(out)
    same = sum(m.payload == expected(i) for i, m in enumerate(found[topic]))
    print(f"images {len(found[topic])} of {images}, {same} byte for byte in their order")
    print(f"joints {len(found[ros2_robot.STATES])} of {joints}")
    used = usage.ru_utime + usage.ru_stime
    print(
        f"processor {used:.1f} s in {time.monotonic() - start:.0f} s, "
        f"{used / float(s):.2f} of a core; memory {usage.ru_maxrss / 1024:.0f} MiB"
    )
    out.unlink()


if __name__ == "__main__":
    main(*sys.argv[1:])
