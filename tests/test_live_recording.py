"""The core of a live recording: the queue, the ends, and what is told on the way."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.logs import IMAGE_TOPIC, JOINT_TOPIC, image_message, joint_message, jpeg_of
from tooltip_cli.errors import LowDiskError, TooltipError
from tooltip_cli.log import messages
from tooltip_cli.log.container import LoggedMessage, iterate
from tooltip_cli.log.crashsafe import CrashSafeWriter
from tooltip_cli.log.messages import Message
from tooltip_cli.log.stopping import Stop
from tooltip_cli.rig.rigfile import Rig
from tooltip_cli.sources.base import SourceReport
from tooltip_cli.sources.live import ArrivalClock, Backlog, Deliver, Receiver
from tooltip_cli.stages.live import METADATA, LiveOptions, Status, record_live

Run = Callable[[Deliver, threading.Event], None]
_PICTURE = 130_000


@dataclass
class Sender:
    run: Run
    name: str = "the sender"


@dataclass
class Robot:
    """Receivers that a test writes as functions."""

    runs: Sequence[Run]
    image_topic: str = IMAGE_TOPIC
    expected_topics: Sequence[str] = (IMAGE_TOPIC, JOINT_TOPIC)
    rig: Rig | None = None
    report: SourceReport = field(default_factory=SourceReport)

    def first_messages(self) -> Sequence[Message]:
        return []

    def receivers(self) -> Sequence[Receiver]:
        return [Sender(run) for run in self.runs]

    def metadata(self) -> Mapping[str, str]:
        return {"stamps": "made up"}


def images(count: int) -> Run:
    """Return a receiver that delivers images and has then ended."""

    def run(deliver: Deliver, halt: threading.Event) -> None:
        for i in range(count):
            deliver(image_message(10**18 + i, jpeg_of(0)))

    return run


def logged(path: Path) -> list[LoggedMessage]:
    return [item for item in iterate(path) if isinstance(item, LoggedMessage)]


def picture() -> Message:
    return Message("/big", messages.IMAGE, 1, bytes(_PICTURE))


def test_everything_received_before_the_end_is_written(tmp_path: Path) -> None:
    robot = Robot([images(500)])
    record_live(robot, tmp_path / "out.mcap", LiveOptions(), stop=Stop())
    assert [m.log_time_ns for m in logged(tmp_path / "out.mcap")] == [
        10**18 + i for i in range(500)
    ]
    assert robot.report.read == {IMAGE_TOPIC: 500}
    assert "ended: the sender has ended" in robot.report.notes
    assert [path.name for path in tmp_path.iterdir()] == ["out.mcap"]


def test_how_stamps_came_about_is_in_the_log(tmp_path: Path) -> None:
    from mcap.reader import make_reader

    record_live(Robot([images(1)]), tmp_path / "out.mcap", LiveOptions(), stop=Stop())
    with (tmp_path / "out.mcap").open("rb") as file:
        found = {item.name: item.metadata for item in make_reader(file).iter_metadata()}
    assert found == {METADATA: {"stamps": "made up"}}


def test_stop_drains_and_closes(tmp_path: Path) -> None:
    stop = Stop()

    def run(deliver: Deliver, halt: threading.Event) -> None:
        for i in range(300):
            deliver(image_message(10**18 + i, jpeg_of(0)))
        stop.request("test")
        halt.wait()

    record_live(Robot([run]), tmp_path / "out.mcap", LiveOptions(), stop=stop)
    assert len(logged(tmp_path / "out.mcap")) == 300


def test_a_disk_that_is_too_slow_costs_counted_messages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = CrashSafeWriter.write
    gate = threading.Event()

    def slow(self: CrashSafeWriter, message: Message) -> None:
        gate.wait()
        write(self, message)

    monkeypatch.setattr(CrashSafeWriter, "write", slow)

    def run(deliver: Deliver, halt: threading.Event) -> None:
        for i in range(100):
            deliver(image_message(10**18 + i, bytes(100_000)))
            deliver(joint_message(10**18 + i, ["a"], [0.1]))
        gate.set()

    robot = Robot([run])
    options = LiveOptions(queue_bytes=1_000_000)
    record_live(robot, tmp_path / "out.mcap", options, stop=Stop())
    kept = [m.topic for m in logged(tmp_path / "out.mcap")]
    assert kept.count(JOINT_TOPIC) == 100
    lost = robot.report.dropped[
        f"messages on {IMAGE_TOPIC} that came faster than they could be written"
    ]
    assert kept.count(IMAGE_TOPIC) + lost == 100
    assert 7 <= kept.count(IMAGE_TOPIC) <= 10


def test_silence_and_return_of_a_stream_are_told(tmp_path: Path) -> None:
    def run(deliver: Deliver, halt: threading.Event) -> None:
        for i in range(24):
            deliver(image_message(10**18 + i, jpeg_of(0)))
            if i == 20:
                deliver(joint_message(10**18 + i, ["a"], [0.1]))
            time.sleep(0.1)

    told: list[str] = []
    seen: list[Status] = []
    record_live(
        Robot([run]),
        tmp_path / "out.mcap",
        LiveOptions(),
        stop=Stop(),
        on_status=seen.append,
        on_note=told.append,
    )
    assert told[0] == f"nothing on {JOINT_TOPIC} yet"
    assert told[1].startswith(f"{JOINT_TOPIC} is heard after ")
    silent = {
        stream.silent for status in seen for stream in status.streams if "joint" in stream.topic
    }
    assert silent == {False, True}
    assert max(status.streams[0].rate_hz for status in seen) > 3


def test_failures_of_a_receiver_end_the_recording_in_a_sentence(tmp_path: Path) -> None:
    def run(deliver: Deliver, halt: threading.Event) -> None:
        images(2)(deliver, halt)
        raise OSError("unplugged")

    robot = Robot([run])
    record_live(robot, tmp_path / "out.mcap", LiveOptions(), stop=Stop())
    assert "ended: the sender failed (OSError: unplugged)" in robot.report.notes


def test_without_images_no_file_is_left(tmp_path: Path) -> None:
    def run(deliver: Deliver, halt: threading.Event) -> None:
        deliver(joint_message(10**18, ["a"], [0.1]))
        raise TooltipError("the arm is off")

    with pytest.raises(TooltipError, match="no image came: the arm is off"):
        record_live(Robot([run]), tmp_path / "out.mcap", LiveOptions(), stop=Stop())
    assert not list(tmp_path.iterdir())


def test_a_disk_that_fills_up_leaves_a_finished_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = [10**9]
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=free[0]))

    def run(deliver: Deliver, halt: threading.Event) -> None:
        for i in range(10_000):
            if i == 50:
                free[0] = 10**6
            if halt.is_set():
                return
            deliver(image_message(10**18 + i, jpeg_of(0) + bytes(50_000)))
            time.sleep(0.01)

    with pytest.raises(LowDiskError, match="less than the 100 MB"):
        record_live(Robot([run]), tmp_path / "out.mcap", LiveOptions(), stop=Stop())
    assert [path.name for path in tmp_path.iterdir()] == ["out.mcap"]
    assert len(logged(tmp_path / "out.mcap")) >= 50


@given(
    st.lists(st.tuples(st.sampled_from(["put", "take"]), st.integers(0, 200_000))),
    st.integers(1, 600_000),
)
def test_a_backlog_stays_in_its_bounds_and_counts_everything(
    steps: list[tuple[str, int]], limit: int
) -> None:
    backlog = Backlog(limit)
    written = 0
    for step, size in steps:
        if step == "put":
            backlog.put(Message("/a", messages.STRING, 1, bytes(size)))
        else:
            for message in backlog.take(0):
                backlog.written(message)
                written += 1
        assert 0 <= backlog.waiting_bytes <= limit
    received, dropped = backlog.counts()
    left = len(backlog.take(0))
    puts = sum(step == "put" for step, _ in steps)
    assert received.get("/a", 0) == puts == written + left + dropped.get("/a", 0)


def test_what_is_being_written_still_fills_the_queue() -> None:
    backlog = Backlog(_PICTURE * 3 // 2)
    backlog.put(picture())
    (taken,) = backlog.take(0)
    backlog.put(picture())
    assert backlog.counts()[1] == {"/big": 1}
    backlog.written(taken)
    backlog.put(picture())
    assert backlog.counts() == ({"/big": 3}, {"/big": 1})


def test_a_wall_clock_that_is_set_back_does_not_reach_the_arrival_clock(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = ArrivalClock()
    before = clock.now_ns()
    wall = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: wall() - 2 * 10**9)
    assert clock.now_ns() >= before
    described = clock.metadata()
    assert int(described["wall_clock_at_start_ns"]) == clock.wall_ns
