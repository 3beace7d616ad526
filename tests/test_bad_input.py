"""Whatever is wrong with the input: one line that names it and the remedy, and no half a file."""

from __future__ import annotations

import json
import re
import sqlite3
import zipfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter

from tests.helpers.cli import tooltip
from tests.helpers.logs import (
    IMAGE_TOPIC,
    INFO_TOPIC,
    JOINT_TOPIC,
    POSE_TOPIC,
    START_NS,
    Parts,
    angles,
    encoded,
    image_message,
    image_of,
    info_message,
    joint_message,
    jpeg_of,
    robot_message,
    stamp_of,
    true_pixels,
    wrist_parts,
    write_log,
    write_true_labels,
)
from tests.helpers.robot import CAMERA, JOINTS, RIG, URDF, tip_in_camera
from tooltip_cli.log import messages
from tooltip_cli.log.messages import Message
from tooltip_cli.rig.camera import CameraModel, camera_yaml
from tooltip_cli.rig.kinematics import Mount
from tooltip_cli.rig.rigfile import Rig

FRAMES = 6
Build = Callable[[Path], list[object]]  # makes the input in a folder, returns the arguments


@dataclass(frozen=True)
class Case:
    """One way to go wrong."""

    build: Build
    expected: str  # what the message says


def snapshot(folder: Path) -> dict[str, bytes | None]:
    """Return every file and folder below a folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


# --- files that are no recordings -----------------------------------------------------------------


def file_of(data: bytes, name: str = "a.mcap") -> Build:
    def build(folder: Path) -> list[object]:
        (folder / name).write_bytes(data)
        return [folder / name]

    return build


def folder_named(folder: Path) -> list[object]:
    (folder / "a.mcap").mkdir()
    return [folder / "a.mcap"]


def sqlite_file(folder: Path) -> list[object]:
    with sqlite3.connect(folder / "a.mcap") as base:
        base.execute("create table messages (id integer)")
    return [folder / "a.mcap"]


def zip_file(folder: Path) -> list[object]:
    with zipfile.ZipFile(folder / "a.mcap", "w") as archive:
        archive.writestr("a", "b")
    return [folder / "a.mcap"]


def spoiled(change: Callable[[bytes], bytes]) -> Build:
    def build(folder: Path) -> list[object]:
        path = write_log(folder / "a.mcap", wrist_parts(FRAMES))
        path.write_bytes(change(path.read_bytes()))
        return [path]

    return build


def flipped(share: float, bit: int) -> Callable[[bytes], bytes]:
    def change(data: bytes) -> bytes:
        bad = bytearray(data)
        bad[int(share * (len(data) - 1))] ^= 1 << bit
        return bytes(bad)

    return change


SALVAGE = "'tooltip salvage' recovers what is"
FILES: dict[str, Case] = {
    "missing": Case(lambda folder: [folder / "a.mcap"], "cannot be opened (No such file"),
    "in a missing folder": Case(lambda folder: [folder / "b" / "a.mcap"], "cannot be opened"),
    "name too long": Case(lambda folder: [folder / ("a" * 300)], "cannot be opened"),
    "below a file": Case(
        lambda folder: [*file_of(b"x")(folder), folder / "a.mcap" / "b.mcap"][1:],
        "cannot be opened (Not a directory",
    ),
    "empty": Case(file_of(b""), "is empty; expected an MCAP recording"),
    "folder": Case(folder_named, "is a directory; give the .mcap file in it"),
    "text": Case(file_of(b"hello"), "is not an MCAP file"),
    "one byte": Case(file_of(b"\x89"), "is not an MCAP file"),
    "zeros": Case(file_of(bytes(10_000)), "is not an MCAP file"),
    "jpeg": Case(file_of(jpeg_of(0)), "is not an MCAP file"),
    "labels": Case(file_of(b"stamp_ns,u,v,state,labeler\n"), "is not an MCAP file"),
    "zip": Case(zip_file, "is not an MCAP file"),
    "sqlite": Case(sqlite_file, "import ROS 2 bags with 'tooltip record bag'"),
    "ROS 1 bag": Case(file_of(b"#ROSBAG V2.0\n" + bytes(99)), "'tooltip record bag'"),
    "magic alone": Case(file_of(b"\x89MCAP0\r\n"), SALVAGE),
    "magic twice": Case(file_of(b"\x89MCAP0\r\n" * 2), SALVAGE),
    **{
        f"cut to {percent} %": Case(
            spoiled(lambda data, share=percent: data[: len(data) * share // 100]),  # type: ignore[misc]  # bound now
            SALVAGE,
        )
        for percent in (1, 10, 25, 50, 75, 90, 99)
    },
    "cut by one byte": Case(spoiled(lambda data: data[:-1]), SALVAGE),
    "longer by a byte": Case(spoiled(lambda data: data + b"x"), SALVAGE),
    "joined to itself": Case(spoiled(lambda data: data + data), SALVAGE),
    **{
        f"flipped at {share:.0%}": Case(spoiled(flipped(share, bit)), SALVAGE)
        for bit, share in enumerate((0.05, 0.2, 0.4, 0.6, 0.8, 0.95))
    },
    "middle missing": Case(spoiled(lambda data: data[:3000] + data[4000:]), SALVAGE),
    "middle zeroed": Case(spoiled(lambda data: data[:3000] + bytes(99) + data[3099:]), SALVAGE),
}

# --- recordings that lack something ---------------------------------------------------------------


def log_with(rig: Rig | None = RIG, **parts: Iterable[Message]) -> Build:
    """Return a builder of the wrist's recording with some roles replaced."""

    def build(folder: Path) -> list[object]:
        content: Parts = {**wrist_parts(FRAMES), **{k: list(v) for k, v in parts.items()}}
        return [write_log(folder / "a.mcap", content, rig=rig)]

    return build


