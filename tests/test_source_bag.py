"""Importing bags: real ROS 1 and ROS 2 bags, written by rosbags, and MCAP files."""

from __future__ import annotations

import contextlib
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import zstandard
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from tooltip_cli.errors import TooltipError
from tooltip_cli.log import messages
from tooltip_cli.log.container import LoggedMessage, iterate
from tooltip_cli.log.messages import Message
from tooltip_cli.log.recording import Recording, Topics, read_recording
from tooltip_cli.log.writer import LogWriter
from tooltip_cli.rig.camera import CameraModel
from tooltip_cli.rig.kinematics import Mount
from tooltip_cli.rig.rigfile import Rig
from tooltip_cli.sources.bag import BagSource
from tooltip_cli.stages.record import Recorded, record

START = 1_700_000_000_123_456_789
STEP = 33_333_333
COUNT = 4
CAMERA = CameraModel(32, 24, 40.0, 41.0, 15.5, 11.5, "plumb_bob", (0.1, -0.2, 0.001, 0.002, 0.0))
URDF = "<robot name='r'><link name='base'/></robot>"
IMAGES, INFO, JOINTS = "/cam/image_raw/compressed", "/cam/camera_info", "/arm/joint_states"
POSES, ROBOT = "/arm/pose", "/robot_description"


