"""Reading a log: roles, order, images; what is odd is noted, what is unusable is said."""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import Writer as McapWriter
from rosbags.typesys import Stores, get_typestore

from tests.helpers import refusal
from tests.helpers.logs import (
    FRAMES,
    IMAGE_TOPIC,
    INFO_TOPIC,
    JOINT_TOPIC,
    POSE_TOPIC,
    START_NS,
    Log,
    Parts,
    angles,
    decoded,
    encoded,
    image_message,
    image_of,
    info_message,
    joint_message,
    jpeg_of,
    logged_image,
    robot_message,
    stamp_of,
    wrist_parts,
    write_log,
)
from tests.helpers.robot import CAMERA, CAMERA_FRAME, JOINTS, URDF
from tooltip_cli.errors import TooltipError
from tooltip_cli.log import messages
from tooltip_cli.log.messages import Message
from tooltip_cli.log.recording import Recording, Topics, read_recording, sha256_of
from tooltip_cli.rig.camera import CameraModel

Image = npt.NDArray[np.uint8]


def read(path: Path, parts: Parts | list[Message], topics: Topics | None = None) -> Recording:
    return read_recording(write_log(path / "a.mcap", parts), topics or Topics())


def test_every_stream_is_read(wrist: Log) -> None:
    recording = read_recording(wrist.path)
    assert recording.image_topic == IMAGE_TOPIC
    assert recording.image_type == messages.COMPRESSED_IMAGE
    assert recording.image_frame == CAMERA_FRAME
    assert recording.image_stamps_ns.tolist() == [stamp_of(i) for i in range(FRAMES)]
    assert recording.camera == CAMERA
    assert recording.joint_topic == JOINT_TOPIC
    assert set(recording.joints) == {*JOINTS, "grip"}
    for number, name in enumerate(JOINTS):
        track = recording.joints[name]
        wanted = [angles(stamp)[number] for stamp in track.stamps_ns.tolist()]
        assert track.positions.tolist() == wanted
    assert recording.urdf == URDF
    assert set(recording.attachments) == {"rig.yaml", "camera.yaml", "robot.urdf"}
    assert recording.sha256 == sha256_of(wrist.path)
    assert recording.notes == ()
    assert recording.unusable == {}


def test_images_are_found_by_index_in_any_order(wrist: Log) -> None:
    recording = read_recording(wrist.path)
    for index in (3, 39, 0, 3):
        (image,) = recording.images([index], gray=True)
        assert np.array_equal(image, logged_image(index))
    several = list(recording.images([5, 4, 5]))
    assert several[0].shape == (CAMERA.height, CAMERA.width, 3)
    assert np.array_equal(several[0], several[2])
    assert not np.array_equal(several[0], several[1])


def test_images_of_many_chunks(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (12, 300, 400), dtype=np.uint8)
    recording = read(
        tmp_path,
        [
            image_message(stamp, encoded(image, ".png"), image_format="png")
            for stamp, image in enumerate(noise)
        ],
    )
    assert wrist_chunks(tmp_path / "a.mcap") > 1
    order = [11, 0, 6, 1, 11]
    found = list(recording.images(order, gray=True))
    assert all(np.array_equal(image, noise[i]) for image, i in zip(found, order, strict=True))


def wrist_chunks(path: Path) -> int:
    return len({place[0] for place in read_recording(path)._places})


def test_a_log_without_chunks(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file, use_chunking=False)
        writer.start("ros2", "test")
        text = messages.schema_text(messages.COMPRESSED_IMAGE).encode()
        schema = writer.register_schema(messages.COMPRESSED_IMAGE, "ros2msg", text)
        channel = writer.register_channel("/image", "cdr", schema)
        for index in range(3):
            payload = messages.compressed_image(index, "cam", "jpeg", jpeg_of(index))
            writer.add_message(channel, index, payload, index)
        writer.finish()  # type: ignore[no-untyped-call]  # the library's own gap
    recording = read_recording(path)
    found = list(recording.images(range(3), gray=True))
    assert all(np.array_equal(image, logged_image(i)) for i, image in enumerate(found))