def images(*data: bytes) -> list[Message]:
    return [image_message(stamp_of(index), item) for index, item in enumerate(data)]


def raw(stamp_ns: int, **fields: object) -> Message:
    content = {
        "header": messages.header(stamp_ns, "camera_optical_frame"),
        "height": 120,
        "width": 160,
        "step": 160,
        "encoding": "mono8",
        "data": bytes(160 * 120),
        **fields,
    }
    return Message("/raw", messages.IMAGE, stamp_ns, messages.encode(messages.IMAGE, content))


def ros1_log(folder: Path) -> list[object]:
    path = folder / "a.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start("ros1", "test")
        schema = writer.register_schema("sensor_msgs/CompressedImage", "ros1msg", b"x")
        channel = writer.register_channel("/cam", "ros1", schema)
        writer.add_message(channel, 1, b"123", 1)
        writer.finish()  # type: ignore[no-untyped-call]  # the library's own gap
    return [path]


def two_types(folder: Path) -> list[object]:
    path = folder / "a.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start("ros2", "test")
        for datatype in (messages.STRING, messages.JOINT_STATE):
            text = messages.schema_text(datatype).encode()
            channel = writer.register_channel(
                "/x", "cdr", writer.register_schema(datatype, "ros2msg", text)
            )
            writer.add_message(channel, 1, messages.encode(datatype, {}), 1)
        writer.finish()  # type: ignore[no-untyped-call]  # the library's own gap
    return [path]


def cut(message: Message, length: int) -> Message:
    return replace(message, payload=message.payload[:length])


GOOD = [jpeg_of(index) for index in range(FRAMES)]
HALF = encoded(image_of(0)[::2, ::2].copy(), ".png")
STREAMS: dict[str, Case] = {
    "no images": Case(log_with(images=[]), "has no image topic of type sensor_msgs/msg"),
    "nothing at all": Case(
        lambda folder: [write_log(folder / "a.mcap", [])], "it holds: no messages"
    ),
    "ROS 1 messages": Case(ros1_log, "topic /cam is encoded as ros1, not ROS 2 CDR"),
    "two image topics": Case(
        log_with(more=[image_message(START_NS, GOOD[0], "/left")]), "choose one with --image"
    ),
    "named image topic is absent": Case(
        lambda folder: [*log_with()(folder), "--image", "/nowhere"],
        f"on topic /nowhere; found: {IMAGE_TOPIC}",
    ),
    "named topic is of another type": Case(
        lambda folder: [*log_with()(folder), "--image", JOINT_TOPIC],
        f"on topic {JOINT_TOPIC}; found: {IMAGE_TOPIC}",
    ),
    "named joint topic is absent": Case(
        lambda folder: [*log_with()(folder), "--joints", "/nowhere"], "found: /joint_states"
    ),
    "named info topic is absent": Case(
        lambda folder: [*log_with()(folder), "--info", "/nowhere"], f"found: {INFO_TOPIC}"
    ),
    "named pose topic is absent": Case(
        lambda folder: [*log_with()(folder), "--pose", "/nowhere"], "on topic /nowhere"
    ),
    "one image": Case(
        log_with(images=images(GOOD[0])), "holds a single image; detection compares consecutive"
    ),
    "stamps that are all the same": Case(
        log_with(images=[image_message(START_NS + 10**8, data) for data in GOOD]),
        "5 duplicate stamps; the first of each is kept",
    ),
    "first image is no image": Case(
        log_with(images=images(b"hello", *GOOD[1:])), "image 0 (jpeg) cannot be decoded"
    ),
    "last image is no image": Case(
        log_with(images=images(*GOOD[:-1], b"")), "image 5 (jpeg) cannot be decoded"
    ),
    "image is cut": Case(
        log_with(images=images(*GOOD[:2], GOOD[2][:300], *GOOD[3:])), "image 2 (jpeg) cannot be"
    ),
    "image message is cut": Case(
        log_with(images=[*images(*GOOD), cut(images(GOOD[0])[0], 12)]),
        "is not a sensor_msgs/msg/CompressedImage",
    ),
    "image size changes": Case(
        log_with(images=images(*GOOD[:3], HALF, HALF)),
        "the image size changes to 80x60 at image 3; record each resolution on its own",
    ),
    "unknown raw encoding": Case(
        log_with(images=[raw(stamp_of(i), encoding="16UC1") for i in range(3)]),
        "unknown image encoding '16UC1'; known: 8UC1",
    ),
    "raw image too short": Case(
        log_with(images=[raw(stamp_of(i), data=b"123") for i in range(3)]),
        "does not fit its 3 bytes",
    ),
    "raw image of no size": Case(
        log_with(images=[raw(stamp_of(i), height=0) for i in range(3)]), "does not fit"
    ),
    "topic with two types": Case(two_types, "carries both std_msgs/msg/String and sensor_msgs"),
}


