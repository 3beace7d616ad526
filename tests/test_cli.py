"""The command line: what it says, where, and how it ends."""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest

from tests.helpers.cli import tooltip, tooltip_process
from tests.helpers.logs import (
    IMAGE_TOPIC,
    Log,
    image_message,
    jpeg_of,
    stamp_of,
    wrist_parts,
    write_log,
    write_true_labels,
)
from tests.helpers.robot import RIG, TIP
from tooltip_cli import __version__
from tooltip_cli.cli.main import COMMANDS, main
from tooltip_cli.cli.options import columns, progress, table
from tooltip_cli.log import messages
from tooltip_cli.log.container import LoggedAttachment, iterate
from tooltip_cli.rig.rigfile import rig_files

DETECT = ("detect", "--preset", "paper")
ESTIMATE = ("estimate", "--method", "kmeans", "--preset", "paper")


def files_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def present_commands() -> list[str]:
    return [name for name in COMMANDS if find_spec(f"tooltip_cli.cli.{name}")]


def test_every_listed_command_exists() -> None:
    assert present_commands() == list(COMMANDS)


@pytest.mark.parametrize("flag", ["--help", "-h"])
def test_help_lists_every_command_in_the_order_of_the_work(flag: str) -> None:
    found = tooltip(flag)
    assert found.code == 0
    places = [found.out.index(f"\n  {name}") for name in COMMANDS]
    assert places == sorted(places)
    assert found.err == ""


def test_version() -> None:
    assert tooltip("--version").out.strip() == f"tooltip, version {__version__}"


def walk(command: click.Command, name: str) -> list[tuple[str, click.Command]]:
    if not isinstance(command, click.Group):
        return [(name, command)]
    context = click.Context(command)
    rows: list[tuple[str, click.Command]] = [(name, command)] if name else []
    for child in present_commands() if not name else command.list_commands(context):
        found = command.get_command(context, child)
        assert found is not None
        rows += walk(found, f"{name} {child}".strip())
    return rows


@pytest.mark.parametrize(("name", "command"), walk(main, ""), ids=[n for n, _ in walk(main, "")])
def test_every_command_and_option_has_help(name: str, command: click.Command) -> None:
    assert command.help, name
    for parameter in command.params:
        if isinstance(parameter, click.Option) and not parameter.hidden:
            assert parameter.help, f"{name} {parameter.opts}"
    assert tooltip(*name.split(), "--help").code == 0


@pytest.mark.parametrize(
    "arguments",
    [
        ["nonsense"],
        ["detect"],
        ["detect", "--nonsense", "a.mcap"],
        ["detect", "a.mcap", "--jobs", "0"],
        ["detect", "a.mcap", "--jobs", "many"],
        ["detect", "a.mcap", "--preset", "mine"],
        ["estimate"],
        ["estimate", "a.mcap", "--method", "magic"],
        ["estimate", "a.mcap", "--from-labels"],
    ],
)
def test_wrong_usage_is_exit_code_two(arguments: list[str]) -> None:
    found = tooltip(*arguments)
    assert found.code == 2
    assert "Error: " in found.err
    assert found.out == ""


def test_detect_then_estimate(wrist: Log) -> None:
    detected = tooltip(*DETECT, wrist.path)
    place = wrist.path.with_name("wrist.detections.mcap")
    assert (detected.code, detected.out) == (0, f"{place}\n")
    assert f"{wrist.path}: computed 39 pairs, " in detected.err
    assert "no_motion" in detected.err
    estimated = tooltip(*ESTIMATE, wrist.path)
    assert estimated.code == 0
    assert estimated.out.startswith("wrist: tip at x ")
    assert estimated.err.splitlines() == [
        f"{wrist.path}: reused {place}",
        f"{wrist.path}: computed {wrist.path.with_name('wrist.tip.json')}",
    ]
    again = tooltip(*ESTIMATE, wrist.path)
    assert again.out == estimated.out
    assert f"reused {wrist.path.with_name('wrist.tip.json')}" in again.err
    assert files_in(wrist.path.parent) == ["wrist.detections.mcap", "wrist.mcap", "wrist.tip.json"]


