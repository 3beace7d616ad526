"""``tooltip demo``: everything in one command, nothing twice, nothing lost."""

from __future__ import annotations

import importlib.util
import json
import shutil
from pathlib import Path

import pytest

from tests.helpers.cli import Outcome, tooltip
from tests.helpers.logs import wrist_parts, write_log
from tooltip_cli.errors import TooltipError
from tooltip_cli.sources.sim import TOOLS, SimParams
from tooltip_cli.stages.simulate import record_simulation, reuse_simulation

SMALL = ("--frames", 12, "--jobs", 2)  # too few for an estimate, enough to go all the way


def demo(folder: Path, *options: object) -> Outcome:
    return tooltip("demo", folder, "--tools", "pen,pliers", *SMALL, *options)


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Outcome]:
    """Return the folder of a small demo, which nobody may change, and what was said."""
    folder = tmp_path_factory.mktemp("demo") / "new" / "demo"
    return folder, demo(folder)


@pytest.fixture
def folder(first: tuple[Path, Outcome], tmp_path: Path) -> Path:
    """Return a copy of the small demo."""
    return Path(shutil.copytree(first[0], tmp_path / "demo"))


def steps(outcome: Outcome, word: str) -> list[str]:
    """Return the lines on stderr that say that something was computed, or reused."""
    return [line for line in outcome.err.splitlines() if f": {word} " in line]


def test_a_tool_goes_through_every_stage(tmp_path: Path) -> None:
    done = tooltip("demo", tmp_path, "--tools", "pliers", "--frames", 80, "--jobs", 2)
    assert done.code == 0
    header, row, page = done.out.splitlines()
    assert header.split() == ["tool", "detector", "[px]", "baseline", "[px]", "tip", "[mm]"]
    assert row.startswith("pliers ")
    assert page == str(tmp_path / "report" / "index.html")
    assert Path(page).is_file()
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    (found,) = report["recordings"]
    assert found["detector"]["error_px"]["mean"] < 20
    assert found["baseline"]["error_px"]["mean"] < 4
    assert found["detector"]["tip_error_mm"] < 20
    assert found["labels"]["simulated"]
    tip = json.loads((tmp_path / "pliers.tip.json").read_text())
    assert tip["status"] == "ok"
    assert tip["tip"]["position_m"] == found["detector"]["position_m"]


def test_nothing_is_left_out_and_too_few_frames_are_refused(first: tuple[Path, Outcome]) -> None:
    folder, done = first
    assert done.code == 3
    assert done.out.splitlines()[-1] == str(folder / "report" / "index.html")
    for tool in ("pen", "pliers"):
        for suffix in (".mcap", ".labels.csv", ".detections.mcap", ".tip.json"):
            assert (folder / f"{tool}{suffix}").is_file()
        assert f"{folder / tool}.mcap: computed 12 images" in done.err
        assert f"{folder / tool}.mcap: computed {folder / tool}.detections.mcap" in done.err
        assert json.loads((folder / f"{tool}.tip.json").read_text())["status"] == "refused"


def test_a_second_run_reuses_everything(folder: Path) -> None:
    demo(folder)  # a report names its recordings' paths, and these are copies
    before = {path: path.stat().st_mtime_ns for path in folder.glob("*.*")}
    again = demo(folder)
    assert again.code == 3
    assert not steps(again, "computed")
    assert len(steps(again, "reused")) >= 8
    assert {path: path.stat().st_mtime_ns for path in folder.glob("*.*")} == before


def test_an_interrupted_run_is_resumed(folder: Path) -> None:
    labels = {path.name: path.read_bytes() for path in folder.glob("*.labels.csv")}
    (folder / "pen.labels.csv").unlink()
    for suffix in (".mcap", ".labels.csv", ".detections.mcap"):
        (folder / f"pliers{suffix}").unlink()
    again = demo(folder)
    assert again.code == 3
    assert f"{folder / 'pen'}.mcap: computed 12 images" in again.err
    assert f"{folder / 'pliers'}.mcap: computed 12 images" in again.err
    # the same simulation gives the same bytes, so that what is left still fits
    assert f"{folder / 'pen'}.mcap: reused {folder / 'pen'}.detections.mcap" in again.err
    assert f"{folder / 'pliers'}.mcap: computed {folder / 'pliers'}.detections.mcap" in again.err
    assert {path.name: path.read_bytes() for path in folder.glob("*.labels.csv")} == labels


