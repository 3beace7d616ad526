"""``tooltip record camera``: real sockets, a real HTTP server, real video streams."""

from __future__ import annotations

import json
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.cli import tooltip
from tests.helpers.live import MjpegServer, free_port, joint_line, udp_joints
from tests.helpers.logs import FRAME_NS, START_NS, angles, jpeg_of
from tests.helpers.recorder import by_topic, ended, recorder, results, wait_for
from tests.helpers.robot import JOINTS, RIG
from tooltip_cli.errors import TooltipError
from tooltip_cli.log.messages import decode, ns_from_time
from tooltip_cli.sources.joints import JointSample, joint_samples, sample_from_json
from tooltip_cli.stages.calibrate import write_rig

IMAGES, STATES = "/camera/image/compressed", "/joint_states"


@pytest.fixture
def server() -> Iterator[MjpegServer]:
    server = MjpegServer()
    yield server
    server.close()


def test_what_is_sent_is_recorded_byte_for_byte_with_both_clocks(
    tmp_path: Path, server: MjpegServer
) -> None:
    port = free_port(socket.SOCK_DGRAM)
    rig = write_rig(RIG, tmp_path)
    sources = ("--camera", server.url, "--joints", f"udp://127.0.0.1:{port}", "--rig", rig)
    out = tmp_path / "out.mcap"
    recording = recorder("camera", out, *sources)
    assert server.connected.wait(30)
    before_ns = time.time_ns()
    stamps: list[int] = []
    with udp_joints(port) as send:
        for i in range(40):
            stamps.append(time.time_ns())
            send(joint_line({JOINTS[0]: 0.01 * i, JOINTS[1]: 0.0}, stamps[i]))
            server.show(jpeg_of(i) + bytes([i]))
            time.sleep(0.01)
        send(b"no json\n")
        send(b'{"positions": {"a": "far"}}\n')
        time.sleep(0.3)
    printed, err = results(recording, signal.SIGINT)
    assert printed == f"{out}\n"
    images = by_topic(out)[IMAGES]
    sent = [jpeg_of(i) + bytes([i]) for i in range(40)]
    assert [bytes(decode(m.datatype, m.payload).data) for m in images] == sent
    for message in images:
        stamp_ns = ns_from_time(decode(message.datatype, message.payload).header.stamp)
        assert stamp_ns == message.log_time_ns
        assert abs(stamp_ns - before_ns) < 30e9
    states = by_topic(out)[STATES]
    assert [decode(m.datatype, m.payload).position[0] for m in states] == [
        0.01 * i for i in range(40)
    ]
    assert [m.publish_time_ns for m in states] == stamps
    assert all(m.log_time_ns >= before_ns for m in states)
    assert "left out 1 lines that are not JSON" in err
    assert "left out 1 lines with a position that is no number" in err
    assert re.search(r"motion: (keep going|tilt the wrist)", err)  # about one axis only
    assert len(by_topic(out)["/robot_description"]) == 1
    info = json.loads(tooltip("info", out, "--json").out)
    assert info["state"] == "whole"


def test_a_camera_that_is_lost_ends_the_recording_with_a_line(
    tmp_path: Path, server: MjpegServer
) -> None:
    out = tmp_path / "out.mcap"
    recording = recorder("camera", out, "--camera", server.url)
    assert server.connected.wait(30)
    for i in range(3):
        server.show(jpeg_of(i))
    server.show(b"")  # hangs up
    err = ended(recording)
    assert "ended: the camera has ended" in err
    assert "no joint angles" in err
    assert len(by_topic(out)[IMAGES]) == 3


def test_a_camera_that_comes_back_is_waited_for(tmp_path: Path) -> None:
    first = MjpegServer(lengths=False)
    out = tmp_path / "out.mcap"
    recording = recorder("camera", out, "--camera", first.url, "--reconnect")
    assert first.connected.wait(30)
    for i in range(3):
        first.show(jpeg_of(i))
    first.close()
    second = MjpegServer(port=first.port)
    assert second.connected.wait(30)
    for i in range(3, 5):
        second.show(jpeg_of(i))
    time.sleep(0.5)
    err = ended(recording, signal.SIGTERM)
    second.close()
    assert "the camera has ended; waiting for it" in err
    images = by_topic(out)[IMAGES]
    data = [bytes(decode(m.datatype, m.payload).data) for m in images]
    # without lengths an image ends where the next begins: the last before a break is whole too
    assert data == [jpeg_of(i) for i in range(5)]


def test_a_camera_that_is_not_there_leaves_no_file(tmp_path: Path) -> None:
    url = f"http://127.0.0.1:{free_port()}/"
    out = tmp_path / "out.mcap"
    done = tooltip("record", "camera", out, "--camera", url)
    assert done.code == 1
    assert "no image came" in done.error
    assert f"{url}: cannot be reached (Connection refused)" in done.error
    assert not list(tmp_path.iterdir())