def picture(index: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    rng = np.random.default_rng(index)
    return rng.integers(0, 256, (24, 32, 3), dtype=np.uint8)


def png(index: int) -> bytes:
    return cv2.imencode(".png", picture(index))[1].tobytes()


def jpeg(index: int) -> bytes:
    return cv2.imencode(".jpg", picture(index))[1].tobytes()


def joint_values(index: int) -> list[float]:
    return [0.1 * index, -0.2 * index, 1 / 3]


def stream(image_format: str = "png", data: Callable[[int], bytes] = png) -> Iterator[Message]:
    """Yield ROS 2 messages of all kinds, log time a little after each stamp."""
    yield Message(ROBOT, messages.STRING, START, messages.string(URDF))
    for index in range(COUNT):
        stamp = START + index * STEP
        times = stamp + 5_000_000, stamp + 2_000_000
        for topic, kind, payload in (
            (INFO, messages.CAMERA_INFO, messages.camera_info(stamp, "cam", CAMERA)),
            (
                IMAGES,
                messages.COMPRESSED_IMAGE,
                messages.compressed_image(stamp, "cam", image_format, data(index)),
            ),
            (
                JOINTS,
                messages.JOINT_STATE,
                messages.joint_state(stamp + 7, ["a", "b", "c"], joint_values(index)),
            ),
            (
                "/unrelated",
                messages.STRING,
                messages.string(f"noise {index}"),
            ),
        ):
            yield Message(topic, kind, times[0], payload, times[1])


def write_ros2(
    path: Path,
    source: Iterator[Message],
    storage: StoragePlugin = StoragePlugin.SQLITE3,
    compression: CompressionMode = CompressionMode.NONE,
) -> Path:
    store = get_typestore(Stores.ROS2_HUMBLE)
    writer = Ros2Writer(path, version=9, storage_plugin=storage)
    writer.set_compression(compression, CompressionFormat.ZSTD)
    connections = {}
    with writer:
        for message in source:
            if message.topic not in connections:
                connections[message.topic] = writer.add_connection(
                    message.topic, message.datatype, typestore=store
                )
            writer.write(connections[message.topic], message.log_time_ns, message.payload)
    return path


def write_ros1(
    path: Path,
    source: Iterator[Message],
    compression: Ros1Writer.CompressionFormat | None = None,
    md5: str | None = None,
) -> Path:
    """Write the ROS 1 form of the messages, sequence numbers in their headers."""
    ros1, ros2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
    writer = Ros1Writer(path)
    if compression is not None:
        writer.set_compression(compression)
    connections = {}
    with writer:
        for message in source:
            if message.topic not in connections:
                definition = ros1.generate_msgdef(message.datatype)
                connections[message.topic] = writer.add_connection(
                    message.topic,
                    message.datatype,
                    msgdef=definition[0],
                    md5sum=md5 or definition[1],
                )
            payload = bytes(ros2.cdr_to_ros1(message.payload, message.datatype))
            writer.write(connections[message.topic], message.log_time_ns, payload)
    return path


def write_mcap(path: Path, source: Iterator[Message]) -> Path:
    with LogWriter(path, overwrite=True) as writer:
        for message in source:
            writer.write(message)
    return path


def import_bag(
    path: Path, topics: Topics | None = None, rig: Rig | None = None, urdf: str | None = None
) -> tuple[Recording, Recorded]:
    out = path.parent / "out.mcap"
    done = record(BagSource(path, topics, rig, urdf), out, overwrite=True)
    return read_recording(out), done


def check_all(recording: Recording) -> None:
    stamps = [START + index * STEP for index in range(COUNT)]
    assert recording.image_topic == IMAGES
    assert recording.image_frame == "cam"
    assert recording.image_stamps_ns.tolist() == stamps
    for index, image in enumerate(recording.images(range(COUNT))):
        assert np.array_equal(image, picture(index))
    assert recording.joint_topic == JOINTS
    assert sorted(recording.joints) == ["a", "b", "c"]
    for column, name in enumerate("abc"):
        track = recording.joints[name]
        assert track.stamps_ns.tolist() == [stamp + 7 for stamp in stamps]
        assert track.positions.tolist() == [joint_values(i)[column] for i in range(COUNT)]
    assert recording.camera == CAMERA
    assert recording.urdf == URDF
    assert not recording.notes


def payloads(path: Path) -> dict[str, list[bytes]]:
    found: dict[str, list[bytes]] = {}
    for item in iterate(path):
        if isinstance(item, LoggedMessage):
            found.setdefault(item.topic, []).append(item.payload)
    return found


BAGS: dict[str, Callable[[Path], Path]] = {
    "ros1": lambda d: write_ros1(d / "in.bag", stream()),
    "ros1 bz2": lambda d: write_ros1(d / "in.bag", stream(), Ros1Writer.CompressionFormat.BZ2),
    "ros1 lz4": lambda d: write_ros1(d / "in.bag", stream(), Ros1Writer.CompressionFormat.LZ4),
    "sqlite folder": lambda d: write_ros2(d / "in", stream()),
    "sqlite file": lambda d: write_ros2(d / "in", stream()) / "in.db3",
    "sqlite messages zstd": lambda d: write_ros2(
        d / "in", stream(), compression=CompressionMode.MESSAGE
    ),
    "sqlite file zstd": lambda d: write_ros2(d / "in", stream(), compression=CompressionMode.FILE),
    "mcap folder": lambda d: write_ros2(d / "in", stream(), StoragePlugin.MCAP),
    "mcap in folder": lambda d: write_ros2(d / "in", stream(), StoragePlugin.MCAP) / "in.mcap",
    "mcap folder, file zstd": lambda d: write_ros2(
        d / "in", stream(), StoragePlugin.MCAP, CompressionMode.FILE
    ),
    "mcap": lambda d: write_mcap(d / "in.mcap", stream()),
}


@pytest.mark.parametrize("kind", BAGS)
def test_every_format_gives_the_same_recording(tmp_path: Path, kind: str) -> None:
    recording, done = import_bag(BAGS[kind](tmp_path))
    check_all(recording)
    assert done.report.read == {ROBOT: 1, INFO: COUNT, IMAGES: COUNT, JOINTS: COUNT}
    assert done.report.dropped == {}
    assert done.report.notes == ["1 topic left out: /unrelated"]


@pytest.mark.parametrize("kind", BAGS)
def test_progress_is_known_before_reading(tmp_path: Path, kind: str) -> None:
    source = BagSource(BAGS[kind](tmp_path))
    assert source.frames == COUNT
    assert source.image_topic == IMAGES


@pytest.mark.parametrize("kind", [kind for kind in BAGS if not kind.startswith("ros1")])
def test_ros2_payloads_pass_byte_for_byte(tmp_path: Path, kind: str) -> None:
    _, done = import_bag(BAGS[kind](tmp_path))
    expected: dict[str, list[bytes]] = {}
    for message in stream():
        expected.setdefault(message.topic, []).append(message.payload)
    del expected["/unrelated"]
    assert payloads(done.path) == expected


def test_mcap_keeps_log_and_publish_times(tmp_path: Path) -> None:
    import_bag(write_mcap(tmp_path / "in.mcap", stream()))
    kept = [item for item in iterate(tmp_path / "out.mcap") if isinstance(item, LoggedMessage)]
    sent = [message for message in stream() if message.topic != "/unrelated"]
    assert [item.log_time_ns for item in kept] == [item.log_time_ns for item in sent]
    published = [item.publish_time_ns or item.log_time_ns for item in sent]
    assert [item.publish_time_ns for item in kept] == published
    assert kept[1].log_time_ns != kept[1].publish_time_ns


def test_mcap_without_a_summary_is_read(tmp_path: Path) -> None:
    path = tmp_path / "in.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file, use_statistics=False, use_summary_offsets=False)
        writer.start("ros2", "test")
        channels: dict[str, int] = {}
        for item in stream():
            if item.topic not in channels:
                text = messages.schema_text(item.datatype).encode()
                schema = writer.register_schema(item.datatype, "ros2msg", text)
                channels[item.topic] = writer.register_channel(item.topic, "cdr", schema)
            writer.add_message(
                channels[item.topic], item.log_time_ns, item.payload, item.log_time_ns
            )
        writer.finish()  # type: ignore[no-untyped-call]  # the library's own gap
    check_all(import_bag(path)[0])


def test_mcap_with_ros1_messages_is_converted(tmp_path: Path) -> None:
    path = tmp_path / "in.mcap"
    ros2 = get_typestore(Stores.ROS2_HUMBLE)
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start("ros1", "test")
        channels: dict[str, int] = {}
        for item in stream():
            if item.topic not in channels:
                name = item.datatype.replace("/msg/", "/")
                schema = writer.register_schema(name, "ros1msg", b"")
                channels[item.topic] = writer.register_channel(item.topic, "ros1", schema)
            payload = bytes(ros2.cdr_to_ros1(item.payload, item.datatype))
            writer.add_message(channels[item.topic], item.log_time_ns, payload, item.log_time_ns)
        writer.finish()  # type: ignore[no-untyped-call]  # the library's own gap
    check_all(import_bag(path)[0])


def test_mcap_of_another_encoding_says_which(tmp_path: Path) -> None:
    path = tmp_path / "in.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start("", "test")
        schema = writer.register_schema("foxglove.CompressedImage", "protobuf", b"")
        channel = writer.register_channel("/camera", "protobuf", schema)
        writer.add_message(channel, START, b"\x08\x01", START)
        writer.finish()  # type: ignore[no-untyped-call]  # the library's own gap
    with pytest.raises(TooltipError, match="/camera is encoded as protobuf") as caught:
        BagSource(path)
    assert "no image topic" in str(caught.value)


@pytest.mark.parametrize(
    ("written", "data", "kept"),
    [
        ("bgr8; jpeg compressed bgr8", jpeg, "jpeg"),
        ("rgb8; png compressed ", png, "png"),
        ("jpg", jpeg, "jpeg"),
        ("", png, "png"),
        ("jpeg", png, "png"),
    ],
)
@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_formats_become_exactly_jpeg_or_png(
    tmp_path: Path, kind: str, written: str, data: Callable[[int], bytes], kept: str
) -> None:
    messages_ = stream(written, data)
    if kind == "ros1":
        path = write_ros1(tmp_path / "in.bag", messages_)
    else:
        path = write_mcap(tmp_path / "in.mcap", messages_)
    recording, _ = import_bag(path)
    for index, message in enumerate(recording.image_messages(range(COUNT))):
        assert message.format == kept
        assert message.data == data(index)
    assert recording.image_stamps_ns[0] == START
    assert recording.image_frame == "cam"


def test_raw_images_pass(tmp_path: Path) -> None:
    def raw() -> Iterator[Message]:
        for index in range(COUNT):
            stamp = START + index * STEP
            fields = {
                "header": messages.header(stamp, "cam"),
                "height": 24,
                "width": 32,
                "encoding": "bgr8",
                "step": 96,
                "data": picture(index).tobytes(),
            }
            payload = messages.encode(messages.IMAGE, fields)
            yield Message("/cam/image_raw", messages.IMAGE, stamp, payload)
            yield Message(
                JOINTS, messages.JOINT_STATE, stamp, messages.joint_state(stamp, ["a"], [index])
            )

    recording, _ = import_bag(write_ros1(tmp_path / "in.bag", raw()))
    assert recording.image_type == messages.IMAGE
    for index, image in enumerate(recording.images(range(COUNT))):
        assert np.array_equal(image, picture(index))


def test_foreign_pictures_are_left_out_and_counted(tmp_path: Path) -> None:
    def mixed(index: int) -> bytes:
        return b"\x00\x00\x00\x01h264" if index == 1 else png(index)

    recording, done = import_bag(write_mcap(tmp_path / "in.mcap", stream("png", mixed)))
    assert len(recording.image_stamps_ns) == COUNT - 1
    assert list(done.report.dropped.values()) == [1]
    path = write_mcap(tmp_path / "none.mcap", stream("h264", lambda index: b"\x00\x00\x00\x01"))
    with pytest.raises(TooltipError, match=r"no image on .* can be kept \(4 images on"):
        import_bag(path)
    assert not (tmp_path / "none").exists()


def test_messages_that_cannot_be_read_are_left_out(tmp_path: Path) -> None:
    def broken() -> Iterator[Message]:
        yield from stream()
        late = START + COUNT * STEP
        yield Message(IMAGES, messages.COMPRESSED_IMAGE, late, b"\x00\x01\x00\x00\xff")

    _, done = import_bag(write_mcap(tmp_path / "in.mcap", broken()))
    assert done.report.dropped == {
        f"messages on {IMAGES} that are no {messages.COMPRESSED_IMAGE}": 1
    }


def two_of_everything() -> Iterator[Message]:
    for message in stream():
        yield message
        if message.topic in (IMAGES, INFO, JOINTS):
            second = "/second" + message.topic
            yield Message(second, message.datatype, message.log_time_ns, message.payload)


def test_several_topics_need_a_choice(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "in.mcap", two_of_everything())
    with pytest.raises(TooltipError, match=r"several topics for image.*--image") as caught:
        BagSource(path)
    assert IMAGES in str(caught.value)
    assert f"/second{IMAGES}" in str(caught.value)
    with pytest.raises(TooltipError, match=r"several topics for joints.*--joints"):
        BagSource(path, Topics(image=IMAGES))
    second = Topics(image="/second" + IMAGES, joints=JOINTS)
    recording, done = import_bag(path, second)
    assert recording.image_topic == "/second" + IMAGES
    assert set(done.report.read) == {"/second" + IMAGES, "/second" + INFO, JOINTS, ROBOT}
    check_all(import_bag(path, Topics(image=IMAGES, joints=JOINTS, info=INFO))[0])


@pytest.mark.parametrize("role", ["image", "joints", "info", "pose"])
def test_an_unknown_topic_lists_what_is_there(tmp_path: Path, role: str) -> None:
    path = write_mcap(tmp_path / "in.mcap", stream())
    with pytest.raises(TooltipError, match="/nowhere") as caught:
        BagSource(path, Topics(**{role: "/nowhere"}))
    there = {"image": IMAGES, "joints": JOINTS, "info": INFO, "pose": "PoseStamped"}
    assert there[role] in str(caught.value)


def test_depth_pictures_are_no_candidates(tmp_path: Path) -> None:
    def with_depth() -> Iterator[Message]:
        for message in stream():
            yield message
            if message.topic == IMAGES:
                depth = "/cam/depth/compressedDepth"
                yield Message(depth, message.datatype, message.log_time_ns, message.payload)

    recording, _ = import_bag(write_mcap(tmp_path / "in.mcap", with_depth()))
    check_all(recording)


def with_poses(*, joints: bool) -> Iterator[Message]:
    for message in stream():
        if message.topic == JOINTS:
            stamp = message.log_time_ns
            pose = messages.pose_stamped(stamp, "base", (1, 2, 3), (0, 0, 0, 1))
            yield Message(POSES, messages.POSE_STAMPED, stamp, pose)
        if joints or message.topic != JOINTS:
            yield message


def test_poses_are_taken_where_there_are_no_joints(tmp_path: Path) -> None:
    rig = Rig(hand_frame="hand", mount=Mount("base"))
    path = write_mcap(tmp_path / "in.mcap", with_poses(joints=False))
    recording, done = import_bag(path, rig=rig)
    assert set(recording.poses) == {POSES}
    assert recording.poses[POSES].positions.tolist() == [[1, 2, 3]] * COUNT
    # the stored rig must name the poses, or the hand's place could not be found later
    assert b"pose_topic: /arm/pose" in recording.attachments["rig.yaml"]
    assert any(POSES in note for note in done.report.notes)


def test_poses_are_left_out_beside_joints_unless_named(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "in.mcap", with_poses(joints=True))
    assert not import_bag(path)[0].poses
    by_rig = import_bag(path, rig=Rig(hand_frame="hand", pose_topic=POSES))[0]
    assert set(by_rig.poses) == {POSES}
    assert by_rig.joint_topic == JOINTS
    assert set(import_bag(path, Topics(pose=POSES))[0].poses) == {POSES}
    with pytest.raises(TooltipError, match="/elsewhere"):
        BagSource(path, rig=Rig(hand_frame="hand", pose_topic="/elsewhere"))


def test_a_bag_of_pictures_alone_is_noted(tmp_path: Path) -> None:
    pictures = (item for item in stream() if item.topic == IMAGES)
    _, done = import_bag(write_mcap(tmp_path / "in.mcap", pictures))
    assert any("not located" in note for note in done.report.notes)


def test_a_given_urdf_takes_the_bags_place(tmp_path: Path) -> None:
    other = URDF.replace("'r'", "'other'")
    path = write_mcap(tmp_path / "in.mcap", stream())
    recording, done = import_bag(path, rig=Rig(hand_frame="hand"), urdf=other)
    assert recording.urdf == other
    assert done.report.notes == [
        f"the URDF of --robot or --rig takes the place of {ROBOT}",
        "1 topic left out: /unrelated",
    ]
    assert recording.attachments["robot.urdf"] == other.encode()
    assert import_bag(path, rig=Rig(hand_frame="hand", urdf=other))[0].urdf == other


def test_several_robots_are_refused(tmp_path: Path) -> None:
    def twins() -> Iterator[Message]:
        yield from stream()
        twin = "/left/robot_description"
        yield Message(twin, messages.STRING, START, messages.string(URDF))

    path = write_mcap(tmp_path / "in.mcap", twins())
    with pytest.raises(TooltipError, match=r"several robots.*--robot"):
        BagSource(path)
    assert import_bag(path, urdf=URDF)[0].urdf == URDF


def test_a_folder_without_metadata_is_read(tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "in", stream())
    (folder / "metadata.yaml").unlink()
    recording, done = import_bag(folder)
    check_all(recording)
    assert any("no metadata.yaml" in note for note in done.report.notes)


def test_a_split_bag_is_read_in_order(tmp_path: Path) -> None:
    early = (item for item in stream() if item.log_time_ns < START + 2 * STEP)
    late = (item for item in stream() if item.log_time_ns >= START + 2 * STEP)
    folder = write_ros2(tmp_path / "in", early)
    shutil.move(write_ros2(tmp_path / "more", late) / "more.db3", folder / "in_1.db3")
    text = (folder / "metadata.yaml").read_text()
    listed = re.sub(r"(\s+- )in\.db3", r"\1in/in.db3\1in_1.db3", text, count=1)
    assert "in_1.db3" in listed
    (folder / "metadata.yaml").write_text(listed)
    check_all(import_bag(folder)[0])


@pytest.mark.parametrize("name", ["run #3", "100%41", "what?"])
def test_names_that_sqlite_would_misread(tmp_path: Path, name: str) -> None:
    written = write_ros2(tmp_path / "in", stream())  # rosbags cannot write there itself
    (tmp_path / name).mkdir()
    shutil.move(written, tmp_path / name / "in")
    check_all(import_bag(tmp_path / name / "in")[0])


def test_an_unmerged_journal_is_noted(tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "in", stream())
    (folder / "in.db3-wal").write_bytes(b"not empty")
    source = BagSource(folder)
    assert any("in.db3-wal" in note for note in source.report.notes)


def test_another_definition_is_refused(tmp_path: Path) -> None:
    path = write_ros1(tmp_path / "in.bag", stream(), md5="0" * 32)
    with pytest.raises(TooltipError, match="another definition"):
        import_bag(path)


def one_line_error(path: Path, match: str) -> None:
    with pytest.raises(TooltipError, match=match) as caught:
        import_bag(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)
    assert not (path.parent / "out.mcap").exists()


def test_files_that_are_no_bags(tmp_path: Path) -> None:
    one_line_error(tmp_path / "absent.bag", "No such file")
    for name in ("empty.bag", "empty.db3", "empty.mcap"):
        (tmp_path / name).write_bytes(b"")
        one_line_error(tmp_path / name, "is empty")
    (tmp_path / "text.bag").write_text("stamp,x\n1,2\n")
    one_line_error(tmp_path / "text.bag", "is no bag")
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V1.1\n")
    one_line_error(tmp_path / "old.bag", "not supported")
    (tmp_path / "folder").mkdir()
    one_line_error(tmp_path / "folder", "neither metadata.yaml nor")
    write_ros1(tmp_path / "folder" / "a.bag", stream())
    one_line_error(tmp_path / "folder", "ROS 1 bags, give one of them")


def test_an_unindexed_bag_names_the_remedy(tmp_path: Path) -> None:
    path = write_ros1(tmp_path / "in.bag", stream())
    data = path.read_bytes()
    place = data.index(b"index_pos=") + len(b"index_pos=")
    path.write_bytes(data[:place] + bytes(8) + data[place + 8 :])
    one_line_error(path, "not indexed.*rosbag reindex")


@pytest.mark.parametrize("kind", ["ros1", "ros1 lz4", "sqlite file", "mcap"])
@pytest.mark.parametrize("share", [0.02, 0.3, 0.6, 0.9, 0.999])
def test_truncated_files_are_one_line(tmp_path: Path, kind: str, share: float) -> None:
    path = BAGS[kind](tmp_path)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    one_line_error(path, "truncated|cannot be read|is no bag")


def test_damage_inside_a_compressed_file_names_that_file(tmp_path: Path) -> None:
    data = write_mcap(tmp_path / "in.mcap", stream()).read_bytes()
    packed = tmp_path / "in.mcap.zstd"
    packed.write_bytes(zstandard.compress(data))
    check_all(import_bag(packed)[0])
    (tmp_path / "out.mcap").unlink()
    packed.write_bytes(zstandard.compress(data[:-100]))
    one_line_error(packed, "truncated")
    packed.write_bytes(zstandard.compress(data)[:-100])
    one_line_error(packed, "is truncated: its compressed data")
    packed.write_bytes(b"no zstd")
    one_line_error(packed, "cannot be read as a zstd file")


@pytest.mark.parametrize("kind", ["ros1", "sqlite file", "mcap"])
def test_flipped_bytes_never_escape_as_other_errors(tmp_path: Path, kind: str) -> None:
    path = BAGS[kind](tmp_path)
    data = path.read_bytes()
    rng = np.random.default_rng(0)
    for place in rng.integers(0, len(data), 60).tolist():
        path.write_bytes(data[:place] + bytes([data[place] ^ 0x55]) + data[place + 1 :])
        # what still reads is fine; anything but a TooltipError would be a fault of ours
        with contextlib.suppress(TooltipError):
            import_bag(path)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "is no description"),
        ("[1, 2", "not YAML"),
        ("a: 2020-99-99", "not YAML"),
        ("a: b", "is no description"),
        ("rosbag2_bagfile_information: {storage_identifier: sqlite3}", "is no description"),
        (
            "rosbag2_bagfile_information: {storage_identifier: rosbag_v2, relative_file_paths: []}",
            "storage 'rosbag_v2'",
        ),
        (
            "rosbag2_bagfile_information: {storage_identifier: mcap, relative_file_paths: [x.db3]}",
            "not there: x.db3",
        ),
        (
            "rosbag2_bagfile_information: {storage_identifier: mcap, relative_file_paths: [in.db3],"
            " compression_mode: FILE, compression_format: lz4}",
            "compression 'lz4'",
        ),
    ],
)
def test_malformed_metadata(tmp_path: Path, text: str, match: str) -> None:
    folder = write_ros2(tmp_path / "in", stream())
    (folder / "metadata.yaml").write_text(text)
    one_line_error(folder, match)
