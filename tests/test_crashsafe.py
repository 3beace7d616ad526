"""Recordings survive: what was written is on the disk, under a name that says how far it came."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.reader import make_reader

from tests.helpers import paced
from tests.helpers.cli import tooltip, tooltip_process
from tests.helpers.logs import joint_message, robot_message
from tooltip_cli.errors import LowDiskError, TooltipError
from tooltip_cli.log.container import LoggedAttachment, LoggedMessage, iterate
from tooltip_cli.log.crashsafe import CrashSafeWriter, leftovers
from tooltip_cli.log.messages import COMPRESSED_IMAGE, Message
from tooltip_cli.log.salvage import salvage
from tooltip_cli.log.stopping import Stop, stop_on_signals
from tooltip_cli.log.survey import survey


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def stamps(path: Path) -> list[int]:
    return [item.log_time_ns for item in iterate(path) if isinstance(item, LoggedMessage)]


def noise(stamp_ns: int, size: int = 300_000) -> Message:
    return Message("/image", COMPRESSED_IMAGE, stamp_ns, os.urandom(size))


def wait_for(condition: Callable[[], bool]) -> None:
    for _ in range(12_000):
        if condition():
            return
        time.sleep(0.005)
    raise AssertionError("it never happened")


def test_a_finished_recording_has_its_name(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with CrashSafeWriter(path) as writer:
        writer.write(robot_message())
        assert names_in(tmp_path) == ["a.mcap.unfinished"]
        assert writer.unfinished_path == tmp_path / "a.mcap.unfinished"
    assert names_in(tmp_path) == ["a.mcap"]
    with path.open("rb") as file:
        summary = make_reader(file, validate_crcs=True).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == 1


def test_messages_reach_the_disk_by_themselves(tmp_path: Path) -> None:
    with CrashSafeWriter(tmp_path / "a.mcap", flush_every_s=0.02) as writer:
        for stamp in (1, 2, 3):
            writer.write(joint_message(stamp, ("a",), (0.5,)))
        found = tmp_path / "a.mcap.unfinished"
        wait_for(lambda: len(salvaged_stamps(found)) == 3)


def salvaged_stamps(path: Path) -> list[int]:
    out = path.with_name("salvaged.mcap")
    salvage(path, out, overwrite=True)
    return stamps(out)


def test_the_first_message_is_there_at_once(tmp_path: Path) -> None:
    with CrashSafeWriter(tmp_path / "a.mcap", flush_every_s=1000.0) as writer:
        writer.write(robot_message())
        assert len(salvaged_stamps(tmp_path / "a.mcap.unfinished")) == 1


def test_full_chunks_do_not_wait_for_the_clock(tmp_path: Path) -> None:
    with CrashSafeWriter(tmp_path / "a.mcap", flush_every_s=1000.0) as writer:
        for stamp in range(9):
            writer.write(noise(stamp))
        assert len(salvaged_stamps(tmp_path / "a.mcap.unfinished")) >= 5


@pytest.mark.parametrize("error", [ValueError, TooltipError, KeyboardInterrupt])
def test_what_ends_badly_stays_unfinished_but_whole(
    error: type[BaseException], tmp_path: Path
) -> None:
    (tmp_path / "a.mcap").write_text("precious")
    with pytest.raises(error):
        fail_within(tmp_path / "a.mcap", error)
    assert names_in(tmp_path) == ["a.mcap", "a.mcap.unfinished"]
    assert (tmp_path / "a.mcap").read_text() == "precious"
    assert stamps(tmp_path / "a.mcap.unfinished") == [5]


def fail_within(path: Path, error: type[BaseException]) -> None:
    with CrashSafeWriter(path, overwrite=True) as writer:
        writer.write(joint_message(5, ("a",), (0.5,)))
        raise error


def test_discarded_recordings_leave_nothing(tmp_path: Path) -> None:
    with CrashSafeWriter(tmp_path / "a.mcap") as writer:
        writer.write(robot_message())
        writer.discard()
    assert names_in(tmp_path) == []


def test_what_is_unfinished_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    for _ in range(3):
        with pytest.raises(ValueError):
            fail_within(path, ValueError)
    names = ["a.mcap.unfinished", "a.mcap.unfinished.1", "a.mcap.unfinished.2"]
    assert names_in(tmp_path) == names
    assert [place.name for place in leftovers(path)] == names


def test_somebody_elses_file_is_not_replaced_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with pytest.raises(TooltipError, match=r"a\.mcap exists"):
        overtaken(path)
    assert path.read_text() == "came first"
    assert len(stamps(tmp_path / "a.mcap.unfinished")) == 1


def overtaken(path: Path) -> None:
    with CrashSafeWriter(path) as writer:
        writer.write(robot_message())
        path.write_text("came first")


def test_several_threads_may_write(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with CrashSafeWriter(path, flush_every_s=0.001) as writer:

        def work(first: int) -> None:
            for stamp in range(first, first + 300):
                writer.write(joint_message(stamp, ("a",), (0.5,), topic=f"/joints{first}"))

        threads = [threading.Thread(target=work, args=(first,)) for first in (1000, 2000, 3000)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert sorted(stamps(path)) == [*range(1000, 1300), *range(2000, 2300), *range(3000, 3300)]


def test_too_little_space_is_refused_before_anything_is_made(tmp_path: Path) -> None:
    with pytest.raises(LowDiskError, match="less than the 1000000000 MB"):
        CrashSafeWriter(tmp_path / "a.mcap", min_free_bytes=10**15).__enter__()
    assert names_in(tmp_path) == []


def test_recording_stops_before_the_disk_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Usage:
        free = 10**9

    monkeypatch.setattr("shutil.disk_usage", lambda folder: Usage)
    written = 0
    with CrashSafeWriter(tmp_path / "a.mcap", min_free_bytes=10**6) as writer:
        try:
            for stamp in range(100):
                writer.write(noise(stamp))
                written += 1
                if stamp == 20:
                    Usage.free = 10**5
        except LowDiskError:
            pass
    assert 20 < written < 30
    assert stamps(tmp_path / "a.mcap") == list(range(written))


FULL = """
import os, resource, sys
from pathlib import Path
from tooltip_cli.errors import TooltipError
from tooltip_cli.log.crashsafe import CrashSafeWriter
from tooltip_cli.log.messages import COMPRESSED_IMAGE, Message
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), int(sys.argv[2])))
try:
    with CrashSafeWriter(Path(sys.argv[1])) as writer:
        for stamp in range(60):
            writer.write(Message("/image", COMPRESSED_IMAGE, stamp, os.urandom(100_000)))
