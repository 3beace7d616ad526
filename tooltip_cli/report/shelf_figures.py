"""The charts of the report over a shelf."""

from __future__ import annotations

import datetime
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from tooltip_cli.report.bars import shortened
from tooltip_cli.report.charts import (
    BASELINE,
    DETECTOR,
    INK,
    MUTED,
    TRUTH,
    Chart,
    Drawing,
    bare,
    styled,
)
from tooltip_cli.report.shelf_model import Counts, Group, Period, ShelfReport
from tooltip_cli.report.tables import number

_MOST_BARS = 30


def shelf_figures(report: ShelfReport) -> Iterator[Drawing]:
    """Yield the charts that there is something for."""
    if report.histogram:
        yield _distribution(report)
    if len(report.tools) > 1 and any(group.error_px for group in report.tools):
        yield _by_group(report.tools, "tool")
    if len(report.rigs) > 1 and any(group.error_px for group in report.rigs):
        yield _by_group(report.rigs, "rig")
    if len(report.periods) > 1:
        if any(period.error_px is not None for period in report.periods):
            yield _error_over_time(report.periods)
        yield _status_over_time(report.periods)


@styled
def _distribution(report: ShelfReport) -> Drawing:
    uppers = np.array([float(edge) for edge in report.histogram])
    counts = np.array(list(report.histogram.values()))
    chart = Chart(2.5, left=0.6)
    axes = chart.axes()
    lowers = uppers / 2**0.25
    axes.bar(lowers, counts, width=0.97 * (uppers - lowers), align="edge", color=DETECTOR)
    axes.set_xscale("log", base=2)
    axes.xaxis.set_major_formatter(lambda value, place: f"{value:.2g}")
    axes.set_xlabel("mean prediction error of a recording [px]")
    axes.set_ylabel("recordings")
    bare(axes, "y")
    error = report.overall.error_px
    median = "" if error is None else f"; the median is {error.median:.1f} px"
    return chart.drawing(
        "shelf-errors",
        "Errors of all recordings",
        f"Histogram of the mean prediction error of {counts.sum()} recordings{median}.",
        "The mean prediction error of each recording that has labels, in bins of a quarter octave.",
        ("from_px", "to_px", "recordings"),
        [
            [number(low), number(high), int(count)]
            for low, high, count in zip(lowers, uppers, counts, strict=True)
        ],
    )


@styled
def _by_group(groups: Sequence[Group], kind: str) -> Drawing:
    scored = [group for group in groups if group.error_px is not None]
    shown = scored[:_MOST_BARS][::-1]
    longest = max(len(shortened(group.name)) for group in shown)
    chart = Chart(
        0.75 + 0.3 * len(shown), left=min(1.7, 0.2 + 0.065 * longest), top=0.28, bottom=0.42
    )
    axes = chart.axes()
    places = np.arange(len(shown))
    for offset, color, label, found in (
        (0.2, DETECTOR, "from detections", [group.error_px for group in shown]),
        (-0.2, BASELINE, "from labels (baseline)", [group.baseline_px for group in shown]),
    ):
        means = [np.nan if item is None else item.mean for item in found]
        axes.barh(places + offset, means, 0.36, color=color, label=label)
        for place, item in zip(places + offset, found, strict=True):
            if item is not None and item.low is not None:
                axes.plot([item.low, item.high], [place, place], color=INK, linewidth=0.9)
    axes.set_ylim(-0.5, len(shown) - 0.5)
    axes.set_yticks(places, [shortened(group.name) for group in shown])
    axes.set_xlabel("mean error [px]; whiskers: 95 %")
    axes.set_xlim(left=0)
    bare(axes, "x")
    chart.legend_above(2)
    more = len(scored) - len(shown)
    return chart.drawing(
        f"shelf-{kind}s",
        f"Error by {kind}",
        f"Bar chart of the mean error in pixels by {kind}, largest first. "
        + "; ".join(f"{group.name}: {_mean(group):.1f}" for group in shown[::-1])
        + ".",
        f"The mean over the recordings of each {kind}, largest first."
        + (f" The {more} with less are left out." if more else ""),
        (kind, "recordings", "error_px", "low_px", "high_px", "baseline_px"),
        [
            [
                group.name,
                group.counts.all,
                number(_mean(group)),
                number(group.error_px.low if group.error_px else None),
                number(group.error_px.high if group.error_px else None),
                number(group.baseline_px.mean if group.baseline_px else None),
            ]
            for group in shown[::-1]
        ],
    )