# --- rigs, joints and cameras that do not fit -----------------------------------------------------


def rig_file(text: str | bytes, **files: str) -> Build:
    """Return a builder of a good recording with a rig file of this text beside it."""

    def build(folder: Path) -> list[object]:
        (folder / "rig.yaml").write_bytes(text.encode() if isinstance(text, str) else text)
        for name, content in files.items():
            (folder / f"{name}.txt").write_text(content)
        return [*log_with()(folder), "--rig", folder / "rig.yaml"]

    return build


def rig_at(name: str) -> Build:
    return lambda folder: [*log_with()(folder), "--rig", folder / name]


def rig_folder(folder: Path) -> list[object]:
    (folder / "rig.yaml").mkdir()
    return [*log_with()(folder), "--rig", folder / "rig.yaml"]


def constant(names: tuple[str, ...], values: tuple[float, ...], shift_ns: int = 0) -> list[Message]:
    span = range(START_NS + shift_ns, stamp_of(FRAMES) + shift_ns, 10_000_000)
    return [joint_message(stamp, names, values) for stamp in span]


HAND = "hand: {frame: hand}\n"
NAN, INF = float("nan"), float("inf")
POSED = Rig(hand_frame="hand", pose_topic=POSE_TOPIC, mount=Mount("base"))
RIGS: dict[str, Case] = {
    "no rig anywhere": Case(
        log_with(rig=None),
        "carries no rig; name the rig file with --rig",
    ),
    "rig is missing": Case(rig_at("rig.yaml"), "rig.yaml: cannot be read (No such file"),
    "rig is a folder": Case(rig_folder, "rig.yaml: cannot be read (Is a directory"),
    "rig is the recording": Case(rig_at("a.mcap"), "a.mcap: cannot be read (not UTF-8"),
    "rig is empty": Case(rig_file(""), "rig.yaml: the rig file must be a mapping"),
    "rig is a list": Case(rig_file("[1]"), "rig.yaml: the rig file must be a mapping"),
    "rig is text": Case(rig_file("hello"), "rig.yaml: the rig file must be a mapping"),
    "rig is no YAML": Case(rig_file("hand: {"), "rig.yaml: not YAML"),
    "rig has tabs": Case(rig_file("hand:\n\tframe: h"), "rig.yaml: not YAML"),
    "rig is binary": Case(rig_file(b"\xff\xfe"), "rig.yaml: cannot be read (not UTF-8"),
    "rig runs code": Case(rig_file("!!python/object/apply:os.getcwd []"), "not YAML"),
    "unknown key": Case(
        rig_file(HAND + "roboot: a"),
        "unknown key 'roboot'; known: robot",
    ),
    "unknown key of the hand": Case(
        rig_file("hand: {frame: hand, sphere: []}"),
        "unknown key 'hand.sphere'; known: frame",
    ),
    "unknown key of the camera": Case(
        rig_file(HAND + "camera: {fov: 60}"),
        "unknown key 'camera.fov'; known: frame, info",
    ),
    "unknown key of the mount": Case(
        rig_file(HAND + "camera: {mount: {parent: base, quat: [0, 0, 0, 1]}}"),
        "unknown key 'camera.mount.quat'; known: parent, xyz, rpy",
    ),
    "unknown key of a sphere": Case(
        rig_file("hand: {frame: hand, spheres: [{centre: [0, 0, 0], radius: 1}]}"),
        "unknown key 'hand.spheres[0].centre'; known: center, radius",
    ),
    "no hand": Case(rig_file("time_offset: 0.1"), "hand must be a mapping"),
    "hand without a frame": Case(rig_file("hand: {}"), "hand.frame must be a name"),
    "hand is a number": Case(rig_file("hand: 3"), "hand must be a mapping"),
    "offset is a word": Case(rig_file(HAND + "time_offset: late"), "time_offset must be"),
    "offset is a date": Case(rig_file(HAND + "time_offset: 2020-99-99"), "not YAML"),
    "offset is endless": Case(
        rig_file(HAND + "time_offset: .inf"),
        "time_offset must be",
    ),
    "offset in nanoseconds": Case(
        rig_file(HAND + "time_offset: 1700000000000000000"),
        "time_offset must be",
    ),
    "radius is negative": Case(
        rig_file("hand: {frame: hand, spheres: [{center: [0, 0, 0], radius: -1}]}"),
        "radius must be positive",
    ),
    "robot is missing": Case(
        rig_file(HAND + "robot: robot.urdf"),
        "robot.urdf: cannot be read (No such file",
    ),
    "robot is no URDF": Case(
        rig_file(HAND + "robot: robot.txt", robot="hello"),
        "not a URDF",
    ),
    "robot is empty": Case(rig_file(HAND + "robot: robot.txt", robot=""), "not a URDF"),
    "robot has entities": Case(
        rig_file(HAND + "robot: robot.txt", robot="<!DOCTYPE r>" + URDF),
        "document type",
    ),
    "robot is the camera file": Case(
        rig_file(HAND + "robot: robot.txt", robot=camera_yaml(CAMERA)),
        "not a URDF",
    ),
    "camera file is missing": Case(
        rig_file(HAND + "camera: {info: c.yaml}"),
        "c.yaml: cannot be read (No such file",
    ),
    "camera file is no YAML": Case(
        rig_file(HAND + "camera: {info: c.txt}", c="a: ["),
        "(c.txt): not YAML",
    ),
    "camera file is another": Case(
        rig_file(HAND + "camera: {info: c.txt}", c="a: 1"),
        "lacks image_width",
    ),
    "camera file is uncalibrated": Case(
        rig_file(HAND + "camera: {info: c.txt}", c=camera_yaml(replace(CAMERA, fx=0.0))),
        "focal lengths positive",
    ),
    "unknown hand frame": Case(
        rig_file("hand: {frame: palm}"),
        "unknown hand frame 'palm'; known: base",
    ),
    "unknown camera frame": Case(
        rig_file(HAND + "camera: {frame: eye}"),
        "unknown camera frame 'eye'; known: base",
    ),
    "unknown mount": Case(
        rig_file(HAND + "camera: {mount: {parent: neck}}"),
        "unknown camera frame 'neck'",
    ),
    "nothing moves between the frames": Case(
        rig_file("hand: {frame: base}"),
        "no movable joint lies between",
    ),
    "pose topic is not logged": Case(
        rig_file("hand: {frame: hand, pose_topic: /p}\ncamera: {mount: {parent: base}}"),
        "has no geometry_msgs/msg/PoseStamped on /p",
    ),
    "poses without a mount": Case(
        lambda folder: [posed(folder, replace(POSED, mount=None))],
        "camera.mount",
    ),
    "poses in another frame": Case(
        lambda folder: [posed(folder, replace(POSED, mount=Mount("map")))],
        "camera.mount.parent is 'map', but the poses on /hand_pose are given in 'base'",
    ),
    "poses without rotation": Case(
        lambda folder: [posed(folder, POSED, (0, 0, 0, 0))],
        "no usable sample of /hand_pose",
    ),
    "poses at other times": Case(
        lambda folder: [posed(folder, POSED, shift_ns=10**12)],
        "check the clocks",
    ),
    "no robot": Case(
        log_with(replace(RIG, urdf=None), robot=[]),
        "has no /robot_description",
    ),
    "logged robot is no URDF": Case(
        log_with(replace(RIG, urdf=None), robot=[robot_message("<robot")]),
        "not a URDF",
    ),
    "no joints": Case(log_with(joints=[]), "holds no joint positions"),
    "joints without names": Case(
        log_with(joints=constant((), ())),
        "holds no joint positions",
    ),
    "other joints": Case(
        log_with(joints=constant(("x", "y"), (0.0, 0.0))),
        "lacks wrist_pitch, wrist_roll, which lie between camera and hand; logged: x, y",
    ),
    "one joint is missing": Case(
        log_with(joints=constant(JOINTS[:1], (0.0,))),
        "lacks wrist_roll",
    ),
    "joints are never a number": Case(
        log_with(joints=constant(JOINTS, (0.1, NAN))),
        "no usable sample of joint wrist_roll",
    ),
    "joints are endless": Case(
        log_with(joints=constant(JOINTS, (INF, -INF))),
        "no usable sample of joint wrist_pitch, joint wrist_roll",
    ),
    "joints end before the images": Case(
        log_with(joints=constant(JOINTS, (0.1, 0.2), -(10**12))),
        "check the clocks",
    ),
    "joints begin after the images": Case(
        log_with(joints=constant(JOINTS, (0.1, 0.2), 10**12)),
        "check the clocks",
    ),
    "joints on another clock": Case(
        log_with(joints=constant(JOINTS, (0.1, 0.2), -START_NS)),
        "or set time_offset",
    ),
    "a single joint sample": Case(
        log_with(joints=constant(JOINTS, (0.1, 0.2))[:1]),
        "no image falls between",
    ),
    "joint messages are cut": Case(
        log_with(joints=[cut(m, 30) for m in constant(JOINTS, (0.1, 0.2))]),
        "is not a sensor_msgs/msg/JointState",
    ),
    "two joint topics": Case(
        log_with(more=[joint_message(START_NS, ("x",), (0.0,), "/other")]),
        "choose one with --joints",
    ),
    "no intrinsics": Case(
        log_with(replace(RIG, camera=None), info=[]),
        "the camera is not calibrated",
    ),
    "intrinsics say uncalibrated": Case(
        log_with(
            replace(RIG, camera=None),
            info=[
                Message(
                    INFO_TOPIC, messages.CAMERA_INFO, 1, messages.encode(messages.CAMERA_INFO, {})
                )
            ],
        ),
        "the camera is not calibrated",
    ),
    "intrinsics change": Case(
        log_with(
            replace(RIG, camera=None), info=[info_message(), info_message(replace(CAMERA, fx=99.0))]
        ),
        "the intrinsics on /camera/camera_info change",
    ),
    "intrinsics of an unknown model": Case(
        log_with(
            replace(RIG, camera=None),
            info=[info_message(replace(CAMERA, distortion_model="kb4"))],
        ),
        "unknown distortion model 'kb4'; known: equidistant",
    ),
    "intrinsics are no numbers": Case(
        log_with(replace(RIG, camera=None), info=[info_message(replace(CAMERA, fx=NAN))]),
        "must be finite",
    ),
    "intrinsics on two topics": Case(
        log_with(
            replace(RIG, camera=None), info=[info_message(topic="/a"), info_message(topic="/b")]
        ),
        "choose one with --info",
    ),
    "intrinsics of another size": Case(
        log_with(replace(RIG, camera=CameraModel(320, 240, 280, 282, 159, 119, "plumb_bob", ()))),
        "images are 160x120 but the intrinsics are for 320x240",
    ),
    "intrinsics of the other orientation": Case(
        log_with(replace(RIG, camera=replace(CAMERA, width=120, height=160))),
        "images are 160x120 but the intrinsics are for 120x160",
    ),
}