def test_silence_ends_the_recording(tmp_path: Path, server: MjpegServer) -> None:
    out = tmp_path / "out.mcap"
    recording = recorder("camera", out, "--camera", server.url, "--patience", 1)
    assert server.connected.wait(30)
    server.show(jpeg_of(0))
    err = ended(recording)
    assert f"ended: no image on {IMAGES} for 1 s" in err
    assert len(by_topic(out)[IMAGES]) == 1


def test_missing_joints_are_reported_and_images_kept(tmp_path: Path, server: MjpegServer) -> None:
    port = free_port(socket.SOCK_DGRAM)
    options = ("--joints", f"udp://127.0.0.1:{port}", "--duration", 1.5)
    out = tmp_path / "out.mcap"
    recording = recorder("camera", out, "--camera", server.url, *options)
    assert server.connected.wait(30)
    for i in range(25):
        server.show(jpeg_of(i))
        time.sleep(0.1)
    err = ended(recording)
    assert f"nothing on {STATES} yet" in err
    assert by_topic(out)[IMAGES]


def test_an_mpeg_ts_stream_over_udp(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    port = free_port(socket.SOCK_DGRAM)
    url = f"udp://127.0.0.1:{port}"
    out = tmp_path / "out.mcap"
    recording = recorder("camera", out, "--camera", url, "--duration", 1)
    with av.open(url, "w", format="mpegts") as container:
        stream = container.add_stream("mpeg2video", rate=25)
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        stream.gop_size = 5
        pixels = np.full((120, 160, 3), 90, dtype=np.uint8)
        for _ in range(1500):
            if recording.poll() is not None:
                break
            for packet in stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")):
                container.mux(packet)
            time.sleep(0.02)
    ended(recording)
    images = by_topic(out)[IMAGES]
    assert len(images) > 5
    stamps = [m.log_time_ns for m in images]
    assert stamps == sorted(set(stamps))


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg")
def test_a_stream_of_ffmpeg_is_taken_without_its_backlog(tmp_path: Path) -> None:
    port = free_port(socket.SOCK_DGRAM)
    url = f"udp://127.0.0.1:{port}"
    out = tmp_path / "out.mcap"
    recording = recorder("camera", out, "--camera", url, "--duration", 2)
    picture = ["-f", "lavfi", "-i", "testsrc=size=160x120:rate=25", "-t", "60"]
    coded = ["-c:v", "mpeg2video", "-g", "5", "-f", "mpegts", f"{url}?pkt_size=1316"]
    with subprocess.Popen(["ffmpeg", "-loglevel", "error", "-re", *picture, *coded]) as sender:
        ended(recording)
        sender.kill()
    stamps = [m.log_time_ns for m in by_topic(out)[IMAGES]]
    # at 25 Hz, a busy machine stops late; what waited during the opening would come at once
    assert 10 < len(stamps) < 25 * (stamps[-1] - stamps[0]) / 1e9 + 10
    assert stamps == sorted(set(stamps))


def test_stamps_of_another_clock_are_pointed_out(tmp_path: Path, server: MjpegServer) -> None:
    port = free_port(socket.SOCK_DGRAM)
    sources = ("--camera", server.url, "--joints", f"udp://127.0.0.1:{port}")
    out = tmp_path / "out.mcap"
    recording = recorder("camera", out, *sources)
    assert server.connected.wait(30)
    server.show(jpeg_of(0))
    with udp_joints(port) as send:
        for _ in range(20):
            send(joint_line({"a": 0.0}, 1_700_000_000_000_000_000))
            time.sleep(0.02)
    time.sleep(0.3)
    err = ended(recording, signal.SIGINT)
    assert err.count("give --joint-stamps arrival") == 1


def test_until_enough_ends_by_itself(tmp_path: Path, server: MjpegServer) -> None:
    port = free_port(socket.SOCK_DGRAM)
    sources = ("--camera", server.url, "--joints", f"udp://127.0.0.1:{port}")
    rig = write_rig(RIG, tmp_path)
    out = tmp_path / "out.mcap"
    recording = recorder("camera", out, *sources, "--rig", rig, "--until-enough", "--json")
    assert server.connected.wait(30)
    with udp_joints(port) as send:
        for i in range(20_000):
            if recording.poll() is not None:
                break
            # by number, not by time: no load of the machine makes the wrist faster
            pitch, roll = angles(START_NS + i * FRAME_NS)
            send(joint_line({JOINTS[0]: pitch, JOINTS[1]: roll}, None))
            server.show(jpeg_of(0))
            time.sleep(0.005)
    document = json.loads(results(recording)[0])
    assert document["motion"]["verdict"] == "enough"
    assert document["motion"]["frames"] == 200
    assert "ended: the motion is enough" in document["notes"]
    info = json.loads(tooltip("info", out, "--json").out)
    assert info["usable_frames"] * document["read"][IMAGES] >= 190


def test_until_enough_needs_a_rig(tmp_path: Path) -> None:
    done = tooltip("record", "camera", tmp_path / "out.mcap", "--camera", "0", "--until-enough")
    assert done.code == 2
    assert "needs --rig" in done.err


def test_a_module_in_the_working_directory_gives_joints(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (
        "from tooltip_cli.sources.joints import JointSample\n"
        "def samples():\n"
        "    for i in range(3):\n"
        "        yield JointSample({'wrist': 0.5 * i}, 10**18 + i)\n"
        "def wrong():\n"
        "    yield 3\n"
    )
    (tmp_path / "my_robot.py").write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    halt = threading.Event()
    samples = list(joint_samples("my_robot:samples")(halt))
    assert samples == [JointSample({"wrist": 0.5 * i}, 10**18 + i) for i in range(3)]
    with pytest.raises(TooltipError, match="yields int, expected"):
        list(joint_samples("my_robot:wrong")(halt))
    with pytest.raises(TooltipError, match="cannot be imported"):
        list(joint_samples("my_robot:absent")(halt))


def test_rows_that_are_added_to_a_table_are_read(tmp_path: Path) -> None:
    path = tmp_path / "joints.csv"
    path.write_text("stamp,wrist\n1.0,0.1\n")
    halt = threading.Event()
    found: list[JointSample | str] = []
    first, last = JointSample({"wrist": 0.0}, 10**9), JointSample({"wrist": 0.5}, 4 * 10**9)

    def read() -> None:
        for sample in joint_samples(str(path))(halt):
            found.append(sample)
            if sample == last:
                return

    reader = threading.Thread(target=read)
    reader.start()
    with path.open("a", buffering=1) as file:

        def heard() -> bool:
            file.write("1,0\n")
            return bool(found)

        wait_for(heard, "a reader")
        for part in ("1700000000.000000001,0.", "25\n2,", "far\n3\n4,0.5\n"):
            file.write(part)
            file.flush()
            time.sleep(0.1)
    reader.join(30)
    halt.set()
    assert [sample for sample in found if sample != first] == [
        JointSample({"wrist": 0.25}, 1_700_000_000_000_000_001),
        "rows with a value that is no number",
        "rows with another number of values than the header has columns",
        last,
    ]


def test_a_table_that_is_emptied_ends_its_joints(tmp_path: Path) -> None:
    path, halt, heard = tmp_path / "joints.csv", threading.Event(), threading.Event()
    path.write_text("stamp,wrist\n")
    samples = joint_samples(str(path))(halt)

    def write() -> None:
        with path.open("a", buffering=1) as file:
            while not heard.wait(0.01):
                file.write("1.0,0.1\n")

    writer = threading.Thread(target=write)
    writer.start()
    assert next(samples) == JointSample({"wrist": 0.1}, 10**9)
    heard.set()
    writer.join()
    path.write_text("stamp,wrist\n")
    late = threading.Timer(30, halt.set)
    late.start()
    with pytest.raises(TooltipError, match="was replaced by another file"):
        list(samples)
    late.cancel()


def test_lines_over_tcp_may_come_in_pieces() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        spec = f"tcp://127.0.0.1:{listener.getsockname()[1]}"
        samples = joint_samples(spec)(threading.Event())
        found: list[object] = []

        def collect() -> None:
            try:
                for sample in samples:
                    found.append(sample)
            except TooltipError as error:
                found.append(str(error))

        reader = threading.Thread(target=collect)
        reader.start()
        connection, _ = listener.accept()
        with connection:
            connection.sendall(b'{"positions": {"a": 1')
            time.sleep(0.1)
            connection.sendall(b'}}\n{"positions": {"a": 2}}\n')
        reader.join(30)
    assert found == [
        JointSample({"a": 1.0}),
        JointSample({"a": 2.0}),
        f"{spec}: was closed by the other side",
    ]


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"{", "not JSON"),
        (b"\xff\xfe", "not JSON"),
        (b"[" * 100_000, "not JSON"),
        (b"3", "without 'positions'"),
        (b'{"positions": {}}', "without 'positions'"),
        (b'{"positions": {"a": NaN}}', "position that is no number"),
        (b'{"positions": {"a": 1e400}}', "position that is no number"),
        (b'{"positions": {"a": true}}', "position that is no number"),
        (b'{"positions": {"a": 1}, "stamp": "noon"}', "stamp that is no number"),
        (b'{"positions": {"a": 1}, "stamp": -1}', "ROS cannot hold"),
        (b'{"positions": {"a": 1}, "stamp": 1e19}', "ROS cannot hold"),
    ],
)
def test_lines_that_are_no_samples_say_why(line: bytes, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        sample_from_json(line)


def test_seconds_keep_their_nanoseconds() -> None:
    sample = sample_from_json(b'{"stamp": 1700000000.123456789, "positions": {"a": -1}}')
    assert sample == JointSample({"a": -1.0}, 1_700_000_000_123_456_789)


@pytest.mark.parametrize("spec", ["joints", "udp://host", "udp://host:99999", "http://x:1", ":a"])
def test_sources_of_joints_that_are_none(spec: str) -> None:
    with pytest.raises(TooltipError, match="expected"):
        joint_samples(spec)
