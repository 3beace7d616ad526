"""``tooltip watch`` through the real command: played recordings, a live camera, Ctrl-C."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.helpers.cli import tooltip
from tests.helpers.live import MjpegServer, free_port, play, played, udp_joints
from tests.helpers.logs import (
    FRAME_NS,
    Log,
    image_message,
    jpeg_of,
    logged_image,
    stamp_of,
    wrist_parts,
)
from tests.helpers.robot import CAMERA, CAMERA_FRAME, RIG
from tests.test_stage_voting import simulate, truth
from tooltip_cli.errors import TooltipError
from tooltip_cli.log.messages import COMPRESSED_IMAGE, IMAGE, Message, encode, header
from tooltip_cli.log.recording import Recording, read_recording
from tooltip_cli.log.stopping import Stop
from tooltip_cli.log.views import resolve_rig, resolve_views
from tooltip_cli.method.voting.params import PairingParams, VotingSettings
from tooltip_cli.rig.rigfile import Rig
from tooltip_cli.stages.calibrate import write_rig
from tooltip_cli.stages.feeds import PlayedFeed
from tooltip_cli.stages.keeping import FrameKeeper
from tooltip_cli.stages.moving import find_moving_edges
from tooltip_cli.stages.voting import pair_views
from tooltip_cli.stages.watch import Update, WatchOptions, watch

ROOT = Path(__file__).parents[1]
REGION = 7.815  # 95 % of a chi-squared distribution with three degrees of freedom


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a small recording with labels, which nobody may change."""
    return simulate(tmp_path_factory.mktemp("watch") / "small.mcap", 100, "240x180")


