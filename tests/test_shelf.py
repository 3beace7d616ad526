"""A shelf of recordings through ``tooltip run``."""

from __future__ import annotations

import csv
import io
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.cli import tooltip
from tests.helpers.logs import image_message, stamp_of, wrist_parts, write_log
from tests.helpers.robot import RIG
from tests.helpers.shelves import METHOD, contents, hoard, make_shelf, stamps, table
from tooltip_cli.errors import TooltipError
from tooltip_cli.rig.rigfile import rig_files
from tooltip_cli.stages.shelf.plan import Item, part_of, read_shelf
from tooltip_cli.stages.shelf.run import TimeLeft
from tooltip_cli.stages.shelf.table import COLUMNS, Row, csv_table, parquet_table


def names(shelf: Path | str) -> list[str]:
    return [item.name for item in read_shelf(str(shelf)).items]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a shelf of files that only a plan looks at."""
    for name in ("b/x.mcap", "a/x.mcap", "a/x.detections.mcap", "a/x.edges.mcap", "a/notes.txt"):
        (tmp_path / "shelf" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "shelf" / name).touch()
    return tmp_path / "shelf"


def test_a_folder_is_its_recordings_without_results(folder: Path) -> None:
    assert names(folder) == ["a/x", "b/x"]
    assert read_shelf(str(folder)).out == folder / "run"


def test_a_pattern_is_what_it_matches(folder: Path) -> None:
    assert names(folder / "a" / "*") == ["notes.txt", "x"]
    assert names(folder / "**" / "*.mcap") == ["a/x", "b/x"]
    assert names(folder / "[b]" / "x.mcap") == ["b/x"]
    assert read_shelf(str(folder / "*" / "x.mcap")).out == folder / "run"


MANIFEST = "recording,rig,labels,tool,operator\na/x.mcap,r.yaml,,pen,ana\n../else/y.mcap,,l.csv,,\n"


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_manifest_says_more_of_each(folder: Path, suffix: str) -> None:
    path = (folder / "some").with_suffix(suffix)
    if suffix == ".csv":
        path.write_text(MANIFEST)
    else:
        rows = [
            {"recording": "a/x.mcap", "rig": "r.yaml", "tool": "pen", "operator": "ana"},
            {"recording": "../else/y.mcap", "labels": "l.csv", "operator": ""},
        ]
        pq.write_table(
            pa.table({k: [row.get(k) for row in rows] for k in (*rows[0], "labels")}), path
        )
    found = read_shelf(str(path))
    first, second = found.items
    assert found.out == folder / "some.run"
    assert first == Item(
        "a/x", folder / "a/x.mcap", folder / "r.yaml", None, "pen", {"operator": "ana"}
    )
    assert second.name == "up/else/y"
    assert (second.rig, second.labels, second.tool) == (None, folder / "l.csv", None)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rec\nx.mcap\n", "expected a column 'recording', found rec"),
        ("recording,status\nx.mcap,1\n", "the column 'status' has the name of a result"),
        ("recording,rig\nx.mcap\n", "row 2: expected 2 cells"),
        ("recording\nx.mcap\n./x.mcap\n", "row 3: names the recording of row 2 again"),
        ("recording,rig\n,r.yaml\n", "row 2: names no recording"),
        ("recording\n", "holds no recording"),
        ('recording\n"x', "cannot be read as a CSV manifest"),
    ],
)
def test_a_manifest_that_is_none_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "m.csv").write_text(text)
    with pytest.raises(TooltipError, match=message):
        read_shelf(str(tmp_path / "m.csv"))


def test_no_shelf_is_refused(tmp_path: Path) -> None:
    (tmp_path / "m.parquet").write_bytes(b"no")
    for shelf, message in (
        (tmp_path, "holds no recording"),
        (tmp_path / "none", "is no folder"),
        (tmp_path / "*.mcap", "holds no recording"),
        (tmp_path / "m.parquet", "cannot be read as a Parquet manifest"),
    ):
        with pytest.raises(TooltipError, match=message):
            read_shelf(str(shelf))


def test_results_that_cannot_be_written_are_refused_before_any_work(folder: Path) -> None:
    done = tooltip("run", folder, "--out", folder / "a" / "notes.txt")
    assert done.code == 1
    assert "notes.txt: cannot be created" in done.error
    assert not done.out


@given(st.integers(0, 60), st.integers(1, 20))
def test_parts_hold_each_recording_once(count: int, parts: int) -> None:
    items = [Item(str(number), Path(str(number))) for number in range(count)]
    chosen = [part_of(items, part, parts) for part in range(1, parts + 1)]
    assert sorted(int(item.name) for part in chosen for item in part) == list(range(count))
    sizes = [len(part) for part in chosen]
    assert max(sizes) - min(sizes) <= 1


@given(st.lists(st.integers(1, 10**9), min_size=2, max_size=30), st.integers(1, 4))
def test_the_time_left_is_right_where_the_speed_is_constant(sizes: list[int], jobs: int) -> None:
    left, elapsed = TimeLeft(sum(sizes)), 0.0
    for number, size in enumerate(sizes, start=1):
        left, elapsed = left.after(size), elapsed + size * 1e-6
        seconds = left.seconds(elapsed, jobs)
        if number < jobs:
            assert seconds is None
        else:
            assert seconds == pytest.approx(sum(sizes[number:]) * 1e-6)


def test_both_tables_say_the_same() -> None:
    reason = 'no, "not"\nat all'
    rows = [
        Row("a", "/a", None, None, "pen", "ok", tip_x_m=0.1, columns={"run": 1, "by": "x"}),
        Row("b", "/b", None, None, None, "failed", reason=reason, columns={"run": "2"}),
    ]
    header, *cells = csv.reader(io.StringIO(csv_table(rows)))
    assert header == [*COLUMNS, "run", "by"]
    read = pq.read_table(pa.BufferReader(parquet_table(rows)))
    assert read.column_names == header
    assert read.column("tip_x_m").to_pylist() == [0.1, None]
    assert read.column("run").to_pylist() == ["1", "2"]
    for row, line in zip(read.to_pylist(), cells, strict=True):
        assert ["" if value is None else str(value) for value in row.values()] == line
    assert cells[1][header.index("reason")] == reason


@pytest.fixture(scope="module")
def ran(wrist_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a shelf that was run with one process; nobody may change it."""
    shelf = make_shelf(tmp_path_factory.mktemp("shelf") / "shelf", wrist_file)
    done = tooltip("run", shelf, *METHOD, "--jobs", 1)
    assert done.code == 1, done.err
    assert "4 recordings: 3 ok, 0 refused, 1 failed; 0 reused" in done.out
    return shelf


