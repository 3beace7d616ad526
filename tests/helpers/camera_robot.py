"""A robot without ROS: a process with an MJPEG server, and joints over UDP, at steady rates.

python -m tests.helpers.camera_robot HTTP_PORT UDP_PORT FPS JOINT_HZ SECONDS
"""

from __future__ import annotations

import sys
import time

import numpy as np

from tests.helpers.live import MjpegServer, joint_line, udp_joints
from tests.helpers.pacing import pace
from tests.helpers.robot import JOINTS

_JPEG_BYTES = 38_000  # as a 640x480 image has
_CONNECTED_S = 30.0


def main(http_port: int, udp_port: int, fps: float, hz: float, seconds: float) -> None:
    server = MjpegServer(port=http_port)
    if not server.connected.wait(_CONNECTED_S):
        raise SystemExit("nobody listens")
    rng = np.random.default_rng(0)
    pictures = [b"\xff\xd8\xff" + rng.bytes(_JPEG_BYTES) + b"\xff\xd9" for _ in range(30)]
    with udp_joints(udp_port) as send:

        def joint(number: int) -> None:
            turned = number / hz
            angles = 0.8 * np.sin(turned), 0.5 * np.sin(0.37 * turned)
            positions = dict(zip(JOINTS, map(float, angles), strict=True))
            send(joint_line(positions, time.time_ns()))

        sent = pace(fps, hz, seconds, lambda i: server.show(pictures[i % len(pictures)]), joint)
    print(*sent, flush=True)
    server.close()
    time.sleep(0.2)  # for the last image to leave


if __name__ == "__main__":
    http, udp, rate, joint_rate, length = sys.argv[1:]
    main(int(http), int(udp), float(rate), float(joint_rate), float(length))
