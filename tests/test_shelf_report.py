"""The report over a shelf: numbers against numpy, memory that does not grow, page and tables."""

from __future__ import annotations

import csv
import datetime
import io
import json
import tracemalloc
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers.cli import tooltip
from tests.helpers.shelves import METHOD, make_shelf
from tooltip_cli.errors import TooltipError
from tooltip_cli.report.shelf_model import Sample, ShelfReport
from tooltip_cli.report.shelf_page import TABLES, headline, shelf_tables
from tooltip_cli.report.shelf_totals import (
    MOST_GROUPS,
    MOST_WORST,
    OTHERS,
    ShelfTotals,
    bin_of,
    middle_of,
)
from tooltip_cli.stages.shelf.summary import sample_of, shelf_report, stored_rows, write_report
from tooltip_cli.stages.shelf.table import Row, csv_table, parquet_table

DAY_S = 86400.0


def made(count: int, seed: int = 0, growth: float = 0.0) -> Iterator[Sample]:
    """Yield recordings of 100 days; from labels, errors of the second of two rigs grow by that."""
    rng = np.random.default_rng(seed)
    for number in range(count):
        day = 100 * number / count
        error, noise = rng.gamma(4) / 2, rng.lognormal(0, 0.1)
        rig = number % 2
        yield Sample(
            f"r{number}",
            f"/shelf/r{number}.mcap",
            "refused" if number % 10 == 9 else "ok",
            code="no_motion" if number % 10 == 9 else None,
            reason="it does not turn" if number % 10 == 9 else None,
            tool=f"tool {number % 3}",
            rig_id=f"id{rig}",
            recorded_s=1.7e9 + day * DAY_S,
            error_px=None if number % 10 == 9 else error,
            baseline_px=2 * noise * (1 + rig * growth) ** (day / 30) * (1 + number % 3),
            tip_m=(0.1, 0.0, 0.2 + 0.001 * rng.normal()),
            seconds=10.0,
        )


def gathered(samples: Sequence[Sample]) -> ShelfReport:
    totals = ShelfTotals()
    for sample in samples:
        totals.add(sample)
    return totals.report("test", "1", "now")


def test_numbers_are_those_of_numpy() -> None:
    samples = list(made(2000))
    report = gathered(samples)
    errors = np.array([sample.error_px for sample in samples if sample.error_px is not None])
    found = report.overall.error_px
    assert found is not None
    assert found.count == len(errors)
    assert found.mean == pytest.approx(errors.mean())
    half = 1.959964 * errors.std(ddof=1) / np.sqrt(len(errors))
    assert (found.low, found.high) == pytest.approx((errors.mean() - half, errors.mean() + half))
    assert found.median == pytest.approx(np.median(errors), rel=0.011)
    assert found.p95 == pytest.approx(np.percentile(errors, 95), rel=0.011)
    assert found.maximum == errors.max()
    of_tool = {sample.name: sample for sample in samples if sample.tool == "tool 1"}
    group = next(group for group in report.tools if group.name == "tool 1")
    assert group.counts.all == len(of_tool)
    tips = np.array([sample.tip_m for sample in of_tool.values()])
    assert group.scatter_mm == pytest.approx(
        1000 * np.sqrt(((tips - tips.mean(axis=0)) ** 2).sum(axis=1).mean())
    )
    assert report.overall.counts.refused == 200
    assert report.seconds == pytest.approx(20_000)
    assert sum(report.histogram.values()) == len(errors)
    for edge, count in report.histogram.items():
        upper = float(edge) * 1.011
        assert count <= ((errors <= upper) & (errors > upper / 2**0.25 / 1.03)).sum()


@given(st.floats(1e-3, 1e6))
def test_a_bin_is_narrow(value: float) -> None:
    assert middle_of(bin_of(value)) == pytest.approx(value, rel=0.0101)


def test_the_worst_are_the_worst() -> None:
    samples = list(made(500))
    scored = [sample for sample in samples if sample.error_px is not None]
    worst = sorted(scored, key=lambda sample: -(sample.error_px or 0))[:MOST_WORST]
    assert [case.name for case in gathered(samples).worst] == [sample.name for sample in worst]