def _mean(group: Group) -> float:
    return 0.0 if group.error_px is None else group.error_px.mean


def _moments(periods: Sequence[Period]) -> list[datetime.datetime]:
    half = datetime.timedelta(seconds=periods[0].seconds / 2)
    return [datetime.datetime.fromisoformat(period.start) + half for period in periods]


def _dates(axes: Any) -> None:
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

    locator = AutoDateLocator(maxticks=5)  # type: ignore[no-untyped-call]
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]


@styled
def _error_over_time(periods: Sequence[Period]) -> Drawing:
    chart = Chart(2.5, left=0.6, top=0.28)
    axes = chart.axes()
    moments = _moments(periods)
    for color, label, found in (
        (DETECTOR, "from detections", [period.error_px for period in periods]),
        (BASELINE, "from labels (baseline)", [period.baseline_px for period in periods]),
    ):
        values = [np.nan if value is None else value for value in found]
        axes.plot(moments, values, color=color, label=label, marker="o", markersize=3)
    axes.set_ylim(bottom=0)
    axes.set_ylabel("mean error [px]")
    _dates(axes)
    bare(axes, "y")
    chart.legend_above(2)
    ends = [period for period in periods if period.error_px is not None]
    return chart.drawing(
        "shelf-drift",
        "Error over time",
        f"Line chart of the mean error over {len(periods)} periods, from "
        f"{ends[0].error_px:.1f} px in the first to {ends[-1].error_px:.1f} px in the last.",
        f"The mean over the recordings of each period of {length_words(periods[0].seconds)}, by "
        "the stamp of their first image. A baseline that rises says that camera, clocks or joints "
        "have changed; the estimate alone, that the tools or the light have.",
        ("start", "recordings", "error_px", "baseline_px", "tip_error_mm"),
        [
            [
                period.start,
                period.counts.all,
                number(period.error_px),
                number(period.baseline_px),
                number(period.tip_error_mm),
            ]
            for period in periods
        ],
    )


@styled
def _status_over_time(periods: Sequence[Period]) -> Drawing:
    chart = Chart(2.5, left=0.6, top=0.28)
    axes = chart.axes()
    moments = _moments(periods)
    width = datetime.timedelta(seconds=0.9 * periods[0].seconds)
    bottom = np.zeros(len(periods))
    for color, name in ((TRUTH, "ok"), (MUTED, "refused"), (BASELINE, "failed")):
        counts = np.array([getattr(period.counts, name) for period in periods], dtype=float)
        axes.bar(moments, counts, width=width, bottom=bottom, color=color, label=name)
        bottom += counts
    axes.set_ylabel("recordings")
    _dates(axes)
    bare(axes, "y")
    chart.legend_above(3)
    return chart.drawing(
        "shelf-status",
        "Recordings over time",
        f"Stacked bars of the recordings of {len(periods)} periods by their status: "
        + "; ".join(f"{period.start[:10]} {_count_words(period.counts)}" for period in periods[-3:])
        + " in the last ones.",
        "What became of the recordings of each period. Those that nothing could be read of have no "
        "time and are not shown.",
        ("start", "ok", "refused", "failed"),
        [
            [period.start, period.counts.ok, period.counts.refused, period.counts.failed]
            for period in periods
        ],
    )


def _count_words(counts: Counts) -> str:
    return f"{counts.ok} ok, {counts.refused} refused, {counts.failed} failed"


def length_words(seconds: float) -> str:
    """Return a length of time in its largest whole unit."""
    for name, unit in (("week", 7 * 86400), ("day", 86400), ("hour", 3600), ("minute", 60)):
        if seconds >= unit:
            count = round(seconds / unit)
            return f"{count} {name}{'s' if count > 1 else ''}"
    return f"{seconds:g} s"