def posed(
    folder: Path,
    rig: Rig,
    quaternion: tuple[float, float, float, float] = (0, 0, 0, 1),
    shift_ns: int = 0,
) -> Path:
    """Write a recording that logs poses in the frame ``base``."""
    parts = wrist_parts(FRAMES)
    parts["joints"] = [
        Message(
            POSE_TOPIC,
            messages.POSE_STAMPED,
            stamp,
            messages.pose_stamped(stamp + shift_ns, "base", (0, 0, 0.5), quaternion),
        )
        for stamp in range(START_NS, stamp_of(FRAMES), 10_000_000)
    ]
    return write_log(folder / "a.mcap", parts, rig=rig)


# --- labels ---------------------------------------------------------------------------------------

HEADER = "stamp_ns,u,v,state,labeler\n"


def labels_of(text: str | bytes, *, beside: bool) -> Build:
    """Return a builder of a good recording and a label file, given by option or lying beside it."""

    def build(folder: Path) -> list[object]:
        path = folder / ("a.labels.csv" if beside else "mine.csv")
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return [*log_with()(folder), *([] if beside else ["--from-labels", path])]

    return build


def label_folder(folder: Path) -> list[object]:
    (folder / "mine.csv").mkdir()
    return [*log_with()(folder), "--from-labels", folder / "mine.csv"]


