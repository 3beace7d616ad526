"""The other charts over all tools: Figure 7 of the paper, and error against training frames."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tooltip_cli.report import words
from tooltip_cli.report.bars import shortened
from tooltip_cli.report.charts import (
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

_COARSE_BINS = 30
_DETAIL_PX = 30
_NARROW = 8.0  # a smaller ratio of errors needs no logarithmic axis
_TRAINING_TICKS = (10, 25, 50, 100, 200, 400, 800, 1600)


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
    chart = Chart(4.55, right=0.17)
    chart.canvas.subplots_adjust(hspace=0.32)
    whole, close = chart.axes(2, 1)
    width = step * histogram.bin_px
    whole.bar(np.arange(len(coarse)) * width, coarse, width * 0.92, align="edge", color=DETECTION)
    whole.set_xlim(0, len(coarse) * width)
    whole.set_xlabel(f"detection error [px], bins of {width:g} px")
    close.bar(np.arange(len(detail)), detail, 0.9, align="edge", color=DETECTION)
    close.set_xlim(0, _DETAIL_PX)
    beyond = histogram.detections - int(detail.sum())
    close.set_xlabel(f"detection error [px], {beyond} beyond {_DETAIL_PX} px")
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
        f"Histogram of {histogram.detections} detection errors: {words.percent(near)} are below "
        f"10 pixels, the median lies near {median:.0f} pixels, the largest near {len(counts)} "
        "pixels.",
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


def _medians(curves: Sequence[Sequence[tuple[int, float | None]]]) -> list[tuple[float, float]]:
    """Return the median over tools at each number of frames that most of them have.

    All that a tool has is one such number: a few more or less in one recording than in another.
    """
    points = [
        (frames if place < len(curve) - 1 else None, frames, error)
        for curve in curves
        for place, (frames, error) in enumerate(curve)
        if error
    ]
    found = []
    for which in {key for key, *_ in points}:
        mine = [(frames, error) for key, frames, error in points if key == which]
        if len(mine) * 2 > len(curves):
            frames, error = np.median(mine, axis=0)
            found.append((float(frames), float(error)))
    return sorted(found)


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
    chart = Chart(3.2, top=0.3, right=0.15)
    axes = chart.axes()
    for points in curves.values():
        frames, errors = [p[0] for p in points], [np.nan if p[1] is None else p[1] for p in points]
        axes.plot(frames, errors, color=DETECTOR, alpha=0.35, marker="o", markersize=2.5)
    sizes = sorted({point[0] for points in curves.values() for point in points})
    shared = _medians([[(p[0], p[1]) for p in points] for points in curves.values()])
    if len(curves) > 1 and shared:
        axes.plot(
            *zip(*shared, strict=True),
            color=INK,
            marker="o",
            markersize=3.5,
            label="median of the tools",
        )
        faint = {"color": DETECTOR, "alpha": 0.35, "marker": "o", "markersize": 2.5}
        axes.plot([], [], **faint, label="each tool")
        chart.legend_above(2)
    axes.set_xscale("log")
    ticks = [size for size in _TRAINING_TICKS if sizes[0] <= size <= 1.03 * sizes[-1]]
    axes.set_xticks(ticks, [str(size) for size in ticks])
    known = [p[1] for points in curves.values() for p in points if p[1] is not None]
    if max(known) > _NARROW * min(known):
        axes.set_yscale("log")
        axes.set_ylabel("mean prediction error [px], log scale")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    else:  # from zero, so that what hardly changes looks so
        axes.set_ylim(0, 1.1 * max(known))
        axes.set_ylabel("mean prediction error [px]")
    axes.minorticks_off()
    highest = max(curves, key=lambda name: max(p[1] or 0.0 for p in curves[name]))
    if len(curves) > 1:
        at = next(p for p in curves[highest] if p[1] is not None)
        axes.annotate(
            shortened(highest), at[:2], (3, 4), textcoords="offset points", color=MUTED, fontsize=8
        )
    axes.set_xlabel("training frames, log scale")
    bare(axes, "both")
    most = max(point.repeats for row in rows for point in row.training)
    times = "once" if most == 1 else f"up to {most} times"
    shown = "; ".join(f"{size:g} frames: {value:.1f}" for size, value in shared)
    return chart.drawing(
        "error-by-training",
        "Error by training frames",
        f"Line chart of the prediction error in pixels, median over tools: {shown}.",
        f"Each line is a tool. Fewer of the frames that it is estimated from are drawn at random, "
        f"{times} each, and the errors averaged, refused estimates left out. Where a line is flat, "
        "more frames would not help.",
        ("tool", "frames", "error_px", "low_px", "high_px"),
        [
            [name, str(frames), *(number(value) for value in values)]
            for name, points in curves.items()
            for frames, *values in points
        ],
    )
