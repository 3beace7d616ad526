"""A ROS 2 robot whose DDS is Fast DDS, the default of ROS 2 (Debian's libfastrtps-dev and g++).

python -m tests.helpers.fastdds_robot DOMAIN KIND WIDTH HEIGHT FPS JOINT_HZ SECONDS
"""

from __future__ import annotations

import functools
import hashlib
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.helpers.pacing import pace
from tests.helpers.robot import CAMERA, CAMERA_FRAME, URDF
from tests.helpers.ros2_robot import (
    IMAGE,
    INFO,
    RAW,
    ROBOT,
    START_NS,
    STATES,
    image_payload,
    joint_payload,
)
from tooltip_cli.log import messages
from tooltip_cli.sources.dds import dds_type_name

_SOURCE = Path(__file__).with_suffix(".cpp")
_HEADER = Path("/usr/include/fastdds/dds/publisher/DataWriter.hpp")


def has_fastdds() -> bool:
    """Return whether the robot can be compiled."""
    return shutil.which("g++") is not None and _HEADER.exists()


@functools.cache
def program() -> Path:
    """Return the compiled publisher."""
    key = hashlib.sha256(_SOURCE.read_bytes()).hexdigest()[:16]
    built = Path(tempfile.gettempdir()) / f"tooltip-fastdds-{key}"
    if not built.exists():
        making = Path(tempfile.mkdtemp()) / built.name
        libraries = ("-lfastrtps", "-lfastcdr", "-pthread")
        command = ["g++", "-O1", "-std=c++17", str(_SOURCE), "-o", str(making), *libraries]
        subprocess.run(command, check=True)
        shutil.move(making, built)
    return built


def main(domain: str, kind: str, width: int, height: int, fps: float, hz: float, s: float) -> None:
    process = subprocess.Popen(
        [program(), domain], stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0
    )
    assert process.stdin is not None
    assert process.stdout is not None
    pipe, answers = process.stdin, process.stdout

    def send(topic: str, datatype: str, qos: str, payload: bytes) -> None:
        head = f"rt{topic} {dds_type_name(datatype)} {qos} {len(payload)}\n"
        data = memoryview(head.encode() + payload)
        while data:  # a pipe takes a part
            data = data[pipe.write(data) :]

    best_effort, reliable, latched = "0 0", "1 0", "1 1"
    topic, datatype = (
        (IMAGE, messages.COMPRESSED_IMAGE) if kind == "jpeg" else (RAW, messages.IMAGE)
    )
    payloads = [image_payload(kind, width, height, number) for number in range(30)]
    send(topic, datatype, best_effort, b"")
    send(STATES, messages.JOINT_STATE, reliable, b"")
    pipe.write(b"?\n")
    answers.readline()
    send(ROBOT, messages.STRING, latched, messages.string(URDF))
    time.sleep(0.5)  # the other side knows of the match a little later

    def image(number: int) -> None:
        info = messages.camera_info(START_NS + number * 10**7, CAMERA_FRAME, CAMERA)
        send(INFO, messages.CAMERA_INFO, best_effort, info)
        send(topic, datatype, best_effort, payloads[number % len(payloads)])

    def joint(number: int) -> None:
        send(STATES, messages.JOINT_STATE, reliable, joint_payload(number))

    print(*pace(fps, hz, s, image, joint), flush=True)
    pipe.close()
    process.wait(30)


if __name__ == "__main__":
    domain, kind, width, height, fps, hz, seconds = sys.argv[1:]
    main(domain, kind, int(width), int(height), float(fps), float(hz), float(seconds))