def test_a_rig_that_drifts_is_told_from_one_that_does_not() -> None:
    report = gathered(list(made(600, growth=0.05)))
    rigs = {group.name: group for group in report.rigs}
    steady, moving = rigs["stored id0"].baseline_drift, rigs["stored id1"].baseline_drift
    assert moving is not None
    assert steady is not None
    assert moving.low < 5 < moving.high
    assert moving.clear
    assert abs(steady.percent) < 1
    assert report.overall.baseline_drift is not None
    assert "the error from labels changes by" in headline(report)
    assert gathered(list(made(10, growth=0.05))).overall.baseline_drift is None


def test_tools_used_at_different_times_are_no_drift() -> None:
    samples = [
        Sample(
            f"r{number}",
            "",
            "ok",
            tool="hard" if number >= 100 else "easy",
            rig_id="x",
            recorded_s=number * DAY_S,
            error_px=(8.0 if number >= 100 else 2.0) * (1 + 0.02 * (-1) ** number),
        )
        for number in range(200)
    ]
    drift = gathered(samples).overall.drift
    assert drift is not None
    assert abs(drift.percent) < 0.5


@settings(max_examples=30)
@given(st.lists(st.floats(0, 4e9), min_size=1, max_size=200))
def test_periods_hold_each_recording_once(moments: list[float]) -> None:
    samples = [
        Sample(str(place), "", "ok", recorded_s=moment, error_px=1.0)
        for place, moment in enumerate(moments)
    ]
    periods = gathered(samples).periods
    assert len(periods) <= 60
    assert sum(period.counts.all for period in periods) == len(moments)
    starts = [datetime.datetime.fromisoformat(period.start).timestamp() for period in periods]
    for start in starts:
        inside = [moment for moment in moments if start <= moment < start + periods[0].seconds]
        assert inside
    assert gathered(samples[::-1]).periods == periods


def test_memory_does_not_grow_with_the_number_of_recordings() -> None:
    peaks = []
    for count in (500, 4000):
        totals = ShelfTotals()
        for sample in made(500):  # caches of what is imported on use
            totals.add(sample)
        tracemalloc.start()
        for sample in made(count, seed=1):
            totals.add(sample)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.5 * peaks[0] + 50_000


def test_more_tools_than_can_be_told_apart_are_gathered() -> None:
    count = MOST_GROUPS + 50
    report = gathered([Sample(str(i), "", "ok", tool=f"t{i}", error_px=1.0) for i in range(count)])
    assert len(report.tools) == MOST_GROUPS + 1
    others = next(group for group in report.tools if group.name == OTHERS)
    assert others.counts.all == 50
    assert report.left_out == {"tools": 50}


def row(number: int) -> Row:
    return Row(
        f"r{number}",
        f"/shelf/r{number}.mcap",
        None,
        None,
        "<b>pen</b>",
        "failed" if number == 3 else "ok",
        code="failed" if number == 3 else None,
        reason='cut "off" <i>' if number == 3 else None,
        error_px=None if number == 3 else 1.0 + number,
        tip_x_m=0.1,
        tip_y_m=0.2,
        tip_z_m=0.3,
        recorded=f"2026-01-{number + 1:02d}T10:00:00.000+00:00",
        columns={"operator": "ana"},
    )


def test_both_tables_of_results_give_the_same_report(tmp_path: Path) -> None:
    rows = [row(number) for number in range(20)]
    (tmp_path / "r.csv").write_text(csv_table(rows))
    (tmp_path / "r.parquet").write_bytes(parquet_table(rows))
    reports = [
        shelf_report(stored_rows(tmp_path / name), "test") for name in ("r.csv", "r.parquet")
    ]
    assert reports[0].overall == reports[1].overall
    assert reports[0].tools == reports[1].tools
    assert reports[0].worst == reports[1].worst
    assert reports[0].worst[0].error_px == 20.0
    assert reports[0].periods == reports[1].periods


