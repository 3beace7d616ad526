"""The charts over all tools: Figures 6 and 7 of the paper, and error against training frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tooltip_cli.method.evaluation import ErrorSummary
from tooltip_cli.report.charts import (
    BASELINE,
    DETECTION,
    DETECTOR,
    INK,
    MUTED,
    Chart,
    Drawing,
    bare,
    styled,
)
from tooltip_cli.report.model import EvaluationReport, Histogram, RecordingReport
from tooltip_cli.report.tables import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MOST_BARS = 40  # more tools than this are not told apart in one chart
_COARSE_BINS = 30
_DETAIL_PX = 30
_TRAINING_TICKS = (10, 25, 50, 100, 200, 400, 800, 1600)


@styled
def error_by_tool(report: EvaluationReport) -> Drawing | None:
    """Figure 6: mean prediction error of each tool, detector beside baseline."""
    scored = [
        row for row in report.recordings if _error(row, "detector") or _error(row, "baseline")
    ]
    rows = sorted(scored, key=_detector_mean)[-_MOST_BARS:]
    if not rows:
        return None
    longest = max(len(row.name) for row in rows)
    chart = Chart(
        0.75 + 0.36 * len(rows), left=min(1.6, 0.2 + 0.065 * longest), top=0.28, bottom=0.42
    )
    axes = chart.axes()
    places = np.arange(len(rows))
    for offset, which, color, label in (
        (0.2, "detector", DETECTOR, "from detections"),
        (-0.2, "baseline", BASELINE, "from labels (baseline)"),
    ):
        errors = [_error(row, which) for row in rows]
        means = [np.nan if error is None else error.mean for error in errors]
        axes.barh(places + offset, means, 0.36, color=color, label=label)
        for place, error in zip(places + offset, errors, strict=True):
            _interval_and_value(axes, place, error)
    for place, row in zip(places, rows, strict=True):
        if _error(row, "detector") is None:
            axes.text(0, place + 0.2, f" {row.status}", va="center", color=MUTED, fontsize=8)
    axes.set_ylim(-0.5, len(rows) - 0.5)
    axes.set_yticks(places, [shortened(row.name) for row in rows])
    axes.set_xlabel("mean prediction error [px]; whiskers: 95 % interval")
    axes.set_xlim(0, 1.22 * max(_reach(row) for row in rows))
    bare(axes, "x")
    chart.legend_above(2)
    left_out = len(scored) - len(rows)
    note = f" The {left_out} tools with the least error are left out." if left_out else ""
    simulated = " Labels are simulated." if any(_simulated(row) for row in rows) else ""
    return chart.drawing(
        "error-by-tool",
        "Mean prediction error of each tool",
        "Bar chart of the mean prediction error in pixels. "
        + "; ".join(
            f"{row.name}: {_words(row, 'detector')} from detections, "
            f"{_words(row, 'baseline')} from labels"
            for row in reversed(rows)
        )
        + ".",
        "As Figure 6 of the paper: the tip is estimated from detections and, as a baseline, from "
        "the labels; both are projected into the test frames and compared with the labels. What "
        "the baseline is off comes from calibration, clocks and the labels themselves."
        + simulated
        + note,
        ("tool", *(f"{kind}_px_{what}" for kind in ("detector", "baseline") for what in _WHAT)),
        [
            [row.name, *(cell for kind in ("detector", "baseline") for cell in _cells(row, kind))]
            for row in rows
        ],
    )


def shortened(name: str, most: int = 22) -> str:
    """Return a name that fits beside a bar."""
    return name if len(name) <= most else f"{name[: most - 3]}..."


_WHAT = ("mean", "low", "high")


def _cells(row: RecordingReport, kind: str) -> list[str]:
    error = _error(row, kind)
    return [number(None if error is None else getattr(error, what)) for what in _WHAT]


def _error(row: RecordingReport, kind: str) -> ErrorSummary | None:
    score = row.detector if kind == "detector" else row.baseline
    return None if score is None else score.error_px


def _detector_mean(row: RecordingReport) -> float:
    error = _error(row, "detector")
    return np.inf if error is None else error.mean


def _reach(row: RecordingReport) -> float:
    errors = [_error(row, kind) for kind in ("detector", "baseline")]
    return max(error.high or error.mean for error in errors if error is not None)


def _simulated(row: RecordingReport) -> bool:
    return row.labels is not None and row.labels.simulated


def _words(row: RecordingReport, kind: str) -> str:
    error = _error(row, kind)
    return "none" if error is None else f"{error.mean:.1f}"


def _interval_and_value(axes: Axes, place: float, error: ErrorSummary | None) -> None:
    if error is None:
        return
    end = error.mean
    if error.low is not None and error.high is not None:
        axes.plot([error.low, error.high], [place, place], color=INK, linewidth=0.9)
        end = error.high
    axes.annotate(
        f"{error.mean:.1f}",
        (end, place),
        (3, 0),
        textcoords="offset points",
        va="center",
        fontsize=7.5,
    )


@styled
def detection_histogram(report: EvaluationReport) -> Drawing | None:
    """Figure 7: errors of the 2D detections over all tools, and a detailed view."""
    histogram = report.overall.histogram
    if not histogram.detections:
        return None
    counts = np.array(histogram.counts)
    step = max(1, int(np.ceil(len(counts) / _COARSE_BINS)))
    coarse = np.add.reduceat(counts, np.arange(0, len(counts), step))
    detail = counts[:_DETAIL_PX]
    chart = Chart(4.4)
    chart.canvas.subplots_adjust(hspace=0.32)
    whole, close = chart.axes(2, 1)
    width = step * histogram.bin_px
    whole.bar(np.arange(len(coarse)) * width, coarse, width * 0.92, align="edge", color=DETECTION)
    whole.set_xlabel(f"detection error [px], bins of {width:g} px")
    close.bar(np.arange(len(detail)), detail, 0.9, align="edge", color=DETECTION)
    close.set_xlim(0, _DETAIL_PX)
    beyond = histogram.detections - int(detail.sum())
    close.set_xlabel(f"detection error up to {_DETAIL_PX} px ({beyond} detections lie beyond)")
    for axes in (whole, close):
        axes.set_ylabel("detections")
        axes.set_ylim(0, max(1.0, 1.05 * axes.dataLim.y1))
        axes.yaxis.get_major_locator().set_params(integer=True)
        bare(axes, "y")
    near = counts[:10].sum() / histogram.detections
    median = _median(histogram)
    return chart.drawing(
        "detection-histogram",
        "Errors of the 2D detections, all tools",
        f"Histogram of {histogram.detections} detection errors: {near:.0%} are below 10 pixels, "
        f"the median lies near {median:.0f} pixels, the largest near {len(counts)} pixels.",
        "As Figure 7 of the paper: the distance from the motion interest point to the label, in "
        f"every test frame that has both ({histogram.detections} detections of all tools); above "
        "over the whole range, below in detail.",
        ("from_px", "to_px", "detections"),
        [
            [f"{index * histogram.bin_px:g}", f"{(index + 1) * histogram.bin_px:g}", str(count)]
            for index, count in enumerate(histogram.counts)
        ],
    )


def _median(histogram: Histogram) -> float:
    below = np.cumsum(histogram.counts)
    return float(histogram.edges_px[int(np.searchsorted(below, histogram.detections / 2))])


@styled
def error_by_training(rows: Sequence[RecordingReport]) -> Drawing | None:
    """Mean prediction error against the number of training frames (4.4: are 400 too many?)."""
    from matplotlib.ticker import LogLocator

    curves = {
        row.name: [
            (point.frames, point.error_px, point.low_px, point.high_px) for point in row.training
        ]
        for row in rows
        if any(point.error_px is not None for point in row.training)
    }
    if not curves:
        return None
    chart = Chart(3.0)
    axes = chart.axes()
    for points in curves.values():
        frames, errors = [p[0] for p in points], [np.nan if p[1] is None else p[1] for p in points]
        axes.plot(frames, errors, color=DETECTOR, alpha=0.35, marker="o", markersize=2.5)
    sizes = sorted({point[0] for points in curves.values() for point in points})
    common = [
        (size, [p[1] for points in curves.values() for p in points if p[0] == size and p[1]])
        for size in sizes
    ]
    shared = [
        (size, float(np.median(values))) for size, values in common if len(values) * 2 > len(curves)
    ]
    if len(curves) > 1 and shared:
        axes.plot(
            *zip(*shared, strict=True),
            color=INK,
            marker="o",
            markersize=3.5,
            label="median of the tools",
        )
        axes.legend(loc="upper right")
    axes.set_xscale("log")
    axes.set_yscale("log")
    ticks = [size for size in _TRAINING_TICKS if sizes[0] <= size <= sizes[-1]]
    axes.set_xticks(ticks, [str(size) for size in ticks])
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.minorticks_off()
    axes.set_xlabel("training frames with a detection")
    axes.set_ylabel("mean prediction error [px]")
    bare(axes, "both")
    words = "; ".join(f"{size} frames: {value:.1f}" for size, value in shared)
    return chart.drawing(
        "error-by-training",
        "Error against the number of training frames",
        f"Line chart of the prediction error in pixels, median over tools: {words}.",
        "Each line is a tool; fewer frames are drawn at random, several times, and the errors "
        "averaged, refused estimates left out. Where a line is flat, more frames would not help.",
        ("tool", "frames", "error_px", "low_px", "high_px"),
        [
            [name, str(frames), *(number(value) for value in values)]
            for name, points in curves.items()
            for frames, *values in points
        ],
    )