def test_estimate_makes_missing_detections_and_says_so(wrist: Log) -> None:
    found = tooltip(*ESTIMATE, wrist.path)
    assert found.code == 0
    assert f"computed {wrist.path.with_name('wrist.detections.mcap')}" in found.err


def outcome(command: str, path: Path, *options: object) -> tuple[bool, bool]:
    """Run a command on one recording; return whether it computed detections and the estimate."""
    found = tooltip(*(ESTIMATE if command == "estimate" else DETECT), path, *options)
    assert found.code in (0, 3), found.err
    lines = found.err.splitlines()
    return (
        any(
            ": computed " in line and ("pairs" in line or "detections.mcap" in line)
            for line in lines
        ),
        any(": computed " in line and line.endswith(".tip.json") for line in lines),
    )


def test_each_change_redoes_exactly_what_depends_on_it(wrist: Log, tmp_path: Path) -> None:
    path = wrist.path
    rig = tmp_path / "rig"
    rig.mkdir()
    for name, text in rig_files(RIG).items():
        (rig / name).write_text(text)
    assert outcome("detect", path) == (True, False)
    assert outcome("detect", path) == (False, False)
    assert outcome("detect", path, "--rig", rig / "rig.yaml") == (False, False)
    assert outcome("detect", path, "--jobs", 3) == (False, False)
    assert outcome("estimate", path) == (False, True)
    assert outcome("estimate", path) == (False, False)
    assert outcome("estimate", path, "--rig", rig / "rig.yaml") == (False, False)
    (rig / "robot.urdf").write_text(rig_files(RIG)["robot.urdf"].replace("0.42", "0.425"))
    assert outcome("detect", path, "--rig", rig / "rig.yaml") == (False, False)
    assert outcome("estimate", path, "--rig", rig / "rig.yaml") == (False, True)
    assert outcome("estimate", path, "--rig", rig / "rig.yaml") == (False, False)
    assert outcome("estimate", path, "--method", "map") == (False, True)
    assert outcome("estimate", path, "--method", "map") == (False, False)
    assert outcome("estimate", path, "--method", "map", "--force") == (False, True)
    assert outcome("detect", path, "--force") == (True, False)


def test_the_default_method_is_reused_too(wrist: Log) -> None:
    for how in ("computed", "reused"):
        detected = tooltip("detect", wrist.path)
        assert detected.code == 0
        assert f"{wrist.path}: {how} 39 pairs" in detected.err
        assert f"{wrist.path}: {how} moving edges" in detected.err
        found = tooltip("estimate", wrist.path)
        assert found.code in (0, 3)
        assert f"{wrist.path}: {how} {wrist.path.with_name('wrist.tip.json')}" in found.err