BAD_LABELS: dict[str, tuple[str | bytes, str]] = {
    "empty": ("", "found an empty file"),
    "text": ("hello", "expected the header stamp_ns,u,v,state,labeler, found hello"),
    "other columns": ("frame,x,y\n1,2,3\n", "expected the header"),
    "binary": (b"\xff\xfe\x00", "not UTF-8"),
    "jpeg": (jpeg_of(0), "not UTF-8"),
    "too few columns": (HEADER + f"{stamp_of(0)},1,2\n", "line 2: expected 5 columns"),
    "unknown state": (HEADER + f"{stamp_of(0)},1,2,seen,me\n", "line 2: unknown state 'seen'"),
    "no stamp": (HEADER + "first,1,2,visible,me\n", "line 2: expected an integer stamp_ns"),
    "no pixel": (HEADER + f"{stamp_of(0)},,,visible,me\n", "line 2: expected an integer stamp_ns"),
    "not a number": (HEADER + f"{stamp_of(0)},nan,2,visible,me\n", "line 2: a visible tip needs"),
    "hidden with a pixel": (HEADER + f"{stamp_of(0)},1,2,occluded,me\n", "leave them empty"),
    "twice": (HEADER + f"{stamp_of(0)},1,2,visible,me\n" * 2, "already labelled in line 2"),
    "outside the image": (
        HEADER + f"{stamp_of(0)},160.2,2,visible,me\n",
        "lies outside the 160x120 image",
    ),
    "above the image": (HEADER + f"{stamp_of(1)},5,-3,visible,me\n", "lies outside the 160x120"),
    "far outside": (HEADER + f"{stamp_of(1)},1e300,2,visible,me\n", "lies outside the 160x120"),
    "another recording": (HEADER + "12345,1,2,visible,me\n", "are they from another recording?"),
    "a nanosecond off": (
        HEADER + f"{stamp_of(0) + 1},1,2,visible,me\n",
        "are they from another recording?",
    ),
    "stamps in seconds": (
        HEADER + "1700000000,1,2,visible,me\n",
        "are they from another recording",
    ),
}
LABELS: dict[str, Case] = {
    "missing": Case(
        lambda folder: [*log_with()(folder), "--from-labels", folder / "mine.csv"],
        "mine.csv: labels cannot be read (No such file",
    ),
    "folder": Case(label_folder, "mine.csv: labels cannot be read (Is a directory"),
    **{
        f"{name}{' beside' if beside else ''}": Case(labels_of(text, beside=beside), expected)
        for name, (text, expected) in BAD_LABELS.items()
        for beside in (False, True)
    },
}