def test_header_stamps_order_images_not_log_times(tmp_path: Path) -> None:
    stamps = [40, 10, 30, 10, 20]
    sent = [
        Message(IMAGE_TOPIC, messages.COMPRESSED_IMAGE, log_time, image.payload)
        for log_time, image in enumerate(
            image_message(stamp, jpeg_of(index)) for index, stamp in enumerate(stamps)
        )
    ]
    recording = read(tmp_path, sent)
    assert recording.image_stamps_ns.tolist() == [10, 20, 30, 40]
    for image, index in zip(recording.images(range(4), gray=True), [1, 4, 2, 0], strict=True):
        assert np.array_equal(image, logged_image(index))
    assert recording.notes == (
        f"{IMAGE_TOPIC}: 2 stamps run backwards; sorted by header stamp",
        f"{IMAGE_TOPIC}: 1 duplicate stamps; the first of each is kept",
    )


def test_joints_in_any_order_with_duplicates_and_extras(tmp_path: Path) -> None:
    parts = wrist_parts(2)
    parts["joints"] = [
        joint_message(30, ("b", "a"), (3.1, 3.0)),
        joint_message(10, ("a", "b"), (1.0, 1.1)),
        joint_message(30, ("a", "b"), (9.0, 9.1)),
        joint_message(20, ("only_once",), (5.0,)),
    ]
    for log_time, message in enumerate(parts["joints"]):
        parts["joints"][log_time] = Message(
            message.topic, message.datatype, log_time, message.payload
        )
    recording = read(tmp_path, parts)
    assert recording.joints["a"].stamps_ns.tolist() == [10, 30]
    assert recording.joints["a"].positions.tolist() == [1.0, 3.0]
    assert recording.joints["b"].positions.tolist() == [1.1, 3.1]
    assert recording.joints["only_once"].positions.tolist() == [5.0]
    assert f"{JOINT_TOPIC}: 1 stamps run backwards; sorted by header stamp" in recording.notes


def test_positions_that_are_not_finite_are_left_out_and_noted(tmp_path: Path) -> None:
    parts = wrist_parts(2)
    parts["joints"] = [
        joint_message(stamp, ("a", "b"), (value, 1.0))
        for stamp, value in ((1, 0.1), (2, float("nan")), (3, float("inf")), (4, 0.4))
    ]
    recording = read(tmp_path, parts)
    assert recording.joints["a"].stamps_ns.tolist() == [1, 4]
    assert recording.joints["b"].stamps_ns.tolist() == [1, 2, 3, 4]
    assert recording.notes == (
        f"{JOINT_TOPIC}: 2 positions of joint a are not finite and are left out",
    )


def test_joint_states_without_positions(tmp_path: Path) -> None:
    parts = wrist_parts(2)
    fields = {"name": ["a", "b"], "effort": [1.0, 2.0]}
    payload = messages.encode(messages.JOINT_STATE, fields)
    parts["joints"] = [Message(JOINT_TOPIC, messages.JOINT_STATE, 5, payload)]
    recording = read(tmp_path, parts)
    assert recording.joints == {}
    assert recording.joint_topic == JOINT_TOPIC


def pose(
    stamp_ns: int,
    position: tuple[float, float, float] = (1, 2, 3),
    quaternion: tuple[float, float, float, float] = (0, 0, 0, 1),
    *,
    frame: str = "base",
    topic: str = POSE_TOPIC,
) -> Message:
    payload = messages.pose_stamped(stamp_ns, frame, position, quaternion)
    return Message(topic, messages.POSE_STAMPED, stamp_ns, payload)


