"""``tooltip info``: every line has a verdict, and those that are not ok a remedy."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import Writer as McapWriter

from tests.helpers.cli import tooltip, tooltip_process
from tests.helpers.logs import (
    FRAMES,
    IMAGE_TOPIC,
    JOINT_TOPIC,
    Parts,
    encoded,
    image_message,
    image_of,
    info_message,
    joint_message,
    jpeg_of,
    stamp_of,
    wrist_parts,
    write_log,
)
from tests.helpers.robot import CAMERA, RIG
from tooltip_cli.log.messages import Message
from tooltip_cli.log.timing import nearest_s, timing
from tooltip_cli.method.motion import hand_motion
from tooltip_cli.rig.camera import CameraModel
from tooltip_cli.stages.info import Finding, Info, inspect


def of(info: Info, subject: str) -> Finding:
    found = [item for item in info.findings if item.subject == subject]
    assert len(found) == 1, info.findings
    return found[0]


def looked_at(tmp_path: Path, change: Callable[[Parts], None] = lambda parts: None) -> Info:
    parts = {role: list(messages) for role, messages in wrist_parts().items()}
    change(parts)
    return inspect(write_log(tmp_path / "a.mcap", parts))


def test_a_good_recording(wrist_file: Path) -> None:
    info = inspect(wrist_file)
    assert (info.state, info.profile) == ("whole", "ros2")
    assert info.image_size == (CAMERA.width, CAMERA.height)
    levels = {item.subject: item.level for item in info.findings}
    assert levels["file"] == levels["calibration"] == levels["joints"] == "ok"
    assert levels["synchronisation"] == "ok"
    streams = {stream.topic: stream for stream in info.streams}
    assert streams[IMAGE_TOPIC].timing.count == FRAMES
    assert streams[IMAGE_TOPIC].timing.rate_hz == pytest.approx(30.0, rel=1e-3)
    assert streams[JOINT_TOPIC].timing.rate_hz == pytest.approx(100.0)
    assert (streams[JOINT_TOPIC].clock, streams["/robot_description"].clock) == ("header", "log")
    assert info.synchronisation is not None
    assert info.synchronisation.known == info.synchronisation.images == FRAMES
    assert info.synchronisation.interpolated_s == pytest.approx(0.01)
    assert 0 < info.synchronisation.nearest_s <= 0.005
    assert info.motion is not None
    assert 40 < info.motion.turn_deg < 70  # two axes of +-0.4 rad
    assert 0 <= (info.usable_frames or 0.0) <= 1


def test_the_verdict_is_the_worst_line(wrist_file: Path, tmp_path: Path) -> None:
    info = Info(tmp_path, 0, "whole", "", "")
    assert info.verdict == "ok"
    info.add("ok", "a", "fine")
    info.add("warning", "b", "hm")
    assert info.verdict == "warning"
    info.add("error", "c", "no")
    assert info.verdict == "error"


def test_it_agrees_with_estimate_about_the_motion(wrist_file: Path, tmp_path: Path) -> None:
    path = Path(shutil.copy(wrist_file, tmp_path / "wrist.mcap"))
    pairs = of(inspect(path), "pairs")
    done = json.loads(tooltip("estimate", path, "--json").out)
    codes = {reason["code"] for reason in done["reasons"]}
    assert (pairs.level == "error") == bool(codes & {"no_motion", "too_fast", "depth_unobservable"})


def test_a_still_hand(tmp_path: Path) -> None:
    def still(parts: Parts) -> None:
        parts["joints"] = [
            joint_message(message.log_time_ns, ("wrist_pitch", "wrist_roll"), (0.1, 0.2))
            for message in parts["joints"]
        ]

    info = looked_at(tmp_path, still)
    assert "never moved: wrist_pitch, wrist_roll" in of(info, "joints").text
    assert of(info, "pairs").level == "error"
    assert "turn the wrist further" in of(info, "pairs").remedy
    assert info.motion is not None
    assert info.motion.turn_deg == pytest.approx(0.0, abs=1e-3)


def drop_images(parts: Parts) -> None:
    del parts["images"][10:14]


def repeat_an_image(parts: Parts) -> None:
    parts["images"].append(parts["images"][3])


def turn_back(parts: Parts) -> None:
    late = parts["images"][5]
    parts["images"][5] = replace(late, log_time_ns=late.log_time_ns + 10**9)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (drop_images, "about 4 messages are missing in 1 gaps, the longest of 0.17 s"),
        (repeat_an_image, "1 stamps occur twice"),
        (turn_back, "1 stamps run backwards"),
    ],
)
def test_odd_streams(change: Callable[[Parts], None], words: str, tmp_path: Path) -> None:
    finding = of(looked_at(tmp_path, change), IMAGE_TOPIC)
    assert finding.level == "warning"
    assert words in finding.text
    assert finding.remedy


def uncalibrated(parts: Parts) -> None:
    parts["info"] = []


def other_size(parts: Parts) -> None:
    camera = CameraModel(320, 240, 280.0, 282.0, 159.5, 119.5, "plumb_bob", (0.0,) * 5)
    parts["info"] = [info_message(camera)]


def in_millimetres(parts: Parts) -> None:
    camera = CameraModel(160, 120, 3.5, 3.5, 79.5, 59.5, "plumb_bob", (0.0,) * 5)
    parts["info"] = [info_message(camera)]


@pytest.mark.parametrize(
    ("change", "level", "words"),
    [
        (uncalibrated, "error", "is not calibrated"),
        (other_size, "error", "for 320x240, but the images have another size"),
        (in_millimetres, "warning", "no ordinary camera, it would see 175 degrees across"),
    ],
)
def test_calibrations(
    change: Callable[[Parts], None], level: str, words: str, tmp_path: Path
) -> None:
    parts = {role: list(messages) for role, messages in wrist_parts(6).items()}
    change(parts)
    rig = replace(RIG, camera=None)
    finding = of(inspect(write_log(tmp_path / "a.mcap", parts, rig=rig)), "calibration")
    assert finding.level == level
    assert words in finding.text


def test_missing_joints_are_named(tmp_path: Path) -> None:
    def rename(parts: Parts) -> None:
        parts["joints"] = [
            joint_message(message.log_time_ns, ("pitch", "wrist_roll"), (0.1, 0.2))
            for message in parts["joints"]
        ]

    finding = of(looked_at(tmp_path, rename), "joints")
    assert finding.level == "error"
    assert "the log lacks wrist_pitch" in finding.text
    assert "logged: pitch, wrist_roll" in finding.remedy


def test_degrees_are_suspected(tmp_path: Path) -> None:
    def degrees(parts: Parts) -> None:
        parts["joints"] = [
            joint_message(m.log_time_ns, ("wrist_pitch", "wrist_roll"), (20.0 + i % 7, -11.0))
            for i, m in enumerate(parts["joints"])
        ]

    finding = of(looked_at(tmp_path, degrees), "joints")
    assert finding.level == "warning"
    assert "beyond the URDF's limits: wrist_pitch, wrist_roll" in finding.text
    assert "radians" in finding.remedy


def test_joints_that_start_late(tmp_path: Path) -> None:
    def late(parts: Parts) -> None:
        parts["joints"] = [m for m in parts["joints"] if m.log_time_ns > stamp_of(10)]

    info = looked_at(tmp_path, late)
    finding = of(info, "synchronisation")
    assert finding.level == "warning"
    assert info.synchronisation is not None
    assert info.synchronisation.known < FRAMES - 9


def test_clocks_that_never_meet(tmp_path: Path) -> None:
    def years_apart(parts: Parts) -> None:
        parts["joints"] = [
            joint_message(m.log_time_ns - 10**17, ("wrist_pitch", "wrist_roll"), (0.1, 0.2))
            for m in parts["joints"]
        ]

    finding = of(looked_at(tmp_path, years_apart), "synchronisation")
    assert finding.level == "error"
    assert "check the clocks" in finding.text


def test_without_a_rig_the_rest_is_said(tmp_path: Path) -> None:
    info = inspect(write_log(tmp_path / "a.mcap", wrist_parts(5), rig=None))
    assert of(info, "rig").level == "warning"
    assert of(info, "calibration").level == "ok"
    assert "--rig" in of(info, "rig").text


def test_images_of_several_sizes(tmp_path: Path) -> None:
    def shrink(parts: Parts) -> None:
        small = encoded(image_of(0)[::2, ::2], ".jpg")
        parts["images"][-1] = image_message(stamp_of(FRAMES - 1), small)

    assert "the image size changes" in of(looked_at(tmp_path, shrink), "images").text


def test_logs_that_are_no_recordings(tmp_path: Path) -> None:
    path = write_log(tmp_path / "a.mcap", wrist_parts(3)["joints"], rig=None)
    finding = of(inspect(path), "recording")
    assert finding.level == "error"
    assert "no image topic" in finding.text


def test_foreign_encodings_and_missing_checksums(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file, enable_crcs=False)
        writer.start("", "test")
        channel = writer.register_channel("/a\x1b[31m\n", "json", 0)
        writer.add_message(channel, 5, b"{}", 5)
        writer.finish()  # type: ignore[no-untyped-call]  # the library's own gap
    info = inspect(path)
    assert "damage would not be seen" in of(info, "file").text
    assert "its encoding 'json' is not read" in of(info, "/a\x1b[31m\n").text
    done = tooltip("info", path)
    assert "\x1b" not in done.out


@pytest.mark.parametrize("cut", [0.2, 0.5, 0.7])
def test_damaged_files_are_read_as_far_as_they_go(cut: float, tmp_path: Path) -> None:
    path = write_log(tmp_path / "a.mcap", wrist_parts())
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * cut)])
    info = inspect(path)
    finding = of(info, "file")
    assert info.state == "truncated"
    assert finding.level == "error"
    assert f"tooltip salvage {path}" in finding.remedy
    counts = {stream.topic: stream.timing.count for stream in info.streams}
    assert counts.get(IMAGE_TOPIC, 0) < FRAMES


def test_the_command(wrist_file: Path) -> None:
    done = tooltip_process("info", wrist_file, COLUMNS="100")
    assert done.err == ""
    lines = done.out.splitlines()
    assert lines[0].startswith(f"{wrist_file}: whole, ")
    assert any(line.startswith("ok") and IMAGE_TOPIC in line for line in lines)
    assert max(map(len, lines[8:])) <= 100
    document = json.loads(tooltip("info", wrist_file, "--json").out)
    assert document["verdict"] in ("ok", "warning", "error")
    assert {"streams", "findings", "synchronisation", "motion"} <= set(document)
    assert done.code == (1 if document["verdict"] == "error" else 0)


def test_topics_are_chosen_as_elsewhere(tmp_path: Path) -> None:
    messages: list[Message] = [
        image_message(stamp_of(i), jpeg_of(i), topic) for i in range(3) for topic in ("/a", "/b")
    ]
    path = write_log(tmp_path / "a.mcap", messages, rig=None)
    assert "several topics for image: /a, /b" in of(inspect(path), "recording").text
    assert "--image" in tooltip("info", path).out
    assert "3 of 160x120 on /b" in tooltip("info", path, "--image", "/b").out


def test_timing_of_a_steady_stream_with_a_hole() -> None:
    stamps = np.array([0, 10, 20, 30, 70, 80, 90], dtype=np.int64) * 10**6
    found = timing(stamps)
    assert (found.gaps, found.missing, found.longest_gap_s) == (1, 3, 0.04)
    assert found.rate_hz == 100.0
    assert found.duration_s == 0.09


def test_timing_of_one_stamp() -> None:
    found = timing(np.array([7], dtype=np.int64))
    assert (found.count, found.rate_hz, found.gaps) == (1, 0.0, 0)


@given(st.lists(st.integers(0, 10**12), min_size=1, max_size=40))
def test_timing_counts_everything(values: list[int]) -> None:
    found = timing(np.array(values, dtype=np.int64))
    assert found.count == len(values)
    assert found.duplicates == len(values) - len(set(values))
    later = zip(values[1:], values[:-1], strict=True)
    assert found.reversals == sum(second < first for second, first in later)
    assert (found.first_ns, found.last_ns) == (min(values), max(values))


@given(
    st.lists(st.integers(0, 10**6), min_size=1, max_size=20, unique=True),
    st.lists(st.integers(-(10**6), 2 * 10**6), min_size=1, max_size=20),
)
def test_nearest_is_the_nearest(stamps: list[int], query: list[int]) -> None:
    found = nearest_s(np.array(sorted(stamps)), np.array(query))
    expected = [min(abs(q - s) for s in stamps) / 1e9 for q in query]
    np.testing.assert_allclose(found, expected)


def test_motion_of_a_hand_that_turns_about_one_axis() -> None:
    angles = np.linspace(0, np.pi / 2, 46)  # 2 degrees a step
    poses: Any = np.tile(np.eye(4), (len(angles), 1, 1))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(angles)
    poses[:, 1, 0], poses[:, 0, 1] = np.sin(angles), -np.sin(angles)
    poses[:, 2, 3] = np.linspace(0, 0.3, len(angles))
    found = hand_motion(poses, np.arange(len(angles)) / 10)
    assert found.turn_deg == pytest.approx(90.0)
    assert found.travel_m == pytest.approx(0.3)
    assert found.speed_deg_s == pytest.approx(20.0)
    assert found.fastest_deg_s == pytest.approx(20.0)