# --- places that cannot be written ----------------------------------------------------------------


def out_at(name: str) -> Build:
    def build(folder: Path) -> list[object]:
        (folder / "file").write_text("precious")
        return [*log_with()(folder), "--out", folder / name]

    return build


def in_the_way(name: str) -> Build:
    """Return a builder of a recording with a folder where the result should go."""

    def build(folder: Path) -> list[object]:
        (folder / name).mkdir()
        (folder / name / "precious").write_text("")
        return [write_log(folder / "a.mcap", wrist_parts(40))]

    return build


OUTPUTS: dict[str, Case] = {
    "out is a file": Case(out_at("file"), "file: cannot be created (File exists"),
    "out is below a file": Case(out_at("file/deep"), "cannot be created (Not a directory"),
    "out is the recording": Case(out_at("a.mcap"), "cannot be created (File exists"),
    "out has too long a name": Case(out_at("x" * 300), "cannot be created (File name too long"),
    "out is no place for files": Case(
        lambda folder: [*log_with()(folder), "--out", "/proc/nowhere"], "/proc/nowhere: cannot be"
    ),
    "a folder where detections go": Case(
        in_the_way("a.detections.mcap"), "a.detections.mcap: cannot be written"
    ),
}

KMEANS = ("estimate", "--method", "kmeans")
VOTING = ("estimate", "--method", "voting")
BOTH = (("detect",), KMEANS)
RUNS = {
    f"{' '.join(command)}, {group}: {name}": (command, case)
    for group, cases, commands in (
        ("file", FILES, BOTH),
        ("stream", STREAMS, BOTH),
        ("rig", RIGS, (KMEANS, VOTING)),
        ("labels", LABELS, (KMEANS,)),
        ("output", OUTPUTS, BOTH),
    )
    for name, case in cases.items()
    for command in commands
}