@pytest.fixture
def shelf(ran: Path, tmp_path: Path) -> Path:
    """Return a copy of it, unchanged for who compares times."""
    copy = tmp_path / "shelf"
    shutil.copytree(ran, copy)
    done = tooltip("run", copy, *METHOD)  # its paths are others now
    assert done.code == 1
    return copy


def test_failure_is_a_row(ran: Path) -> None:
    rows = table(ran / "run" / "results.csv")
    assert list(rows) == ["cut", "w0", "w2", "sub/w1"]
    assert rows["cut"]["status"] == "failed"
    assert "truncated" in rows["cut"]["reason"]
    for name in ("w0", "w2", "sub/w1"):
        tip = json.loads(Path(rows[name]["tip_file"]).read_text())
        given = [float(rows[name][f"tip_{axis}_m"]) for axis in "xyz"]
        assert given == tip["tip"]["position_m"]
        assert float(rows[name]["cov_xy_m2"]) == tip["tip"]["covariance_m2"][0][1]
        assert rows[name]["recorded"].startswith("2023-11-14T22:13:20")
    assert float(rows["w0"]["error_px"]) > 0
    assert rows["w0"]["scored"] == "10"
    assert rows["w2"]["error_px"] == ""
    parquet = pq.read_table(ran / "run" / "results.parquet").to_pylist()
    assert [row["name"] for row in parquet] == list(rows)


