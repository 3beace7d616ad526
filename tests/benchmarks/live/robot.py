"""Publish from one process, record in another: what arrives, and at what cost.

python -m tests.benchmarks.live.robot ros2|fastdds|zenoh|ros1 jpeg|raw 640 480 30 500 60
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from tests.helpers import ros1_robot, ros2_robot
from tests.helpers.recorder import by_topic
from tests.helpers.robot import CAMERA_FRAME
from tests.helpers.robots import network
from tooltip_cli.log import messages


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


def image_of(
    transport: str, kind: str, width: int, height: int, fps: float
) -> Callable[[int], bytes]:
    """Return what gives the CDR bytes of the image with a number."""
    if transport != "ros1":
        made = [ros2_robot.image_payload(kind, width, height, i) for i in range(30)]
        padded = [data + bytes(-len(data) % 4) for data in made]  # DDS sends whole words
        return lambda number: (padded if transport in ("ros2", "fastdds") else made)[number % 30]
    count = ros1_robot.PICTURES
    pictures = [ros1_robot.picture(kind, width, height, i) for i in range(count)]

    def converted(number: int) -> bytes:
        stamp_ns, data = ros1_robot.stamp_ns(fps, number), pictures[number % count]
        if kind == "jpeg":
            return messages.compressed_image(stamp_ns, CAMERA_FRAME, "jpeg", data)
        fields = {"height": height, "width": width, "encoding": "bgr8", "step": 3 * width}
        header = messages.header(stamp_ns, CAMERA_FRAME)
        return messages.encode(messages.IMAGE, {"header": header, **fields, "data": data})

    return converted


if __name__ == "__main__":
    main(*sys.argv[1:])
