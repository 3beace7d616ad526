"""A ROS 1 robot: a node of rospy, which runs with the system's own Python (Debian's python3-rospy).

/usr/bin/python3 tests/helpers/ros1_robot.py KIND WIDTH HEIGHT FPS JOINT_HZ SECONDS < robot.urdf
"""

from __future__ import annotations

import importlib.util
import random
import sys
import time
from pathlib import Path
from typing import Any

IMAGE, RAW, INFO = "/camera/image/compressed", "/camera/image_raw", "/camera/camera_info"
STATES, DESCRIPTION = "/joint_states", "/robot_description"
FRAME, NAMES = "camera_optical_frame", ("wrist_pitch", "wrist_roll")
START_S = 1_700_000_000
PICTURES = 30
_MATCHED_S = 30.0


def picture(kind: str, width: int, height: int, number: int) -> bytes:
    """Return the data of an image; each number has other ones."""
    made = random.Random(number)
    if kind == "jpeg":
        return b"\xff\xd8\xff" + made.randbytes(width * height // 8) + b"\xff\xd9"
    return made.randbytes(3 * width * height)


def stamp_ns(hz: float, number: int) -> int:
    """Return the stamp of a message with a running number."""
    return START_S * 10**9 + round(number / hz * 1e9)


def angles(number: int) -> tuple[float, float]:
    """Return the joints' positions, rad."""
    return 0.001 * number, -0.5


def pacing() -> Any:
    """Return tests.helpers.pacing, without the packages that its neighbours need."""
    spec = importlib.util.spec_from_file_location("pacing", Path(__file__).with_name("pacing.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def play(path: str) -> None:
    """Publish the messages of a file, which are ROS 1's; see tests.helpers.pacing."""
    import rospy
    import sensor_msgs.msg

    rospy.init_node("robot", disable_signals=True)

    def sender(name: str, datatype: str) -> Any:
        made = getattr(sensor_msgs.msg, datatype.rsplit("/", 1)[1])
        kind = type(made.__name__, (made,), {"serialize": lambda self, out: out.write(self.raw)})
        publisher = rospy.Publisher(name, kind, queue_size=1000)

        def send(data: bytes) -> None:
            message = kind()
            message.raw = data
            publisher.publish(message)

        return send

    pacing().play_file(path, sender)
    rospy.signal_shutdown("done")


def main(kind: str, width: int, height: int, fps: float, hz: float, seconds: float) -> None:
    import rospy
    from sensor_msgs.msg import (
        CameraInfo,
        CompressedImage,
        Image,
        JointState,
    )

    rospy.init_node("robot", disable_signals=True)
    rospy.set_param(DESCRIPTION, sys.stdin.read())
    images = (
        rospy.Publisher(IMAGE, CompressedImage, queue_size=100)
        if kind == "jpeg"
        else rospy.Publisher(RAW, Image, queue_size=100)
    )
    infos = rospy.Publisher(INFO, CameraInfo, queue_size=1, latch=True)
    states = rospy.Publisher(STATES, JointState, queue_size=1000)
    info = CameraInfo(width=width, height=height, distortion_model="plumb_bob")
    info.D, info.K = [0.0] * 5, [140.0, 0.0, 79.5, 0.0, 141.0, 59.5, 0.0, 0.0, 1.0]
    info.header.frame_id = FRAME
    infos.publish(info)
    pictures = [picture(kind, width, height, number) for number in range(PICTURES)]

    def at(message: Any, rate: float, number: int) -> Any:
        whole, rest = divmod(stamp_ns(rate, number), 10**9)
        message.header.stamp, message.header.frame_id = rospy.Time(whole, rest), FRAME
        return message

    def image(number: int) -> None:
        data = pictures[number % PICTURES]
        if kind == "jpeg":
            message = CompressedImage(format="jpeg", data=data)
        else:
            message = Image(height=height, width=width, encoding="bgr8", data=data)
            message.step = 3 * width
        images.publish(at(message, fps, number))

    def joint(number: int) -> None:
        states.publish(at(JointState(name=NAMES, position=angles(number)), hz, number))

    end = time.monotonic() + _MATCHED_S
    while not (images.get_num_connections() and states.get_num_connections()):
        if time.monotonic() > end:
            raise SystemExit("nobody listens")
        time.sleep(0.01)
    time.sleep(0.5)
    print(*pacing().pace(fps, hz, seconds, image, joint), flush=True)
    time.sleep(1.0)
    rospy.signal_shutdown("done")


if __name__ == "__main__":
    if sys.argv[1] == "play":
        play(sys.argv[2])
    else:
        kind, width, height, fps, hz, seconds = sys.argv[1:]
        main(kind, int(width), int(height), float(fps), float(hz), float(seconds))