def test_out_is_made_and_takes_everything(wrist: Log, tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    found = tooltip(*DETECT, wrist.path, "--out", out)
    assert found.out == f"{out / 'wrist.detections.mcap'}\n"
    assert tooltip(*ESTIMATE, wrist.path, "--out", out).code == 0
    assert files_in(out) == ["wrist.detections.mcap", "wrist.tip.json"]
    assert files_in(tmp_path) == ["deep", "wrist.mcap"]


def test_json_of_detect(wrist: Log) -> None:
    (document,) = json.loads(tooltip(*DETECT, wrist.path, "--json").out)
    assert document["recording"] == str(wrist.path)
    assert document["pairs"] == 39
    assert document["reused"] is False
    assert document["detections"] + sum(document["flags"].values()) == 39
    (again,) = json.loads(tooltip(*DETECT, wrist.path, "--json").out)
    assert again == {**document, "reused": True}


def test_json_of_estimate_is_the_tip_file(wrist: Log) -> None:
    found = tooltip(*ESTIMATE, wrist.path, "--json")
    document = json.loads(found.out)
    assert document == json.loads(wrist.path.with_name("wrist.tip.json").read_text())
    assert np.linalg.norm(np.array(document["tip"]["position_m"]) - TIP) < 0.015


def test_several_recordings(wrist: Log) -> None:
    second = write_log(wrist.path.with_name("second.mcap"), wrist_parts(30))
    found = tooltip(*DETECT, wrist.path, second)
    assert [Path(line).name for line in found.out.splitlines()] == [
        "wrist.detections.mcap",
        "second.detections.mcap",
    ]
    documents = json.loads(tooltip(*ESTIMATE, wrist.path, second, "--json").out)
    assert [item["provenance"]["recording"] for item in documents] == ["wrist.mcap", "second.mcap"]


def test_a_glob_still_means_the_recordings_once_there_are_detections(wrist: Log) -> None:
    wrist.path.with_name("wrist.edges.mcap").write_bytes(b"")  # another kind of result
    for _ in range(2):
        found = tooltip(*DETECT, *sorted(wrist.path.parent.glob("*.mcap")))
        assert found.code == 0
    wrist.path.with_name("wrist.edges.mcap").unlink()
    assert found.out == f"{wrist.path.with_name('wrist.detections.mcap')}\n"
    assert files_in(wrist.path.parent) == ["wrist.detections.mcap", "wrist.mcap"]
    alone = tooltip(*DETECT, wrist.path.with_name("wrist.detections.mcap"))
    assert alone.code == 1
    assert "no image topic" in alone.error


def test_recordings_of_one_name_would_overwrite_each_other(wrist: Log, tmp_path: Path) -> None:
    other = tmp_path / "other"
    write_log(other / "wrist.mcap", wrist_parts(5))
    for command in (DETECT, ESTIMATE):
        found = tooltip(*command, wrist.path, other / "wrist.mcap", "--out", tmp_path / "out")
        assert found.code == 1
        assert "have the same name" in found.error
    assert not (tmp_path / "out").exists()
    assert tooltip(*DETECT, wrist.path, other / "wrist.mcap").code == 0
    assert tooltip(*DETECT, wrist.path, wrist.path, "--out", tmp_path / "out").code == 0


def test_a_refusal_is_exit_code_three_and_says_why(wrist: Log, tmp_path: Path) -> None:
    labels = write_true_labels(tmp_path / "few.csv", [1, 2])
    found = tooltip(*ESTIMATE, wrist.path, "--from-labels", labels)
    assert found.code == 3
    assert found.out == "wrist: refused (too_few_views)\n"
    assert "refused: too_few_views: only 2 views show the tip" in found.err
    machine = tooltip(*ESTIMATE, wrist.path, "--from-labels", labels, "--json")
    assert machine.code == 3
    assert json.loads(machine.out)["status"] == "refused"


def test_one_refusal_among_several_is_still_three(wrist: Log) -> None:
    still = [image_message(stamp_of(i), jpeg_of(0)) for i in range(6)]
    other = write_log(wrist.path.with_name("still.mcap"), {**wrist_parts(6), "images": still})
    found = tooltip(*ESTIMATE, wrist.path, other)
    assert found.code == 3
    assert found.out.splitlines()[0].startswith("wrist: tip at")
    assert found.out.splitlines()[1] == "still: refused (no_motion)"


def test_estimating_from_labels_needs_no_images_that_move(wrist: Log, tmp_path: Path) -> None:
    labels = write_true_labels(tmp_path / "l.csv", range(0, 40, 2))
    for method in ("kmeans", "map"):
        found = tooltip(
            "estimate", wrist.path, "--from-labels", labels, "--method", method, "--json"
        )
        document = json.loads(found.out)
        assert np.linalg.norm(np.array(document["tip"]["position_m"]) - TIP) < 0.001
        assert document["frames_used"] == 20
    assert not wrist.path.with_name("wrist.detections.mcap").exists()


def test_topics_are_chosen_by_option(wrist: Log, tmp_path: Path) -> None:
    parts = wrist_parts(10)
    parts["second"] = [image_message(stamp_of(i), jpeg_of(i), "/left/image") for i in range(10)]
    path = write_log(tmp_path / "two.mcap", parts)
    found = tooltip(*DETECT, path)
    assert found.code == 1
    assert f"{IMAGE_TOPIC}, /left/image; choose one with --image" in found.error
    assert tooltip(*DETECT, path, "--image", "/left/image").code == 0
    # another topic's detections are other detections
    assert outcome("detect", path, "--image", IMAGE_TOPIC) == (True, False)


def test_odd_streams_are_said_once_they_are_read(tmp_path: Path) -> None:
    parts = wrist_parts(12)
    parts["images"] += [image_message(stamp_of(3), jpeg_of(3))]
    path = write_log(tmp_path / "a.mcap", parts)
    for command in (DETECT, ESTIMATE):
        found = tooltip(*command, path)
        assert f"{path}: {IMAGE_TOPIC}: 1 duplicate stamps; the first of each is kept" in found.err


def test_the_recording_itself_is_never_written(wrist: Log) -> None:
    before = wrist.path.read_bytes()
    for command in (DETECT, ESTIMATE):
        assert tooltip(*command, wrist.path).code == 0
    assert wrist.path.read_bytes() == before


def test_annotations_lie_over_the_video(wrist: Log) -> None:
    """Foxglove counts from the corner of the first pixel, we from its centre."""
    tooltip(*DETECT, wrist.path)
    rows: dict[int, dict[str, Any]] = {}
    for item in iterate(wrist.path.with_name("wrist.detections.mcap")):
        if not isinstance(item, LoggedAttachment):
            message = messages.decode(item.datatype, item.payload)
            rows.setdefault(item.log_time_ns, {})[item.datatype] = message
    assert list(rows) == [stamp_of(i) for i in range(39)]
    for stamp, row in rows.items():
        detection = row[messages.TIP_DETECTION]
        circles = row[messages.IMAGE_ANNOTATIONS].circles
        assert messages.ns_from_time(detection.header.stamp) == stamp
        assert len(circles) == (0 if detection.flags else 2)
        for circle in circles:
            assert circle.position.x == detection.u + 0.5
            assert circle.position.y == detection.v + 0.5
            assert messages.ns_from_time(circle.timestamp) == stamp


def test_a_process_of_its_own(wrist: Log) -> None:
    found = tooltip_process(*ESTIMATE, wrist.path, "--json")
    assert found.code == 0, found.err
    assert json.loads(found.out)["status"] == "ok"
    assert all(line.startswith(f"{wrist.path}: ") for line in found.err.splitlines())


def test_damaged_images_make_one_line_in_a_process_of_its_own(tmp_path: Path) -> None:
    parts = wrist_parts(4)
    parts["images"][2] = image_message(stamp_of(2), b"\x89PNG\r\n\x1a\n" + bytes(30))
    path = write_log(tmp_path / "a.mcap", parts)
    found = tooltip_process(*DETECT, path)
    assert found.code == 1
    (line,) = found.err.splitlines()
    assert line.startswith(f"Error: {path}: image 2 (jpeg) cannot be decoded")
    assert files_in(tmp_path) == ["a.mcap"]


def test_names_that_are_no_text_do_not_end_the_program(wrist: Log, tmp_path: Path) -> None:
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9.mcap"))
    path.write_bytes(wrist.path.read_bytes())
    found = subprocess.run(
        [sys.executable, "-m", "tooltip_cli.cli.main", "detect", path],
        capture_output=True,
        check=False,
        cwd=Path(__file__).parents[1],
        env={**os.environ, "LC_ALL": "C.UTF-8"},
    )
    assert found.returncode == 0, found.stderr
    assert b"Traceback" not in found.stderr


def test_line_breaks_and_terminal_codes_in_names_stay_on_one_line(tmp_path: Path) -> None:
    path = write_log(
        tmp_path / "a.mcap",
        [image_message(i, jpeg_of(0), topic) for i, topic in enumerate(["/a\n/b", "/c\x1b[31m"])],
    )
    found = tooltip(*DETECT, path)
    assert found.code == 1
    assert len(found.err.splitlines()) == 1
    assert "\x1b" not in found.err


FULL_DISK = """
import resource, signal, sys
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), int(sys.argv[1])))
from tooltip_cli.cli.main import main
main(sys.argv[2:])
"""


@pytest.mark.skipif(not hasattr(signal, "SIGXFSZ"), reason="no file size limit on this system")
@pytest.mark.parametrize(("command", "room"), [(DETECT, 2000), (ESTIMATE, 500)])
def test_a_full_disk_leaves_no_part_of_a_file(
    command: tuple[str, ...], room: int, wrist: Log
) -> None:
    if command == ESTIMATE:  # its detections exist already
        assert tooltip(*DETECT, wrist.path).code == 0
    before = files_in(wrist.path.parent)
    found = subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(room), *command, str(wrist.path)],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).parents[1],
    )
    assert found.returncode == 1, found.stderr
    assert found.stderr.splitlines()[-1].endswith("cannot be written (File too large)")
    assert "Traceback" not in found.stderr
    assert files_in(wrist.path.parent) == before