def test_poses_are_sorted_normalised_and_checked(tmp_path: Path) -> None:
    nan = float("nan")
    recording = read(
        tmp_path,
        [
            *wrist_parts(2)["images"],
            pose(3, quaternion=(0, 0, 0.6 * 1.004, 0.8 * 1.004)),
            pose(1, position=(4, 5, 6)),
            pose(2, quaternion=(0, 0, 0, 0)),
            pose(4, quaternion=(0, 0, 0, 1.5)),
            pose(5, quaternion=(nan, 0, 0, 1)),
            pose(6, position=(nan, 0, 0)),
        ],
    )
    track = recording.poses[POSE_TOPIC]
    assert track.frame_id == "base"
    assert track.stamps_ns.tolist() == [1, 3]
    assert track.positions.tolist() == [[4, 5, 6], [1, 2, 3]]
    assert np.allclose(track.quaternions, [[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.6, 0.8]], atol=1e-15)
    assert [note for note in recording.notes if "4 poses without finite numbers" in note]


def test_poses_in_several_frames_cannot_be_used(tmp_path: Path) -> None:
    sent = [*wrist_parts(2)["images"], pose(1), pose(2, frame="world"), pose(1, topic="/other")]
    recording = read(tmp_path, sent)
    assert set(recording.poses) == {"/other"}
    assert "several frames: base, world" in recording.unusable[POSE_TOPIC]
    with pytest.raises(TooltipError, match="several frames: base, world"):
        read_recording(tmp_path / "a.mcap", Topics(pose=POSE_TOPIC))


def second_topics() -> list[Message]:
    return [
        image_message(START_NS, jpeg_of(1), "/left/image/compressed"),
        info_message(CameraModel(32, 24, 9, 9, 5, 5, "plumb_bob", ()), "/left/camera_info"),
        joint_message(START_NS, ("x",), (0.5,), "/left/joints"),
        pose(START_NS, topic="/left/pose"),
    ]


def both(tmp_path: Path) -> Path:
    return write_log(tmp_path / "both.mcap", {**wrist_parts(2), "second": second_topics()})


def test_several_image_topics_are_listed_with_the_option_that_chooses(tmp_path: Path) -> None:
    with pytest.raises(TooltipError) as caught:
        read_recording(both(tmp_path))
    message = str(caught.value)
    assert message.startswith(str(tmp_path))
    assert f"{IMAGE_TOPIC}, /left/image/compressed" in message
    assert "--image" in message


def test_several_joint_topics_matter_only_to_those_who_need_joints(tmp_path: Path) -> None:
    recording = read_recording(both(tmp_path), Topics(image=IMAGE_TOPIC))
    assert recording.joints == {}
    assert "/joint_states, /left/joints; choose one with --joints" in recording.unusable["joints"]
    chosen = read_recording(both(tmp_path / "x"), Topics(image=IMAGE_TOPIC, joints="/left/joints"))
    assert set(chosen.joints) == {"x"}
    assert chosen.unusable == {}


def test_the_camera_info_beside_the_chosen_images_is_taken(tmp_path: Path) -> None:
    path = both(tmp_path)
    left = read_recording(path, Topics(image="/left/image/compressed")).camera
    assert left is not None
    assert left.width == 32
    assert read_recording(path, Topics(image=IMAGE_TOPIC)).camera == CAMERA
    named = Topics(image=IMAGE_TOPIC, info="/left/camera_info")
    assert read_recording(path, named).camera == left


def test_camera_infos_that_could_both_be_meant(tmp_path: Path) -> None:
    infos = [info_message(topic="/a"), info_message(topic="/b")]
    sent = [image_message(1, jpeg_of(0), "/eye"), *infos]
    recording = read(tmp_path, sent)
    assert recording.camera is None
    assert "several topics for info: /a, /b; choose one with --info" in recording.unusable["info"]


def test_all_pose_topics_are_read_and_one_may_be_chosen(tmp_path: Path) -> None:
    sent = [*wrist_parts(2)["images"], pose(1), pose(1, topic="/left/pose")]
    recording = read(tmp_path, sent)
    assert set(recording.poses) == {POSE_TOPIC, "/left/pose"}
    assert recording.pose_topic is None
    chosen = read_recording(tmp_path / "a.mcap", Topics(pose="/left/pose"))
    assert set(chosen.poses) == {"/left/pose"}
    assert chosen.pose_topic == "/left/pose"