def test_there_are_hundreds_of_them() -> None:
    assert len(RUNS) > 200


@pytest.mark.parametrize(("command", "case"), RUNS.values(), ids=RUNS.keys())
def test_bad_input_is_one_line_and_changes_nothing(
    command: tuple[str, ...], case: Case, tmp_path: Path
) -> None:
    arguments = case.build(tmp_path)
    before = snapshot(tmp_path)
    found = tooltip(*command, *arguments)
    assert found.code == 1, found
    assert found.out == ""
    (line,) = found.err.splitlines()
    assert line.startswith("Error: ")
    assert case.expected in line
    assert str(tmp_path) in line or "/proc/" in line  # it names the file
    assert len(line) < 1000
    assert snapshot(tmp_path) == before


@pytest.mark.parametrize(
    "name", ["missing", "empty", "folder", "text", "ROS 1 bag", "cut to 50 %", "flipped at 40%"]
)
def test_evaluate_says_the_same(name: str, tmp_path: Path) -> None:
    arguments = FILES[name].build(tmp_path)
    before = snapshot(tmp_path)
    found = tooltip("evaluate", *arguments)
    assert found.code == 1
    assert FILES[name].expected in found.error
    assert snapshot(tmp_path) == before


def test_one_bad_recording_does_not_undo_the_good_ones_before_it(tmp_path: Path) -> None:
    good = write_log(tmp_path / "good.mcap", wrist_parts(FRAMES))
    (tmp_path / "bad.mcap").write_text("hello")
    found = tooltip("detect", good, tmp_path / "bad.mcap")
    assert found.code == 1
    assert "bad.mcap is not an MCAP file" in found.error
    assert (tmp_path / "good.detections.mcap").exists()


# --- refusals: the input is sound, but holds no answer --------------------------------------------


def still(frame: int = 0) -> list[Message]:
    return images(*[jpeg_of(frame)] * FRAMES)


def uniform(level: int) -> list[Message]:
    flat = encoded(np.full((120, 160), level, dtype=np.uint8), ".png")
    return images(*[flat] * FRAMES)


def noise() -> list[Message]:
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 255, (120, 160), dtype=np.uint8) for _ in range(40)]
    return [image_message(stamp_of(i), encoded(f, ".png")) for i, f in enumerate(frames)]


def labelled(frames: Iterable[int], parts: Parts | None = None) -> Build:
    def build(folder: Path) -> list[object]:
        labels = write_true_labels(folder / "mine.csv", frames)
        path = write_log(folder / "a.mcap", parts or wrist_parts(40))
        return [path, "--from-labels", labels]

    return build


def hidden(folder: Path) -> list[object]:
    rows = "".join(f"{stamp_of(i)},,,occluded,me\n" for i in range(10))
    (folder / "mine.csv").write_text(HEADER + rows)
    return [write_log(folder / "a.mcap", wrist_parts(40)), "--from-labels", folder / "mine.csv"]


def scattered(folder: Path) -> list[object]:
    rng = np.random.default_rng(1)
    rows = "".join(
        f"{stamp_of(i)},{rng.uniform(0, 159):.2f},{rng.uniform(0, 119):.2f},visible,me\n"
        for i in range(40)
    )
    (folder / "mine.csv").write_text(HEADER + rows)
    return [write_log(folder / "a.mcap", wrist_parts(40)), "--from-labels", folder / "mine.csv"]


def moved_by(share: float) -> Parts:
    """Return a recording whose joints move by a share of what the images show."""
    parts = wrist_parts(40)
    parts["joints"] = [
        joint_message(stamp, JOINTS, [share * angle for angle in angles(stamp)])
        for stamp in range(START_NS, stamp_of(41), 10_000_000)
    ]
    return parts


def labelled_by(share: float) -> Build:
    """Return a builder of the same with labels where those joints put the tip."""

    def build(folder: Path) -> list[object]:
        tips = [tip_in_camera(*(share * angle for angle in angles(stamp_of(i)))) for i in range(40)]
        rows = "".join(
            f"{stamp_of(i)},{u:.2f},{v:.2f},visible,me\n"
            for i, (u, v) in enumerate(CAMERA.project(np.array(tips)))
        )
        (folder / "mine.csv").write_text(HEADER + rows)
        path = write_log(folder / "a.mcap", moved_by(share))
        return [path, "--from-labels", folder / "mine.csv"]

    return build