except TooltipError as error:
    sys.exit(str(error))
"""


@pytest.mark.skipif(not hasattr(signal, "SIGXFSZ"), reason="no file size limit on this system")
@pytest.mark.parametrize("room", [200_000, 1_000_000, 3_333_333])
def test_a_full_disk_keeps_all_that_fits(room: int, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", FULL, str(tmp_path / "a.mcap"), str(room)],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).parents[1],
    )
    assert done.returncode == 1
    assert "cannot be written (File too large)" in done.stderr
    assert "tooltip salvage" in done.stderr
    assert "Traceback" not in done.stderr
    assert names_in(tmp_path) == ["a.mcap.unfinished"]
    found = salvaged_stamps(tmp_path / "a.mcap.unfinished")
    assert found == list(range(len(found)))
    assert len(found) >= room // 100_000 - 2


def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(TooltipError, match="No such file"):
        CrashSafeWriter(tmp_path / "missing" / "a.mcap").__enter__()


def test_signals_ask_and_the_second_one_insists() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with stop_on_signals() as stop:
        assert not stop.requested
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.wait(5.0)
        assert stop.reason == "SIGTERM"
        assert signal.getsignal(signal.SIGTERM) is before
        with pytest.raises(KeyboardInterrupt):
            interrupt()
    assert signal.getsignal(signal.SIGTERM) is before


def interrupt() -> None:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(5)


def test_the_first_reason_is_kept() -> None:
    stop = Stop()
    stop.request("SIGINT")
    stop.request("enough")
    assert (stop.requested, stop.reason) == (True, "SIGINT")


def test_elsewhere_than_in_the_main_thread_nothing_is_set() -> None:
    seen: list[object] = []

    def work() -> None:
        with stop_on_signals() as stop:
            seen.append((stop.requested, signal.getsignal(signal.SIGTERM)))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [(False, signal.getsignal(signal.SIGTERM))]


@pytest.fixture(scope="module")
def image() -> bytes:
    return paced.picture()


def after(images: int, number: int) -> Callable[[subprocess.Popen[str], int], bool]:
    """Return what sends a signal after so many images."""

    def end(process: subprocess.Popen[str], sent: int) -> bool:
        if sent < images:
            return False
        process.send_signal(number)
        return True

    return end


@pytest.mark.parametrize("images", [4, 22, 45])
def test_a_killed_recording_lacks_its_last_moment_at_most(
    images: int, image: bytes, tmp_path: Path
) -> None:
    session = paced.run(tmp_path / "run", after(images, signal.SIGKILL), image=image)
    assert session.code == -signal.SIGKILL
    result = salvage(session.unfinished, tmp_path / "out.mcap")
    assert result.state == "truncated"
    # how long that may be is measured in tests/soak/crashes.py, on a machine at rest
    assert session.lost_s(paced.images_in(tmp_path / "out.mcap")) < 5.0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_recording_has_all_that_was_received(
    number: signal.Signals, image: bytes, tmp_path: Path
) -> None:
    session = paced.run(tmp_path / "run", after(12, number), image=image)
    assert session.code == 1
    line = session.stderr.splitlines()[-1]
    assert line.startswith(f"Error: stopped by {number.name}: {session.unfinished} holds ")
    assert "tooltip salvage" in line
    assert survey(session.unfinished).whole
    found = paced.images_in(session.unfinished)
    assert found == session.sent[: len(found)]
    assert len(found) >= 11  # what came before the signal; the twelfth may still be on its way


def test_a_stopped_simulation_keeps_its_rig_and_says_how_far_it_came(tmp_path: Path) -> None:
    out = tmp_path / "a.mcap"
    command = [sys.executable, "-m", "tooltip_cli.cli.main", "record", "sim", str(out)]
    process = subprocess.Popen(
        [*command, "--size", "160x120"],
        cwd=Path(__file__).parents[1],
        stderr=subprocess.PIPE,
        text=True,
    )
    left = tmp_path / "a.mcap.unfinished"
    wait_for(lambda: left.exists() and left.stat().st_size > 20_000)
    process.terminate()
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "of 500 images" in stderr
    assert names_in(tmp_path) == ["a.mcap.unfinished"]
    assert tooltip("salvage", left, out).code == 0
    attached = {item.name for item in iterate(out) if isinstance(item, LoggedAttachment)}
    assert {"rig.yaml", "robot.urdf", "camera.yaml", "truth.json"} <= attached


def test_a_failing_source_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "1.jpg").write_bytes(b"no picture")
    found = tooltip_process("record", "video", tmp_path / "images", tmp_path / "a.mcap", "--fps", 5)
    assert found.code == 1
    assert names_in(tmp_path) == ["images"]


def test_leftovers_are_mentioned(tmp_path: Path, wrist_file: Path) -> None:
    (tmp_path / "a.mcap.unfinished").write_text("precious")
    found = tooltip("record", "bag", wrist_file, tmp_path / "a.mcap")
    assert found.code == 0
    assert "a.mcap.unfinished is what an earlier recording left; 'tooltip salvage'" in found.err
    assert (tmp_path / "a.mcap.unfinished").read_text() == "precious"


@pytest.mark.parametrize(
    ("text", "size"),
    [("0", 0), ("5MB", 5_000_000), ("1GB", 10**9), ("1.5gib", 3 * 2**29), ("7 k", 7000)],
)
def test_sizes_are_read(
    text: str, size: int, wrist_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[int] = []

    class Spy(CrashSafeWriter):
        def __init__(
            self, path: Path, *, overwrite: bool, min_free_bytes: int, flush_every_s: float | None
        ) -> None:
            seen.append(min_free_bytes)
            super().__init__(
                path, overwrite=overwrite, min_free_bytes=0, flush_every_s=flush_every_s
            )

    monkeypatch.setattr("tooltip_cli.stages.record.CrashSafeWriter", Spy)
    done = tooltip("record", "bag", wrist_file, tmp_path / "a.mcap", "--min-free", text)
    assert (done.code, seen) == (0, [size])


@pytest.mark.parametrize("text", ["", "many", "5XB", "-1GB", "1e9", "GB"])
def test_sizes_that_are_none(text: str, wrist_file: Path, tmp_path: Path) -> None:
    done = tooltip("record", "bag", wrist_file, tmp_path / "a.mcap", "--min-free", text)
    assert done.code == 2
    assert "is no size; give one such as 500MB or 1GB" in done.err