@pytest.mark.parametrize("role", ["image", "joints", "info", "pose"])
def test_a_named_topic_must_be_there(role: str, wrist: Log) -> None:
    with pytest.raises(TooltipError, match=r"has no .* on topic /nowhere") as caught:
        read_recording(wrist.path, Topics(**{role: "/nowhere"}))
    assert str(wrist.path) in str(caught.value)


def test_a_named_topic_must_have_the_roles_type(wrist: Log) -> None:
    with pytest.raises(TooltipError, match=rf"on topic {JOINT_TOPIC}; found: {IMAGE_TOPIC}"):
        read_recording(wrist.path, Topics(image=JOINT_TOPIC))


def test_a_log_without_images_lists_what_it_holds(tmp_path: Path) -> None:
    parts = wrist_parts(2)
    parts["images"] = []
    with pytest.raises(TooltipError) as caught:
        read(tmp_path, parts)
    assert "no image topic" in str(caught.value)
    assert "/joint_states (sensor_msgs/msg/JointState)" in str(caught.value)
    with pytest.raises(TooltipError, match="it holds: no messages"):
        read_recording(write_log(tmp_path / "empty.mcap", []))


def test_other_message_encodings_are_noted_and_named_in_errors(tmp_path: Path) -> None:
    path = tmp_path / "ros1.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start("ros1", "test")
        schema = writer.register_schema("sensor_msgs/CompressedImage", "ros1msg", b"Header header")
        channel = writer.register_channel("/cam", "ros1", schema)
        bare = writer.register_channel("/bare", "", 0)
        for stamp in range(3):
            writer.add_message(channel, stamp, b"123", stamp)
            writer.add_message(bare, stamp, b"123", stamp)
        writer.finish()  # type: ignore[no-untyped-call]  # the library's own gap
    with pytest.raises(TooltipError) as caught:
        read_recording(path)
    assert str(caught.value).count("topic /cam is encoded as ros1, not ROS 2 CDR") == 1
    assert "topic /bare is encoded as nothing" in str(caught.value)


def test_a_topic_with_two_types_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start("ros2", "test")
        for datatype in (messages.STRING, messages.JOINT_STATE):
            text = messages.schema_text(datatype).encode()
            schema = writer.register_schema(datatype, "ros2msg", text)
            channel = writer.register_channel("/x", "cdr", schema)
            writer.add_message(channel, 1, messages.encode(datatype, {}), 1)
        writer.finish()  # type: ignore[no-untyped-call]  # the library's own gap
    with pytest.raises(TooltipError, match="/x carries both std_msgs/msg/String and sensor_msgs"):
        read_recording(path)


def test_an_uncalibrated_camera_is_none(tmp_path: Path) -> None:
    payload = messages.encode(messages.CAMERA_INFO, {"width": 160, "height": 120})
    parts = wrist_parts(2)
    parts["info"] = [Message(INFO_TOPIC, messages.CAMERA_INFO, stamp, payload) for stamp in (1, 2)]
    assert read(tmp_path, parts).camera is None


def test_repeated_intrinsics_are_one_camera_and_changing_ones_none(tmp_path: Path) -> None:
    parts = wrist_parts(2)
    parts["info"] = [info_message(stamp_ns=stamp) for stamp in (1, 2, 3 * 10**9)]
    assert read(tmp_path, parts).camera == CAMERA
    zoomed = CameraModel(160, 120, 280.0, 282.0, 79.5, 59.5, "plumb_bob", ())
    parts["info"].append(info_message(zoomed, stamp_ns=4))
    recording = read(tmp_path / "zoom", parts)
    assert recording.camera is None
    assert "intrinsics on /camera/camera_info change" in recording.unusable["info"]
    with pytest.raises(TooltipError, match="intrinsics on /camera/camera_info change"):
        read_recording(recording.path, Topics(info=INFO_TOPIC))