def test_two_processes_do_what_one_does(ran: Path, tmp_path: Path) -> None:
    done = tooltip("run", ran, *METHOD, "--jobs", 2, "--out", tmp_path / "two")
    assert done.code == 1, done.err
    one, two = table(ran / "run" / "results.csv"), table(tmp_path / "two" / "results.csv")
    for rows in (one, two):
        for row in rows.values():
            row["tip_file"] = Path(row["tip_file"]).name
    assert one == two
    left, right = contents(ran / "run"), contents(tmp_path / "two")
    for document in (left, right):
        for name in [name for name in document if name.endswith("/row.json")]:
            row = document[name]["row"]
            row["tip_file"] = row["tip_file"] and Path(row["tip_file"]).name
    assert left == right
    assert len([name for name in left if name.endswith(".tip.json")]) == 5


def test_a_second_run_does_only_what_is_left(shelf: Path) -> None:
    out = shelf / "run"
    before = stamps(out)
    (out / "recordings" / "w2" / "w2.tip.json").unlink()
    done = tooltip("run", shelf, *METHOD, "--json")
    after = stamps(out)
    assert {name for name in after if after[name] != before[name]} == {"w2", "cut"}
    assert json.loads(done.out)["computed"] == 2
    assert json.loads(done.out)["reasons"] == {"failed": 1}
    assert len(table(out / "results.csv")) == 4


def test_what_a_row_depends_on_decides(shelf: Path) -> None:
    out = shelf / "run"
    before = stamps(out)
    labels = shelf / "w0.labels.csv"
    labels.write_text("\n".join(labels.read_text().splitlines()[:-1]) + "\n")
    shutil.copy(shelf / "w2.mcap", shelf / "cut.mcap")  # mended
    done = tooltip("run", shelf, *METHOD)
    assert done.code == 0, done.err
    after = stamps(out)
    assert {name for name in after if after[name] != before[name]} == {"w0", "cut"}
    assert table(out / "results.csv")["w0"]["scored"] == "9"


def test_to_verify_is_to_read_and_not_to_compute(shelf: Path) -> None:
    tips = {path: path.stat().st_mtime_ns for path in (shelf / "run").rglob("*.tip.json")}
    before = stamps(shelf / "run")
    done = tooltip("run", shelf, *METHOD, "--verify")
    assert "3 ok, 0 refused, 1 failed; 3 reused" in done.out
    assert {path: path.stat().st_mtime_ns for path in tips} == tips
    assert not set(stamps(shelf / "run").values()) & set(before.values())


def test_parts_make_a_whole(wrist_file: Path, tmp_path: Path) -> None:
    shelf = make_shelf(tmp_path / "shelf", wrist_file, 2)
    for part in ("1/2", "2/2"):
        tooltip("run", shelf, *METHOD, "--part", part)
    first = table(shelf / "run" / "results.part-1-of-2.csv")
    second = table(shelf / "run" / "results.part-2-of-2.csv")
    assert [*first, *second] == ["cut", "sub/w1", "w0"]
    done = tooltip("run", shelf, *METHOD)
    assert "2 of 3 recordings are finished already" in done.err
    assert table(shelf / "run" / "results.csv") == {
        name: {**first, **second}[name] for name in ("cut", "w0", "sub/w1")
    }
    assert tooltip("run", shelf, "--part", "3/2").code == 2
    assert tooltip("run", shelf, "--part", "half").code == 2


def test_the_manifest_names_rig_and_labels(wrist_file: Path, tmp_path: Path) -> None:
    bare = write_log(tmp_path / "logs" / "bare.mcap", wrist_parts(), rig=None)
    for name, text in rig_files(RIG).items():
        (tmp_path / name).write_text(text)
    make_shelf(tmp_path / "other", wrist_file, 1)
    (tmp_path / "other" / "w0.labels.csv").rename(tmp_path / "seen.csv")
    manifest = tmp_path / "m.csv"
    manifest.write_text(
        "recording,rig,labels,tool,operator\n"
        f"{bare},rig.yaml,seen.csv,stick,ana\n"
        "other/w0.mcap,,nowhere.csv,stick,bob\n"
    )
    done = tooltip("run", manifest, *METHOD)
    assert done.code == 1
    good, bad = table(tmp_path / "m.run" / "results.csv").values()
    assert (good["status"], good["tool"], good["operator"]) == ("ok", "stick", "ana")
    assert good["scored"] == "10"
    assert "nowhere.csv" in bad["reason"]
    tip = json.loads(Path(good["tip_file"]).read_text())
    assert tip["frames_used"] <= 30  # a labelled image trains nothing
    # the rig is read again when it has changed
    rig = tmp_path / "rig.yaml"
    rig.write_text(rig.read_text() + "time_offset: 0.001\n")
    done = tooltip("run", manifest, *METHOD)
    assert "finished already" not in done.err