def test_an_unexpected_failure_keeps_its_traceback(
    wrist: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: object, **options: object) -> None:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr("tooltip_cli.stages.detect.detect_in", fail)
    with pytest.raises(ZeroDivisionError, match="a bug"):
        tooltip(*DETECT, wrist.path)


def test_verbose_says_more(wrist: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    levels: list[int] = []
    monkeypatch.setattr("logging.basicConfig", lambda **options: levels.append(options["level"]))
    tooltip(*DETECT, wrist.path)
    tooltip("--verbose", "detect", wrist.path)
    assert levels == [logging.WARNING, logging.INFO]


class Terminal:
    """A standard error that says it is a terminal."""

    def __init__(self) -> None:
        self.text = ""

    def isatty(self) -> bool:
        return True

    def write(self, text: str) -> int:
        self.text += text
        return len(text)

    def flush(self) -> None:
        pass


@pytest.mark.parametrize("total", [10, None])
def test_progress_is_shown_on_terminals_when_work_takes_long(
    total: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter(np.arange(100) * 0.3)
    monkeypatch.setattr("tooltip_cli.cli.options.time.monotonic", lambda: float(next(clock)))
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with progress(total, "work") as advance:
        for _ in range(5):
            advance()
    shown = terminal.text.split("\r")
    assert [line for line in shown if "work: 3" in line] == []  # not within the first second
    assert any(
        "work: 5/10 (50%), 2 s left" in line if total else "work: 5" in line for line in shown
    )
    assert shown[-1] == "\x1b[K"  # the line is gone afterwards


def test_progress_is_silent_elsewhere(capsys: pytest.CaptureFixture[str]) -> None:
    with progress(3, "work") as advance:
        advance()
    assert capsys.readouterr().err == ""


def test_progress_is_silent_for_quick_work(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with progress(3, "work") as advance:
        advance()
    assert terminal.text == ""


def test_tables_keep_their_columns_whatever_names_hold() -> None:
    rows = [("工具 ü", "1.00", "two ends"), ("a\nb\x1b[31m", "12.00", ""), ("e\u0301", "-", "x")]
    head, *lines = table(("tool", "px", ""), rows, left=1, words=1)
    assert head == "tool         px"
    assert "\x1b" not in "".join(lines)
    ends = [
        columns(line[: line.index(number) + len(number)])
        for line, (_, number, _) in zip(lines, rows, strict=True)
    ]
    assert ends == [len(head)] * 3
    assert lines[0].endswith("1.00  two ends")
    assert lines[1].endswith("12.00")