def test_one_robot_description_even_from_two_topics(tmp_path: Path) -> None:
    parts = wrist_parts(2)
    parts["robot"] = [robot_message(), robot_message(topic="/left/robot_description")]
    assert read(tmp_path, parts).urdf == URDF
    parts["robot"][1] = robot_message("<robot/>", topic="/left/robot_description")
    recording = read(tmp_path / "two", parts)
    assert recording.urdf is None
    assert "several robot descriptions" in recording.unusable["robot"]


def test_the_last_robot_description_counts_and_other_strings_do_not(tmp_path: Path) -> None:
    parts = wrist_parts(2)
    parts["robot"] = [robot_message("<old/>"), robot_message(), robot_message("hi", "/chatter")]
    assert read(tmp_path, parts).urdf == URDF


COLOR = np.random.default_rng(3).integers(0, 255, (6, 9, 3), dtype=np.uint8)  # BGR
GRAY = np.random.default_rng(4).integers(0, 255, (6, 9), dtype=np.uint8)
ALPHA = np.full((6, 9, 1), 77, dtype=np.uint8)


def raw(
    encoding: str, pixels: Image, *, padding: int = 0, stamp_ns: int = 5, **changes: Any
) -> Message:
    height, width = pixels.shape[:2]
    rows = pixels.reshape(height, -1)
    padded = np.hstack([rows, np.full((height, padding), 99, dtype=np.uint8)])
    fields = {
        "header": messages.header(stamp_ns, "cam"),
        "height": height,
        "width": width,
        "encoding": encoding,
        "step": padded.shape[1],
        "data": padded.tobytes(),
        **changes,
    }
    return Message("/raw", messages.IMAGE, stamp_ns, messages.encode(messages.IMAGE, fields))


RAW: dict[str, tuple[Image, Image]] = {
    "mono8": (GRAY, np.repeat(GRAY[..., None], 3, axis=2)),
    "8UC1": (GRAY, np.repeat(GRAY[..., None], 3, axis=2)),
    "bgr8": (COLOR, COLOR),
    "8UC3": (COLOR, COLOR),
    "rgb8": (COLOR[..., ::-1], COLOR),
    "bgra8": (np.concatenate([COLOR, ALPHA], axis=2), COLOR),
    "rgba8": (np.concatenate([COLOR[..., ::-1], ALPHA], axis=2), COLOR),
}


@pytest.mark.parametrize("encoding", RAW)
@pytest.mark.parametrize("padding", [0, 3])
def test_raw_images_of_every_encoding(encoding: str, padding: int, tmp_path: Path) -> None:
    pixels, expected = RAW[encoding]
    recording = read(tmp_path, [raw(encoding, pixels, padding=padding)])
    (color,) = recording.images([0])
    (gray,) = recording.images([0], gray=True)
    assert np.array_equal(color, expected)
    wanted = GRAY if pixels.ndim == 2 else cv2.cvtColor(COLOR, cv2.COLOR_BGR2GRAY)
    assert np.array_equal(gray, wanted)
    assert color.dtype == gray.dtype == np.uint8


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_images_have_their_colours_in_place(pattern: str, tmp_path: Path) -> None:
    """A uniform colour seen through the filter that is named by its first row and its second."""
    color = {"r": 200, "g": 120, "b": 40}
    cell = np.array([color[letter] for letter in pattern], dtype=np.uint8).reshape(2, 2)
    recording = read(tmp_path, [raw(f"bayer_{pattern}8", np.tile(cell, (4, 5)))])
    (image,) = recording.images([0])
    assert image[2:-2, 2:-2].reshape(-1, 3).tolist() == [[40, 120, 200]] * 24
    (gray,) = recording.images([0], gray=True)
    assert gray.shape == (8, 10)
    assert abs(int(gray[4, 4]) - (0.299 * 200 + 0.587 * 120 + 0.114 * 40)) < 1.5


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (raw("16UC1", GRAY), "unknown image encoding '16UC1'; known: 8UC1, 8UC3, bayer_bggr8"),
        (raw("", GRAY), "unknown image encoding ''"),
        (raw("mono8", GRAY, height=7), "9x7 mono8 with rows of 9 bytes does not fit its 54 bytes"),
        (raw("mono8", GRAY, step=8), "does not fit"),
        (raw("rgb8", GRAY), "does not fit"),
        (raw("mono8", GRAY, height=0), "does not fit"),
        (raw("mono8", GRAY, width=0, step=0), "does not fit"),
        (raw("mono8", GRAY, width=2**32 - 1, height=2**32 - 1, step=2**32 - 1), "does not fit"),
        (raw("mono8", GRAY, data=b""), "does not fit its 0 bytes"),
    ],
)
def test_raw_images_that_do_not_fit(message: Message, expected: str, tmp_path: Path) -> None:
    recording = read(tmp_path, [message])
    with pytest.raises(TooltipError) as caught:
        list(recording.images([0]))
    assert expected in str(caught.value)
    assert "a.mcap: image 0" in str(caught.value)