def test_an_absurd_image_costs_its_own_recording_alone(wrist_file: Path, tmp_path: Path) -> None:
    shelf = tmp_path / "shelf"
    shelf.mkdir()
    shutil.copy(wrist_file, shelf / "good.mcap")
    _, data = cv2.imencode(".png", np.zeros((20_000, 20_000), np.uint8))
    parts = wrist_parts()
    parts["images"] = [
        image_message(stamp_of(frame), data.tobytes(), image_format="png") for frame in range(2)
    ]
    write_log(shelf / "huge.mcap", parts)
    done = tooltip("run", shelf, *METHOD, "--memory", "0.5", "--jobs", 1)
    rows = table(shelf / "run" / "results.csv")
    assert done.code == 1
    assert rows["good"]["status"] == "ok"
    assert rows["huge"]["status"] == "failed"
    assert "image 0" in rows["huge"]["reason"]


def test_what_takes_all_memory_costs_its_own_recording_alone(
    wrist_file: Path, tmp_path: Path
) -> None:
    shelf = make_shelf(tmp_path / "shelf", wrist_file, 2)
    hoard(shelf / "hoard.mcap")
    done = tooltip("run", shelf, *METHOD, "--memory", "1", "--jobs", 1)
    assert "4 recordings: 2 ok, 0 refused, 2 failed" in done.out
    rows = table(shelf / "run" / "results.csv")
    assert rows["hoard"]["code"] == "out_of_memory"
    assert "--memory" in rows["hoard"]["reason"]
    assert "truncated" in rows["cut"]["reason"]
    before = stamps(shelf / "run")
    done = tooltip("run", shelf, *METHOD, "--memory", "6", "--jobs", 1)
    assert "4 recordings: 3 ok, 0 refused, 1 failed; 2 reused" in done.out  # with enough it ends
    after = stamps(shelf / "run")
    assert {name for name in after if after[name] != before[name]} == {"cut", "hoard"}


def test_what_was_finished_before_a_kill_is_finished(wrist_file: Path, tmp_path: Path) -> None:
    shelf = make_shelf(tmp_path / "shelf", wrist_file, 4)
    command = [sys.executable, "-m", "tooltip_cli.cli.main", "run", str(shelf), *METHOD]
    process = subprocess.Popen(
        [*command, "--jobs", "1"], stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    assert process.stdout is not None
    lines = [process.stdout.readline() for _ in range(3)]
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    assert [line.split(":")[0] for line in lines] == ["cut", "w0", "w2"]
    assert not (shelf / "run" / "results.csv").exists()
    before = stamps(shelf / "run")
    done = tooltip("run", shelf, *METHOD)
    after = stamps(shelf / "run")
    assert {after[name] == before[name] for name in ("w0", "w2")} == {True}
    assert len(table(shelf / "run" / "results.csv")) == 5
    assert "4 ok" in done.out


def test_an_interrupt_keeps_what_is_finished(wrist_file: Path, tmp_path: Path) -> None:
    shelf = make_shelf(tmp_path / "shelf", wrist_file, 4)
    command = [sys.executable, "-m", "tooltip_cli.cli.main", "run", str(shelf), *METHOD]
    process = subprocess.Popen(
        [*command, "--jobs", "1"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    for _ in range(2):
        process.stdout.readline()
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does, to every process
    _, err = process.communicate()
    assert process.returncode == 1
    assert "Traceback" not in err
    assert {"cut", "w0"} <= set(table(shelf / "run" / "results.csv"))
    assert not list(shelf.rglob("*.partial"))