@pytest.fixture(scope="session")
def batch(small: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Return what ``estimate`` says of it."""
    done = tooltip("estimate", small, "--out", tmp_path_factory.mktemp("batch"), "--json")
    document: dict[str, Any] = json.loads(done.out)
    return document


def updates(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text.splitlines()]


def deviations(tip: dict[str, Any], other: dict[str, Any]) -> float:
    """Return the squared distance of another tip in units of this one's covariance."""
    away = np.subtract(other["position_m"], tip["position_m"])
    return float(away @ np.linalg.solve(np.array(tip["covariance_m2"]), away))


def settled(document: dict[str, Any]) -> dict[str, Any]:
    """Return what must not depend on how busy the machine is."""
    timed = ("delay_s", "compute_s", "behind_s", "motion", "provenance")
    return {name: value for name, value in document.items() if name not in timed}


def test_it_ends_with_the_estimate_of_the_whole_recording(
    small: Path, batch: dict[str, Any]
) -> None:
    done = tooltip("watch", small, "--speed", 0, "--json")
    assert done.code == 0, done.err
    *earlier, last = updates(done.out)
    assert [item["final"] for item in (*earlier, last)] == [False] * len(earlier) + [True]
    assert all("provenance" not in item for item in earlier)
    assert last["provenance"]["recording"] == "small.mcap"
    assert last["images"] == 100
    assert last["passed_over"] == last["unreadable"] == last["dropped"] == 0
    # the same pairs were found; images with labels are left out by both
    assert last["held"] == last["frames_used"] == batch["frames_used"]
    assert deviations(last["tip"], batch["tip"]) < REGION
    assert last["candidates"][0]["agreement"] == pytest.approx(
        batch["candidates"][0]["agreement"], abs=0.1
    )
    assert list(small.parent.glob("*.tip.json")) == []  # nothing is written unasked


def test_the_last_estimate_does_not_depend_on_the_pace(small: Path) -> None:
    runs = [
        updates(tooltip("watch", small, "--speed", speed, "--json", "--every", every).out)[-1]
        for speed, every in ((0, 0.1), (0, 100))
    ]
    assert settled(runs[0]) == settled(runs[1])


def test_a_line_an_update_and_a_sentence_at_the_end(small: Path, tmp_path: Path) -> None:
    done = tooltip("watch", "--speed", 0, "--every", 0.1, small, "--out", tmp_path)
    assert done.code == 0, done.err
    assert done.out.startswith("small: tip at x ")
    lines = [line for line in done.err.splitlines() if "images" in line]
    assert len(lines) >= 2
    assert all("delay" in line for line in lines)
    path = tmp_path / "small.tip.json"
    assert f"{small}: written {path}" in done.err
    document = json.loads(path.read_text())
    error = np.subtract(document["tip"]["position_m"], truth(small)["tip_in_hand_m"])
    assert np.linalg.norm(error) < 0.015
    assert document["provenance"]["recording_sha256"] == read_recording(small).sha256


def test_a_tip_file_is_not_replaced_unasked(small: Path, tmp_path: Path) -> None:
    path = tmp_path / "small.tip.json"
    path.write_text("mine")
    done = tooltip("watch", small, "--out", tmp_path, "--speed", 0)
    assert done.code == 1
    assert f"{path} exists already" in done.error
    assert path.read_text() == "mine"
    done = tooltip("watch", small, "--out", tmp_path, "--speed", 0, "--force")
    assert done.code == 0
    assert json.loads(path.read_text())["status"] == "ok"


class Stepwise(PlayedFeed):
    """Hands out 30 images, then nothing before the next update."""

    def __init__(self, path: Path) -> None:
        log = read_recording(path)
        self.rig = full(log)
        super().__init__(log, self.rig, 0.0)
        self.updates: list[Update] = []
        self._images, self._updated = 0, threading.Event()

    def hear(self, update: Update) -> None:
        self.updates.append(update)
        self._updated.set()

    def take(self) -> list[Message]:
        if self._images and self._images % 30 == 0:
            if not self._updated.wait(0.02):
                return []
            self._updated.clear()
        found = super().take()
        self._images += any(message.topic == self.image_topic for message in found)
        return found

    def watch(self, options: WatchOptions, settings: VotingSettings) -> Update:
        return watch(self, self.rig, options, settings, stop=Stop(), on_update=self.hear)


def test_uncertainty_falls(small: Path) -> None:
    feed = Stepwise(small)
    last = feed.watch(WatchOptions(every_s=0.0), VotingSettings())
    assert feed.updates[-1] is last
    held = [update.counts.held for update in feed.updates]
    assert held == sorted(held)
    stated = [
        float(np.trace(update.estimate.covariance))
        for update in feed.updates
        if update.estimate.covariance is not None
    ]
    assert len(stated) >= 2
    assert stated[-1] < stated[0]


def test_until_enough_ends_before_the_recording(small: Path) -> None:
    settings = VotingSettings(pairing=PairingParams(frames=40))
    last = Stepwise(small).watch(WatchOptions(every_s=0.0, until_enough=True), settings)
    assert last.final
    assert last.estimate.position is not None
    assert last.counts.held == 40
    assert last.counts.images < 100


@pytest.mark.parametrize(
    ("motion", "code"), [("in_plane", "depth_unobservable"), ("still", "no_motion")]
)
def test_motion_that_shows_nothing_is_refused_in_the_end(
    tmp_path: Path, motion: str, code: str
) -> None:
    path = simulate(tmp_path / "small.mcap", 50, "160x120", motion)
    done = tooltip("watch", path, "--speed", 0, "--out", tmp_path / "out")
    assert done.code == 3
    assert done.out == f"small: refused ({code})\n"
    assert f"refused: {code}: " in done.err
    document = json.loads((tmp_path / "out" / "small.tip.json").read_text())
    assert document["status"] == "refused"
    assert document["tip"] is None


def test_what_is_no_recording(tmp_path: Path, small: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(small.read_bytes()[:-5000])
    for path, what in (
        (tmp_path / "absent.mcap", "cannot be opened"),
        (cut, "is truncated"),
        (tmp_path, "is a directory"),
    ):
        done = tooltip("watch", path)
        assert done.code == 1
        assert what in done.error
    assert tooltip("watch", small, "--speed", -1).code == 2
    assert tooltip("watch", "camera", "--camera", "0").code == 2  # no rig
    assert tooltip("watch", "--help").code == 0
    bare = tooltip("watch", small, "--rig", tmp_path / "no.yaml")
    assert bare.code == 1
    assert "no.yaml" in bare.error


class Watching:
    """A real ``tooltip watch`` process."""

    def __init__(self, *arguments: object) -> None:
        command = [sys.executable, "-m", "tooltip_cli.cli.main", "watch", *arguments, "--json"]
        self.process = subprocess.Popen(
            [str(item) for item in command],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=ROOT,
        )

    def first(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        document: dict[str, Any] = json.loads(self.process.stdout.readline())
        return document

    def end(self, number: int | None = None) -> tuple[int, list[dict[str, Any]], str]:
        if number is not None:
            self.process.send_signal(number)
        out, err = self.process.communicate(timeout=120)
        return self.process.returncode, updates(out), err


def test_ctrl_c_gives_the_last_estimate(small: Path, tmp_path: Path) -> None:
    watching = Watching(small, "--speed", 0.2, "--out", tmp_path)
    assert not watching.first()["final"]
    code, rest, err = watching.end(signal.SIGINT)
    assert rest[-1]["final"], err
    assert rest[-1]["images"] < 100
    assert code == (0 if rest[-1]["status"] == "ok" else 3)
    assert json.loads((tmp_path / "small.tip.json").read_text())["status"] == rest[-1]["status"]
    assert "Traceback" not in err


def full_rig(recording: Path, folder: Path) -> Path:
    """Write a rig that holds the intrinsics and the robot, as a live camera needs it."""
    return write_rig(full(read_recording(recording)), folder)


def full(log: Recording) -> Rig:
    rig = resolve_rig(log, None)
    return replace(rig, camera=rig.camera or log.camera, urdf=rig.urdf or log.urdf)


@contextmanager
def camera_robot() -> Iterator[tuple[MjpegServer, int]]:
    server = MjpegServer()
    try:
        yield server, free_port(socket.SOCK_DGRAM)
    finally:
        server.close()


def test_a_live_camera_with_joints_over_a_socket(small: Path, tmp_path: Path) -> None:
    rig = full_rig(small, tmp_path / "rig")
    # slowly, so that a busy machine's late arrivals move the hand by little
    items = [replace(item, at_s=3 * item.at_s) for item in played(small)]
    with camera_robot() as (server, port):
        sources = ("--camera", server.url, "--joints", f"udp://127.0.0.1:{port}", "--rig", rig)
        watching = Watching("camera", *sources, "--out", tmp_path)
        assert server.connected.wait(60)
        with udp_joints(port) as send:
            play(items, server.show, send)
        server.show(b"")  # hangs up
        code, told, err = watching.end()
    assert code == 0, err
    assert len(told) >= 2
    last = told[-1]
    assert last["images"] == 100
    error = np.subtract(last["tip"]["position_m"], truth(small)["tip_in_hand_m"])
    assert np.linalg.norm(error) < 0.02
    assert last["provenance"]["recording"] is None
    assert json.loads((tmp_path / "camera.tip.json").read_text())["tip"] == last["tip"]


@pytest.mark.parametrize(
    ("lacks", "what"),
    [
        ("joints", "no joint states were heard"),
        ("camera", "no intrinsics, neither in the rig nor as CameraInfo"),
    ],
)
def test_what_a_live_source_lacks_is_said(
    small: Path, tmp_path: Path, lacks: str, what: str
) -> None:
    rig = full_rig(small, tmp_path / "rig")
    if lacks == "camera":
        text = rig.read_text().replace("  info: camera.yaml\n", "")
        rig.write_text(text)
    images = [item.image for item in played(small) if item.image]
    with camera_robot() as (server, port):
        sources = ("--camera", server.url, "--joints", f"udp://127.0.0.1:{port}", "--rig", rig)
        watching = Watching("camera", *sources)
        assert server.connected.wait(60)
        for image in images:
            server.show(image)
        done = threading.Event()
        threading.Timer(4.0, done.set).start()
        done.wait()
        server.show(b"")
        code, told, err = watching.end()
    assert code == 1
    assert told == []
    assert f"no estimate can be made yet: {what}" in err
    assert f"Error: the hand's pose is unknown at every image: {what}" in err


def keeper_of(
    messages: list[Message],
    settings: VotingSettings | None = None,
    *,
    rig: Rig = RIG,
    late_by_s: float = 0.0,
) -> FrameKeeper:
    """Return what keeps the frames of messages that are each looked at so late."""
    keeper = FrameKeeper(rig, settings or VotingSettings())
    now_ns = 0
    for message in sorted(messages, key=lambda item: item.log_time_ns):
        now_ns = message.log_time_ns + round(late_by_s * 1e9)
        keeper.follower.take(message)
        keeper.advance(lambda: now_ns, 0.5)  # noqa: B023  (called at once)
    return keeper


def messages_of(frames: int) -> list[Message]:
    return [message for part in wrist_parts(frames).values() for message in part]


def test_what_is_kept_is_bounded() -> None:
    pairing = PairingParams(frames=12)
    keepers = [
        keeper_of(messages_of(frames), VotingSettings(pairing=pairing)) for frames in (60, 240)
    ]
    for keeper in keepers:
        assert keeper.held == 12
        assert len(keeper.snapshot().frames) == 12
        assert keeper.window <= 2 * pairing.max_gap + 1
    assert keepers[1].changes > keepers[0].changes


def test_fast_motion_is_followed_as_by_an_estimate(wrist: Log) -> None:
    """For these search windows the hand is fast: images are halved, some of them twice."""
    pairing = PairingParams(displacement_px=1.0, min_displacement_px=0.5, max_displacement_px=1.5)
    settings = VotingSettings(pairing=pairing)
    views = resolve_views(read_recording(wrist.path), RIG)
    chosen, _ = pair_views(views, settings, views.known)
    assert {1, 2} <= set(chosen.levels.tolist())
    keeper = keeper_of(messages_of(wrist.frames), settings)
    keeper.advance(lambda: 0, 0.0, at_end=True)
    held = keeper.snapshot().frames
    assert [item.frame for item in held] == chosen.frames.tolist()
    assert [item.level for item in held] == chosen.levels.tolist()
    found = find_moving_edges(read_recording(wrist.path), views, chosen, settings, 1)
    assert sum(found.counts) > 0
    assert [len(item.edges.pixels) for item in held] == pytest.approx(found.counts, rel=0.1)


def test_images_that_come_too_fast_are_passed_over_and_counted() -> None:
    keeper = keeper_of(messages_of(60), late_by_s=1.0)
    assert keeper.held == 0
    assert keeper.passed_over > 20
    assert keeper_of(messages_of(60), late_by_s=0.3).passed_over == 0


def test_a_damaged_image_is_left_out_with_those_that_need_it() -> None:
    messages = messages_of(60)
    whole = keeper_of(messages)
    for i, message in enumerate(messages):
        if message.datatype == COMPRESSED_IMAGE and message.log_time_ns == stamp_of(30):
            messages[i] = image_message(stamp_of(30), b"\xff\xd8\xff nothing")
    keeper = keeper_of(messages)
    assert 1 <= keeper.unreadable <= 15
    assert keeper.held == whole.held - keeper.unreadable


@pytest.mark.parametrize("apart_s", [-100, 100])
def test_clocks_that_are_apart_are_pointed_out(apart_s: int) -> None:
    messages = messages_of(40)
    for i, message in enumerate(messages):
        if message.datatype == COMPRESSED_IMAGE:
            stamp_ns = message.log_time_ns + apart_s * 10**9
            messages[i] = replace(image_message(stamp_ns, jpeg_of(0)), log_time_ns=stamp_ns)
    follower = keeper_of(messages).follower
    follower.passed(at_end=True)
    assert f"stamped {apart_s - 0.1:+.1f} s off the latest joints" in follower.missing
    whole = keeper_of(messages_of(40)).follower
    assert whole.missing == ""


def test_raw_images_are_held_as_jpeg() -> None:
    messages = messages_of(60)
    for i, message in enumerate(messages):
        if message.datatype == COMPRESSED_IMAGE:
            pixels = logged_image(round((message.log_time_ns - stamp_of(0)) / FRAME_NS))
            height, width = pixels.shape[:2]
            fields = {"height": height, "width": width, "encoding": "mono8", "step": width}
            head = header(message.log_time_ns, CAMERA_FRAME)
            payload = encode(IMAGE, {"header": head, **fields, "data": pixels.tobytes()})
            messages[i] = replace(message, datatype=IMAGE, payload=payload)
    frames = keeper_of(messages).snapshot().frames
    assert len(frames) > 20
    assert {held.message.datatype for held in frames} == {COMPRESSED_IMAGE}
    raw = [len(message.payload) for message in messages if message.datatype == IMAGE]
    assert max(len(held.message.payload) for held in frames) < 0.7 * min(raw)


def test_images_that_run_backwards_or_come_twice_are_ignored() -> None:
    messages = messages_of(60)
    whole = keeper_of(messages).snapshot()
    images = [item for item in messages if item.datatype == COMPRESSED_IMAGE]
    late = [replace(item, log_time_ns=item.log_time_ns + 1) for item in images]
    again = keeper_of(messages + late + [replace(images[3], log_time_ns=images[50].log_time_ns)])
    assert [held.frame for held in again.snapshot().frames] == [held.frame for held in whole.frames]
    for one, other in zip(again.snapshot().frames, whole.frames, strict=True):
        np.testing.assert_array_equal(one.edges.pixels, other.edges.pixels)


def test_images_of_another_size_than_the_intrinsics_are_an_error() -> None:
    camera = replace(CAMERA, width=2 * CAMERA.width, height=2 * CAMERA.height)
    with pytest.raises(TooltipError, match="calibrate at that size"):
        keeper_of(messages_of(60), rig=replace(RIG, camera=camera))
