"""The bar charts over all tools: Figure 6 of the paper, the same in millimetres, and shares."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tooltip_cli.method.evaluation import ErrorSummary
from tooltip_cli.report.charts import (
    BASELINE,
    CLOCK,
    DETECTION,
    DETECTOR,
    INK,
    MUTED,
    PAPER,
    Chart,
    Drawing,
    bare,
    styled,
)
from tooltip_cli.report.model import EvaluationReport, RecordingReport
from tooltip_cli.report.tables import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_VALUE_SHARE = 0.13  # of the axis, that a value behind a bar takes
_MOST_BARS = 40  # more tools than this are not told apart in one chart


@styled
def error_by_tool(report: EvaluationReport) -> Drawing | None:
    """Figure 6: mean prediction error of each tool, detector beside baseline."""
    scored = [row for row in report.recordings if row.detector_px or row.baseline_px]
    rows = _shown(scored)
    if not rows:
        return None
    chart, axes = _bar_chart(rows)
    for offset, color, label, errors in (
        (0.2, DETECTOR, "from detections", [row.detector_px for row in rows]),
        (-0.2, BASELINE, "from labels", [row.baseline_px for row in rows]),
    ):
        places = np.arange(len(rows)) + offset
        means = [np.nan if error is None else error.mean for error in errors]
        axes.barh(places, means, 0.36, color=color, label=label)
        for place, error in zip(places, errors, strict=True):
            _interval_and_value(axes, place, error)
    _refused(axes, rows, [row.detector_px for row in rows])
    nearest = [(place, _nearest(row)) for place, row in enumerate(rows)]
    other = [(value, place + 0.2) for place, value in nearest if value is not None]
    if other:
        axes.plot(
            *zip(*other, strict=True),
            color=INK,
            marker="D",
            markersize=3.5,
            markerfacecolor=PAPER,
            linestyle="none",
            label="nearest end",
        )
    axes.set_xlabel("mean error [px], 95 % interval")
    axes.set_xlim(0, 1.22 * max(_reach(row) for row in rows))
    chart.legend_above(3)
    simulated = " Labels are simulated." if any(_simulated(row) for row in rows) else ""
    return chart.drawing(
        "error-by-tool",
        "Mean prediction error of each tool",
        "Bar chart of the mean prediction error in pixels. "
        + "; ".join(
            f"{row.name}: {_words(row.detector_px)} from detections, "
            f"{_words(row.baseline_px)} from labels"
            for row in reversed(rows)
        )
        + ".",
        "As Figure 6 of the paper: the tip is estimated from detections and, as a baseline, from "
        "the labels; both are projected into the test frames and compared with the labels. What "
        "the baseline is off comes from calibration, clocks and the labels themselves."
        + simulated
        + _left_out(scored, rows),
        (
            "tool",
            *(f"{kind}_px_{what}" for kind in ("detector", "baseline") for what in _WHAT),
            "nearest_candidate_px",
        ),
        [
            [
                row.name,
                *_cells(row.detector_px),
                *_cells(row.baseline_px),
                number(None if row.detector is None else row.detector.nearest_px),
            ]
            for row in rows
        ],
    )


@styled
def tip_error_by_tool(report: EvaluationReport) -> Drawing | None:
    """Distance between estimate and true tip of each tool, where the truth is known."""
    scored = [row for row in report.recordings if row.truth_m is not None]
    rows = _shown(scored)
    columns = (
        (0.2, DETECTOR, "from detections", [row.tip_error_mm for row in rows]),
        (-0.2, BASELINE, "from labels", [row.baseline_tip_error_mm for row in rows]),
    )
    known = [value for *_, values in columns for value in values if value is not None]
    if not known:
        return None
    radii = [_region(row) for row in rows]
    limit = 1.18 * max(*known, *map(float, np.nan_to_num(radii)))
    chart, axes = _bar_chart(rows)
    for offset, color, label, values in columns:
        places = np.arange(len(rows)) + offset
        lengths = [np.nan if value is None else value for value in values]
        axes.barh(places, lengths, 0.36, color=color, label=label)
        for place, value, radius in zip(places, values, radii, strict=True):
            if value is not None:
                hidden = color == DETECTOR and 0 <= radius - value < _VALUE_SHARE * limit
                _value(axes, radius if hidden else value, place, value)
    axes.plot(
        radii,
        np.arange(len(rows)) + 0.2,
        color=INK,
        marker="|",
        markersize=9,
        linestyle="none",
        label="stated 95 %",
    )
    _refused(axes, rows, [row.tip_error_mm for row in rows])
    axes.set_xlabel("distance to the true tip [mm]")
    axes.set_xlim(0, limit)
    chart.legend_above(3)
    return chart.drawing(
        "tip-error-by-tool",
        "Distance to the true tip",
        "Bar chart of the distance from the estimate to the true tip in millimetres. "
        + "; ".join(
            f"{row.name}: {_length(row.tip_error_mm)} from detections, "
            f"{_length(row.baseline_tip_error_mm)} from labels"
            for row in reversed(rows)
        )
        + ".",
        "The same estimates in space. Strokes: the longest semi-axis of the stated 95 % region; a "
        "bar that passes its stroke is farther off than was promised." + _left_out(scored, rows),
        ("tool", "tip_error_mm", "baseline_tip_error_mm", "region_mm"),
        [
            [
                row.name,
                number(row.tip_error_mm),
                number(row.baseline_tip_error_mm),
                number(float(radius)),
            ]
            for row, radius in zip(rows, radii, strict=True)
        ],
    )


@styled
def shares_by_tool(report: EvaluationReport) -> Drawing | None:
    """Where each tool's error comes from: detection, clocks, calibration and labels."""
    scored = [row for row in report.recordings if row.shares is not None]
    rows = _shown(scored)
    shares = [row.shares for row in rows if row.shares is not None]
    if not shares:
        return None
    chart, axes = _bar_chart(rows)
    places, start = np.arange(len(rows)), np.zeros(len(rows))
    for color, label, values in (
        (DETECTION, "detection", [max(item.detection_px, 0.0) for item in shares]),
        (CLOCK, "synchronisation", [item.clock_px for item in shares]),
        (BASELINE, "calibration, labels", [item.calibration_px for item in shares]),
    ):
        axes.barh(places, values, 0.6, left=start, color=color, label=label)
        start = start + np.array(values)
    for place, item, end in zip(places, shares, start, strict=True):
        _value(axes, float(end), float(place), item.total_px)
    axes.set_xlabel("share of the mean prediction error [px]")
    axes.set_xlim(0, 1.18 * float(start.max()))
    chart.legend_above(3)
    return chart.drawing(
        "shares-by-tool",
        "Where the error comes from",
        "Stacked bars of what the mean prediction error is made of, in pixels. "
        + "; ".join(
            f"{row.name}: {item.detection_px:.1f} detection, "
            f"{item.clock_px:.1f} synchronisation, "
            f"{item.calibration_px:.1f} calibration and labels"
            for row, item in zip(reversed(rows), reversed(shares), strict=True)
        )
        + ".",
        "Detection: what goes when labels take the place of detections. Synchronisation: what goes "
        "when the stamps are shifted. The rest is calibration and the labels' own noise. The "
        "number is the whole error; where the bar is longer, detections did better than labels."
        + _left_out(scored, rows),
        ("tool", "total_px", "detection_px", "clock_px", "calibration_px"),
        [
            [
                row.name,
                *(
                    number(value)
                    for value in (
                        item.total_px,
                        item.detection_px,
                        item.clock_px,
                        item.calibration_px,
                    )
                ),
            ]
            for row, item in zip(rows, shares, strict=True)
        ],
    )