REFUSALS: dict[str, tuple[Build, str]] = {
    "still images": (log_with(images=still()), "no_motion"),
    "two still images": (log_with(images=still()[:2]), "no_motion"),
    "black images": (log_with(images=uniform(0)), "few_edges"),
    "white images": (log_with(images=uniform(255)), "few_edges"),
    "no label": (labelled([]), "no_labels"),
    "one label": (labelled([3]), "too_few_views"),
    "two labels": (labelled([3, 20]), "too_few_views"),
    "every label hidden": (hidden, "no_labels"),
    "labels anywhere": (scattered, "inconsistent_views"),
    "the hand at rest while the tip moves": (
        labelled(range(40), moved_by(0.0)),
        "inconsistent_views|depth_unobservable",
    ),
    "the hand trembles while the tip moves": (
        labelled(range(40), moved_by(0.01)),
        "inconsistent_views|depth_unobservable",
    ),
    "the hand at rest": (labelled_by(0.0), "depth_unobservable"),
    "the hand trembles": (labelled_by(0.03), "depth_unobservable"),
}


@pytest.mark.parametrize("method", ["kmeans", "map"])
@pytest.mark.parametrize("name", REFUSALS)
def test_a_refusal_is_written_and_explained(name: str, method: str, tmp_path: Path) -> None:
    build, code = REFUSALS[name]
    found = tooltip("estimate", *build(tmp_path), "--method", method, "--json")
    assert found.code == 3, found
    document = json.loads(found.out)
    assert document == json.loads((tmp_path / "a.tip.json").read_text())
    assert document["status"] == "refused"
    assert document["tip"] is None
    (reason,) = document["reasons"]
    assert re.fullmatch(code, reason["code"])
    assert re.search(r"; \w+", reason["text"]), "a reason ends with a remedy"
    assert f"refused: {reason['code']}: {reason['text']}" in found.err
    assert "Traceback" not in found.err


def test_a_change_of_image_size_is_refused_by_every_method(tmp_path: Path) -> None:
    parts = wrist_parts(40)
    parts["images"][20:] = [image_message(stamp_of(index), HALF) for index in range(20, 40)]
    path = write_log(tmp_path / "a.mcap", parts)
    for method in ("kmeans", "map", "voting"):
        found = tooltip("estimate", path, "--method", method)
        assert found.code == 1
        assert "the image size changes to 80x60 at image" in found.error
        assert set(snapshot(tmp_path)) == {"a.mcap"}


def test_noise_is_never_a_confident_tip(tmp_path: Path) -> None:
    path = write_log(tmp_path / "a.mcap", {**wrist_parts(40), "images": noise()})
    for method in ("kmeans", "map", "voting"):
        assert tooltip("estimate", path, "--method", method).code == 3


# --- odd input that is read all the same ----------------------------------------------------------


def shuffled(parts: Parts) -> Parts:
    """Log every stream in a random order; header stamps stay with their messages."""
    rng = np.random.default_rng(2)
    for role, items in parts.items():
        times = [item.log_time_ns for item in items]
        order = rng.permutation(len(items))
        parts[role] = [replace(items[i], log_time_ns=t) for i, t in zip(order, times, strict=True)]
    return parts


def doubled(parts: Parts) -> Parts:
    return {role: [item for item in items for _ in range(2)] for role, items in parts.items()}


def partly_nan(parts: Parts) -> Parts:
    for index in range(0, len(parts["joints"]), 5):
        stamp = parts["joints"][index].log_time_ns
        parts["joints"][index] = joint_message(stamp, JOINTS, (NAN, angles(stamp)[1]))
    return parts


@pytest.mark.parametrize(
    ("change", "note"),
    [
        (shuffled, "stamps run backwards; sorted by header stamp"),
        (doubled, "duplicate stamps; the first of each is kept"),
        (partly_nan, "positions of joint wrist_pitch are not finite and are left out"),
    ],
)
def test_disorder_is_put_right_and_said(
    change: Callable[[Parts], Parts], note: str, tmp_path: Path
) -> None:
    straight = write_log(tmp_path / "straight.mcap", wrist_parts(40))
    odd = write_log(tmp_path / "odd.mcap", change(wrist_parts(40)))
    tips = []
    for path in (straight, odd):
        found = tooltip(*KMEANS, path, "--json")
        assert found.code == 0
        assert (note in found.err) == (path == odd)
        tips.append(np.array(json.loads(found.out)["tip"]["position_m"]))
    assert np.linalg.norm(tips[0] - tips[1]) < 0.002


def test_the_true_tip_is_in_view_in_all_of_these_recordings() -> None:
    assert CAMERA.contains(true_pixels(40)).all()
