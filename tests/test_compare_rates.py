"""Comparing reports whose truth is known: how often nothing passes for something, and how often
something is seen."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from tooltip_cli import __version__
from tooltip_cli.method.evaluation import MeanInterval
from tooltip_cli.report.model import SCHEMA, EvaluationReport, RecordingReport
from tooltip_cli.report.overall import Totals
from tooltip_cli.report.tables import FRAME_COLUMNS, csv_text
from tooltip_cli.stages.artifacts import plain
from tooltip_cli.stages.compare import BETTER, SAME, WORSE, compare

Array = npt.NDArray[np.float64]

FRAMES = 100


def write_report(folder: Path, errors: dict[str, Array]) -> Path:
    """Write as much of a report as comparing reads: each tool's prediction errors by frame."""
    folder.mkdir(parents=True)
    rows = tuple(row_of(name) for name in errors)
    report = EvaluationReport(SCHEMA, __version__, "now", {}, rows, Totals().overall(), "")
    (folder / "report.json").write_text(json.dumps(plain(report)))
    lines = []
    for name, values in errors.items():
        for frame, value in enumerate(values):
            known = {
                "tool": name,
                "frame": str(frame),
                "stamp_ns": str(frame),
                "label_u": "1.0",
                "label_v": "2.0",
                "prediction_error_px": f"{value:.4f}",
            }
            lines.append([known.get(column, "") for column in FRAME_COLUMNS])
    (folder / "frames.csv").write_text(csv_text(FRAME_COLUMNS, lines))
    return folder


def row_of(name: str) -> RecordingReport:
    return RecordingReport(
        name=name,
        recording=f"{name}.mcap",
        sha256="",
        status="ok",
        reasons=(),
        notes=(),
        frames=500,
        duration_s=16.0,
        image_size=(640, 480),
        scored=FRAMES,
        split=None,
        labels=None,
        truth_m=None,
        apart_mm=None,
        detection=None,
        detector=None,
        baseline=None,
        shares=None,
        training=(),
        provenance={},
    )


def alike(rng: np.random.Generator, count: int, tie: float) -> Array:
    """Return (count,) numbers of unit variance whose neighbours correlate by ``tie``."""
    noise = rng.normal(size=count + 50)
    values = np.zeros(count + 50)
    for place in range(1, count + 50):
        values[place] = tie * values[place - 1] + np.sqrt(1 - tie**2) * noise[place]
    return values[50:]


def verdicts(
    tmp_path: Path, times: int, shift_px: float, tie: float, tools: int
) -> tuple[list[str], list[str]]:
    """Compare reports on tools whose errors differ by this on average; by tool, and over all."""
    rng = np.random.default_rng(7)
    single, overall = [], []
    for time in range(times):
        before, after = {}, {}
        for tool in range(tools):
            shared = np.abs(rng.normal(2.0, 1.0, FRAMES))  # the labels' noise is in both
            before[f"t{tool}"] = 5 + shared
            after[f"t{tool}"] = 5 + shared + shift_px + 0.5 * alike(rng, FRAMES, tie)
        pair = [
            write_report(tmp_path / f"{time}-{name}", errors)
            for name, errors in (("before", before), ("after", after))
        ]
        (found,) = compare(pair)
        single += [tool.verdict for tool in found.tools]
        assert found.overall is not None
        overall.append(found.overall.verdict)
    return single, overall


@pytest.mark.parametrize("tie", [0.0, 0.4])
def test_nothing_passes_for_something_about_once_in_twenty(tmp_path: Path, tie: float) -> None:
    """With or without neighbours that err alike; 400 tools, 100 means over four tools."""
    single, overall = verdicts(tmp_path, 100, 0.0, tie, tools=4)
    for found in (single, overall):
        false = np.mean([verdict != SAME for verdict in found])
        assert false <= 0.05 + 3 * np.sqrt(0.05 * 0.95 / len(found))
    assert BETTER in single  # not by never saying anything
    assert WORSE in single


@pytest.mark.parametrize(("shift_px", "expected"), [(-0.25, BETTER), (0.25, WORSE)])
def test_something_is_seen(tmp_path: Path, shift_px: float, expected: str) -> None:
    """Half a deviation of the differences, which is five of their mean."""
    single, overall = verdicts(tmp_path, 20, shift_px, 0.0, tools=3)
    assert np.mean([verdict == expected for verdict in single]) > 0.95
    assert set(overall) == {expected}


@pytest.mark.parametrize("tools", [1, 5])
def test_intervals_hold_the_mean_nineteen_times_in_twenty(tools: int) -> None:
    """From few frames, too, where percentiles alone hold it six times in seven."""
    rng = np.random.default_rng(11)
    held = []
    for _ in range(600):
        interval = MeanInterval(draws=500)
        for tool in range(tools):
            interval.add(rng.normal(3.0, 1.0 + tool, size=15), tool)
        low, high = interval.interval() or (np.nan, np.nan)
        held.append(low <= 3.0 <= high)
    assert np.mean(held) == pytest.approx(0.95, abs=0.035)


def test_a_tool_with_one_frame_leaves_no_interval() -> None:
    interval = MeanInterval()
    interval.add(np.array([1.0, 2.0, 4.0]), 0)
    assert interval.interval() is not None
    interval.add(np.array([1.0]), 1)
    assert interval.interval() is None


def test_equal_reports_show_no_difference(tmp_path: Path) -> None:
    errors = {"pen": np.linspace(1, 2, FRAMES)}
    pair = [write_report(tmp_path / name, errors) for name in ("one", "two")]
    (found,) = compare(pair)
    (tool,) = found.tools
    assert (tool.verdict, tool.change_px, tool.low_px, tool.high_px) == (SAME, 0.0, 0.0, 0.0)