def shortened(name: str, most: int = 22) -> str:
    """Return a name that fits beside a bar."""
    return name if len(name) <= most else f"{name[: most - 3]}..."


_WHAT = ("mean", "low", "high")


def _shown(rows: Sequence[RecordingReport]) -> list[RecordingReport]:
    """Return the tools of a bar chart from the bottom up: the largest error on top."""

    def severity(row: RecordingReport) -> float:
        return np.inf if row.detector_px is None else row.detector_px.mean

    return sorted(rows, key=severity)[-_MOST_BARS:]


def _left_out(scored: Sequence[RecordingReport], rows: Sequence[RecordingReport]) -> str:
    count = len(scored) - len(rows)
    return f" The {count} tools with the least error are left out." if count else ""


def _bar_chart(rows: Sequence[RecordingReport]) -> tuple[Chart, Axes]:
    """Return a chart with a line for each tool, and its axes."""
    longest = max(len(shortened(row.name)) for row in rows)
    left = min(1.6, 0.2 + 0.065 * longest)
    chart = Chart(0.77 + 0.36 * len(rows), left=left, top=0.28, bottom=0.42)
    axes: Axes = chart.axes()
    axes.set_ylim(-0.5, len(rows) - 0.5)
    axes.set_yticks(np.arange(len(rows)), [shortened(row.name) for row in rows])
    bare(axes, "x")
    return chart, axes


def _refused(axes: Axes, rows: Sequence[RecordingReport], values: Sequence[object]) -> None:
    for place, (row, value) in enumerate(zip(rows, values, strict=True)):
        if value is None:
            axes.text(0, place + 0.2, f" {row.status}", va="center", color=MUTED, fontsize=8)


def _nearest(row: RecordingReport) -> float | None:
    """Return the error of the nearest of several ends, where it is not the estimate."""
    best = None if row.detector is None else row.detector.nearest_px
    if best is None or row.detector_px is None or best > row.detector_px.mean - 0.05:
        return None
    return best


def _region(row: RecordingReport) -> float:
    """Return the longest semi-axis of the stated 95 % region, mm; NaN: none is stated."""
    region = None if row.detector is None else row.detector.region_mm
    return np.nan if region is None else region[0]


def _cells(error: ErrorSummary | None) -> list[str]:
    return [number(None if error is None else getattr(error, what)) for what in _WHAT]


def _reach(row: RecordingReport) -> float:
    errors = (row.detector_px, row.baseline_px)
    return max(error.high or error.mean for error in errors if error is not None)


def _simulated(row: RecordingReport) -> bool:
    return row.labels is not None and row.labels.simulated


def _words(error: ErrorSummary | None) -> str:
    return "none" if error is None else f"{error.mean:.1f}"


def _length(value: float | None) -> str:
    return "none" if value is None else f"{value:.1f}"


def _interval_and_value(axes: Axes, place: float, error: ErrorSummary | None) -> None:
    if error is None:
        return
    end = error.mean
    if error.low is not None and error.high is not None:
        for color, width in ((PAPER, 2.2), (INK, 0.9)):  # seen on its bar in light and dark
            axes.plot([error.low, error.high], [place, place], color=color, linewidth=width)
        end = error.high
    _value(axes, end, place, error.mean)


def _value(axes: Axes, end: float, place: float, value: float | None = None) -> None:
    """Write a bar's value behind its end."""
    axes.annotate(
        f"{end if value is None else value:.1f}",
        (end, place),
        (3, 0),
        textcoords="offset points",
        va="center",
        fontsize=7.5,
    )