def giant_png() -> bytes:
    """Return a PNG whose header claims more pixels than OpenCV would take."""
    data = bytearray(encoded(GRAY, ".png"))
    data[16:24] = (60_000).to_bytes(4, "big") * 2
    data[29:33] = zlib.crc32(bytes(data[12:29])).to_bytes(4, "big")
    return bytes(data)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"hello",
        jpeg_of(0)[:20],
        encoded(GRAY, ".png")[:30],
        giant_png(),
        b"\xff\xd8\xff" + bytes(1000),
    ],
    ids=["empty", "text", "cut jpeg", "cut png", "giant png", "zeros"],
)
def test_images_that_are_no_images(data: bytes, tmp_path: Path) -> None:
    recording = read(tmp_path, [image_message(1, jpeg_of(0)), image_message(2, data)])
    with pytest.raises(
        TooltipError, match=r"a\.mcap: image 1 (\(jpeg\) cannot be decoded|claims 60000x60000)"
    ):
        list(recording.images([0, 1]))


def test_png_and_foreign_format_words(tmp_path: Path) -> None:
    png = encoded(COLOR, ".png")
    for name in ("png", "bgr8; png compressed bgr8", ""):
        path = tmp_path / str(len(name))
        recording = read(path, [image_message(1, png, image_format=name)])
        assert np.array_equal(next(recording.images([0])), COLOR)


def test_exif_does_not_turn_images(tmp_path: Path) -> None:
    jpeg = encoded(image_of(0), ".jpg")
    # an APP1 segment that says "rotated by 90 degrees", behind the start of image
    orientation = bytes.fromhex("0112 0003 00000001 0006 0000")
    segment = b"Exif\x00\x00MM\x00*\x00\x00\x00\x08\x00\x01" + orientation + bytes(4)
    turned = jpeg[:2] + b"\xff\xe1" + (len(segment) + 2).to_bytes(2, "big") + segment + jpeg[2:]
    assert decoded(turned, cv2.IMREAD_COLOR).shape == (160, 120, 3)
    recording = read(tmp_path, [image_message(1, turned)])
    assert next(recording.images([0])).shape == (120, 160, 3)


def cut_payload(message: Message, length: int) -> Message:
    return Message(message.topic, message.datatype, message.log_time_ns, message.payload[:length])


@pytest.mark.parametrize("length", [0, 1, 3, 4, 11, 15, 20, 30])
def test_image_messages_cut_in_their_header(length: int, tmp_path: Path) -> None:
    with pytest.raises(TooltipError, match=r"is not a sensor_msgs/msg/CompressedImage"):
        read(tmp_path, [cut_payload(image_message(1, jpeg_of(0)), length)])