def test_the_report_is_written_whole(tmp_path: Path) -> None:
    (tmp_path / "r.csv").write_text(csv_table([row(number) for number in range(20)]))
    done = tooltip("evaluate", tmp_path / "r.csv")
    assert done.code == 0, done.err
    assert "19 of 20 recordings have an estimate; 1 failed." in done.out
    folder = tmp_path / "report"
    assert {path.name for path in folder.iterdir()} == {
        "index.html",
        "shelf.json",
        "figures",
        *TABLES,
    }
    page = (folder / "index.html").read_text()
    assert "<b>pen" not in page
    assert "&lt;b&gt;pen" in page
    assert "cut &quot;off&quot; &lt;i&gt;" in page
    for word in ("http:", "https:", "<script"):
        assert word not in page
    report = json.loads((folder / "shelf.json").read_text())
    assert report["overall"]["error_px"]["count"] == 19
    tools = list(csv.DictReader(io.StringIO((folder / "tools.csv").read_text())))
    assert float(tools[0]["error_px_mean"]) == pytest.approx(
        np.mean([1 + n for n in range(20) if n != 3]), abs=1e-4
    )
    worst = list(csv.DictReader(io.StringIO((folder / "worst.csv").read_text())))
    assert worst[0]["name"] == "r19"
    for figure in page.split('href="figures/')[1:]:
        assert (folder / "figures" / figure.split('"')[0]).exists()
    as_json = json.loads(tooltip("evaluate", tmp_path / "r.csv", "--json").out)
    assert as_json["overall"] == report["overall"]


def test_tables_have_as_many_cells_as_names() -> None:
    for name, text in shelf_tables(gathered(list(made(50)))):
        header, *rows = csv.reader(io.StringIO(text))
        assert rows, name
        assert {len(cells) for cells in rows} == {len(header)}, name


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name,recording,status\n", "cannot be|holds no row|expected"),
        ("name,recording,status\na,b,perhaps\n", "row 1: not a row of results"),
        ("name,recording,status,error_px\na,b,ok,x\n", "row 1: not a row of results"),
    ],
)
def test_what_is_no_table_of_results_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "r.csv").write_text(text)
    with pytest.raises(TooltipError, match=message):
        shelf_report(stored_rows(tmp_path / "r.csv"), "r.csv")


def test_nothing_is_invented_of_an_empty_row() -> None:
    sample = sample_of({"name": "a", "recording": "b", "status": "failed", "error_px": ""})
    report = gathered([sample])
    assert report.overall.error_px is None
    assert report.periods == ()
    assert "None of them has labels" in headline(report)


def test_a_shelf_is_run_and_gets_its_report(wrist_file: Path, tmp_path: Path) -> None:
    shelf = make_shelf(tmp_path / "shelf", wrist_file, 2)
    done = tooltip("evaluate", shelf, *METHOD, "--jobs", 1)
    assert done.code == 1  # one recording is broken
    assert "2 of 3 recordings have an estimate; 1 failed." in done.out
    page = shelf / "run" / "report" / "index.html"
    assert str(page) in done.out
    assert "truncated" in page.read_text()
    report = json.loads((page.parent / "shelf.json").read_text())
    assert [group["counts"]["ok"] for group in report["rigs"]].count(2) == 1
    done = tooltip("evaluate", shelf, *METHOD, "--json")
    assert json.loads(done.out)["report"] == str(page)
    done = tooltip("evaluate", shelf, "--train", 10)
    assert done.code == 2
    assert "--train is for recordings" in done.err
    done = tooltip("run", shelf, *METHOD, "--no-report", "--out", tmp_path / "bare")
    assert not (tmp_path / "bare" / "report").exists()


def test_the_page_in_a_browser(tmp_path: Path, browser: Any) -> None:
    page_file = write_report(gathered(list(made(300, growth=0.1))), tmp_path)
    for width in (380, 1280):
        page = browser.new_page(viewport={"width": width, "height": 800})
        said: list[str] = []
        page.on("console", lambda message, said=said: said.append(message.text))
        page.goto(f"file://{page_file}")
        assert page.locator("h1").inner_text() == "Tool tips of 300 recordings"
        assert page.locator("figure").count() == 5
        wide = page.evaluate("document.documentElement.scrollWidth")
        assert wide <= width
        assert said == []
        page.close()