def test_labels_placed_by_hand_are_kept(folder: Path) -> None:
    labels = folder / "pen.labels.csv"
    text = labels.read_text().replace(",sim", ",ana")
    labels.write_text(text)
    demo(folder)
    assert labels.read_text() == text


def test_other_parameters_need_force(folder: Path) -> None:
    kept = (folder / "pen.mcap").read_bytes()
    other = ("--tools", "pen", "--frames", 11)
    done = tooltip("demo", folder, *other)
    assert done.code == 1
    assert "pen.mcap was simulated with frames 12 instead of 11" in done.error
    assert "--force" in done.error
    assert (folder / "pen.mcap").read_bytes() == kept
    assert "seed 0 instead of 1" in demo(folder, "--seed", 1).error
    forced = tooltip("demo", folder, *other, "--force")
    assert forced.code == 3
    assert "computed 11 images" in forced.err
    assert (folder / "pen.mcap").read_bytes() != kept


def test_json_is_the_report(folder: Path) -> None:
    done = demo(folder, "--json")
    assert done.code == 3
    assert json.loads(done.out) == json.loads((folder / "report" / "report.json").read_text())


@pytest.mark.parametrize(
    ("tools", "message"),
    [
        ("pen,spoon", "unknown tool 'spoon'; known: bottle"),
        (" , ", "--tools names no tool; known: hot_glue_gun"),
        ("all,pen", "unknown tool 'all'"),
    ],
)
def test_wrong_tools_are_one_line_before_any_work(tmp_path: Path, tools: str, message: str) -> None:
    done = tooltip("demo", tmp_path / "new", "--tools", tools)
    assert done.code == 1
    assert message in done.error
    assert not (tmp_path / "new").exists()


def test_every_tool_is_a_tool() -> None:
    from tooltip_cli.cli.demo import names

    assert names("all") == list(TOOLS)
    assert names(" pen, hammer ,pen") == ["pen", "hammer"]


@pytest.mark.parametrize(
    ("module", "extra", "package"),
    [("skimage", "sim", "scikit-image"), ("matplotlib", "report", "matplotlib")],
)
def test_a_missing_extra_is_told_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, extra: str, package: str
) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == module else found(name)
    )
    done = tooltip("demo", tmp_path / "new")
    assert f"demo needs the package '{package}'" in done.error
    assert f"pip install 'tooltip-cli[{extra}]'" in done.error
    assert not (tmp_path / "new").exists()


def test_a_directory_that_cannot_be_made_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    done = tooltip("demo", tmp_path / "file" / "demo")
    assert done.code == 1
    assert "cannot be created" in done.error


def test_foreign_recordings_are_never_replaced_unasked(tmp_path: Path) -> None:
    params = SimParams("pen", frames=2, size=(64, 48))
    foreign = write_log(tmp_path / "pen.mcap", wrist_parts(2))
    kept = foreign.read_bytes()
    with pytest.raises(TooltipError, match=r"pen\.mcap is no simulated recording; .* --force"):
        reuse_simulation(params, foreign)
    odd = write_log(tmp_path / "odd.mcap", wrist_parts(2), {"truth.json": b"[1]"})
    with pytest.raises(TooltipError, match=r"odd\.mcap does not say how it was simulated"):
        reuse_simulation(params, odd)
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(kept[: len(kept) // 2])
    with pytest.raises(TooltipError, match=r"broken\.mcap.*--force simulates it anew"):
        reuse_simulation(params, broken)
    assert foreign.read_bytes() == kept
    assert not reuse_simulation(params, foreign, force=True).reused
    assert reuse_simulation(params, foreign).reused


def test_recording_refuses_to_take_labels_of_another_recording(tmp_path: Path) -> None:
    labels = tmp_path / "pen.labels.csv"
    labels.write_text("mine")
    params = SimParams("pen", frames=2, size=(64, 48))
    with pytest.raises(TooltipError, match=r"pen\.labels\.csv exists"):
        record_simulation(params, tmp_path / "pen.mcap")
    with pytest.raises(TooltipError, match=r"pen\.labels\.csv exists"):
        reuse_simulation(params, tmp_path / "pen.mcap")
    assert labels.read_text() == "mine"
    assert not (tmp_path / "pen.mcap").exists()