@pytest.mark.parametrize("length", [45, 60, 500])
def test_image_messages_cut_in_their_data(length: int, tmp_path: Path) -> None:
    recording = read(tmp_path, [cut_payload(image_message(1, jpeg_of(0)), length)])
    with pytest.raises(TooltipError, match=r"a\.mcap: image 0"):
        list(recording.images([0]))


@pytest.mark.parametrize(
    ("role", "make", "key"),
    [
        ("joints", lambda: joint_message(1, ("a",), (0.1,)), "joints"),
        ("info", info_message, "info"),
        ("robot", robot_message, "robot"),
        ("pose", lambda: pose(1), POSE_TOPIC),
    ],
)
@pytest.mark.parametrize("length", [0, 2, 7])
def test_small_messages_cut_anywhere_spoil_only_their_role(
    role: str, make: Callable[[], Message], key: str, length: int, tmp_path: Path
) -> None:
    parts = wrist_parts(2)
    parts[role] = [cut_payload(make(), length)]
    recording = read(tmp_path, parts)
    assert "a message is not a" in recording.unusable[key]
    assert len(list(recording.images([0, 1]))) == 2


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    role=st.sampled_from(["images", "joints", "info", "robot"]),
    place=st.integers(0, 200),
    noise=st.binary(min_size=1, max_size=8),
)
def test_noise_in_messages_is_read_or_refused(
    role: str, place: int, noise: bytes, tmp_path: Path
) -> None:
    parts = wrist_parts(2)
    message = parts[role][0]
    payload = bytearray(message.payload)
    payload[place : place + len(noise)] = noise
    parts[role][0] = Message(message.topic, message.datatype, message.log_time_ns, bytes(payload))
    path = tmp_path / "a.mcap"
    path.unlink(missing_ok=True)
    write_log(path, parts)
    message_text = refusal(lambda: list(read_recording(path).images([0])))
    assert message_text is None or str(path) in message_text


def test_a_cut_recording_is_refused(wrist: Log) -> None:
    data = wrist.path.read_bytes()
    for length in range(997, len(data), 997):
        wrist.path.write_bytes(data[:length])
        with pytest.raises(TooltipError, match=re.escape(str(wrist.path))) as caught:
            read_recording(wrist.path)
        assert "salvage" in str(caught.value)


def test_a_flipped_recording_is_refused_or_unchanged(wrist: Log) -> None:
    data = wrist.path.read_bytes()
    whole = read_recording(wrist.path)
    rng = np.random.default_rng(11)
    for offset in rng.integers(0, len(data), 60):
        bad = bytearray(data)
        bad[offset] ^= 1 << int(rng.integers(8))
        wrist.path.write_bytes(bad)
        message = refusal(lambda: read_recording(wrist.path))
        if message is not None:
            assert "salvage" in message or offset < 8
            continue
        found = read_recording(wrist.path)
        assert found.attachments == whole.attachments
        assert found._places == whole._places
        assert np.array_equal(found.joints["grip"].positions, whole.joints["grip"].positions)


def test_big_endian_images_are_read(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    little = image_message(stamp_of(0), jpeg_of(0))
    value = store.deserialize_cdr(little.payload, messages.COMPRESSED_IMAGE)
    payload = store.serialize_cdr(value, messages.COMPRESSED_IMAGE, little_endian=False)
    big = Message(IMAGE_TOPIC, messages.COMPRESSED_IMAGE, 1, bytes(payload))
    recording = read(tmp_path, [big])
    assert recording.image_stamps_ns.tolist() == [stamp_of(0)]
    assert recording.image_frame == CAMERA_FRAME
    assert next(recording.images([0])).shape == (120, 160, 3)


def test_stamps_before_the_epoch(tmp_path: Path) -> None:
    stamps = [-1_500_000_000, 0, 2**31 * 10**9 - 1]
    sent = [
        Message(IMAGE_TOPIC, messages.COMPRESSED_IMAGE, log_time, message.payload)
        for log_time, message in enumerate(image_message(stamp, jpeg_of(0)) for stamp in stamps)
    ]
    assert read(tmp_path, sent).image_stamps_ns.tolist() == stamps
