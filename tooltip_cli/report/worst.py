"""Charts of one recording that say where it is worst: over time and over the hand's turn."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from tooltip_cli.method.types import Array
from tooltip_cli.report.charts import (
    BASELINE,
    DETECTION,
    DETECTOR,
    MUTED,
    Chart,
    Drawing,
    bare,
    styled,
)
from tooltip_cli.report.model import FrameTable, RecordingReport
from tooltip_cli.report.tables import number

_FLOOR_PX = 0.1  # smaller errors are drawn here on the logarithmic axis
_AXES = (  # of the camera: x to the right, y down, z forward
    "nod about the camera's x axis",
    "swing about the camera's y axis",
    "roll about the line of sight",
)
_LEAST_IN_SECTOR = 5
_NOTABLE = 1.2  # times the mean over all frames


def worst_figures(row: RecordingReport, table: FrameTable) -> Iterator[Drawing]:
    """Yield the charts that have data."""
    errors, kind = _errors(table)
    if not np.isfinite(errors).any():
        return
    yield _over_time(row, table)
    yield _over_turn(row, table, errors, kind)


def _errors(table: FrameTable) -> tuple[Array, str]:
    """Return (T,) the errors that matter and what they are, by what the labels allow."""
    if np.isfinite(table.prediction_error_px).any():
        return table.prediction_error_px, "prediction error"
    if np.isfinite(table.baseline_error_px).any():
        return table.baseline_error_px, "baseline error (there is no prediction)"
    return table.apart_px, "distance from detection to prediction (there are no labels)"


@styled
def _over_time(row: RecordingReport, table: FrameTable) -> Drawing:
    from matplotlib.ticker import LogLocator

    seconds = (table.stamps_ns - table.stamps_ns[0]) * 1e-9
    labelled = np.isfinite(table.label).all(axis=1).any()
    series = [
        ("detection", table.detection_error_px, DETECTION, "x", 3.0),
        ("prediction", table.prediction_error_px, DETECTOR, "o", 3.2),
        ("baseline", table.baseline_error_px, BASELINE, "o", 2.4),
    ]
    if not labelled:
        series = [("detection to prediction", table.apart_px, DETECTION, "x", 3.0)]
    chart = Chart(2.6, top=0.3)
    axes = chart.axes()
    for name, errors, color, marker, size in series:
        axes.plot(
            seconds,
            np.maximum(errors, _FLOOR_PX),
            color=color,
            marker=marker,
            markersize=size,
            linestyle="none",
            label=name,
        )
    hidden = np.array([state in ("occluded", "out_of_view") for state in table.states])
    if hidden.any():
        ticks = seconds[hidden]
        axes.plot(
            ticks,
            np.full(len(ticks), 0.02),
            color=MUTED,
            marker="|",
            markersize=6,
            linestyle="none",
            label="hidden",
            transform=axes.get_xaxis_transform(),
        )
    axes.set_yscale("log")
    axes.minorticks_off()
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
    axes.set_xlabel("time since the first test frame [s]")
    axes.set_ylabel("error [px]" if labelled else "distance [px]")
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    bare(axes, "y")
    chart.legend_above(4)
    key = ["Strokes at the bottom: frames whose label says that the tip is hidden."]
    key = key if hidden.any() else []
    if any((errors < _FLOOR_PX).any() for _, errors, *_ in series):
        key.append(f"Errors below {_FLOOR_PX:g} px are drawn at that height.")
    subject = "Errors" if labelled else "Distances from detection to prediction"
    worst = _worst_stretch(seconds, _errors(table)[0])
    return chart.drawing(
        f"{row.name}-over-time",
        "Error over time",
        f"{subject} of {row.name} in each test frame over {seconds[-1]:.0f} seconds. {worst}",
        " ".join([f"{subject} in each test frame, on a logarithmic axis.", *key, worst]),
        (
            "seconds",
            "detection_px",
            "prediction_px",
            "baseline_px",
            "detection_to_prediction_px",
            "hidden",
        ),
        [
            [
                number(float(second)),
                *(
                    number(float(column[index]))
                    for column in (
                        table.detection_error_px,
                        table.prediction_error_px,
                        table.baseline_error_px,
                        table.apart_px,
                    )
                ),
                str(int(hidden[index])),
            ]
            for index, second in enumerate(seconds)
        ],
    )


def _worst_stretch(seconds: Array, errors: Array, parts: int = 5) -> str:
    """Say in which fifth of the recording the error is largest."""
    means = []
    edges = np.linspace(0, seconds[-1] + 1e-9, parts + 1)
    for start, stop in pairwise(edges):
        inside = errors[(seconds >= start) & (seconds < stop) & np.isfinite(errors)]
        if len(inside) >= _LEAST_IN_SECTOR:
            means.append((float(inside.mean()), start, stop))
    if len(means) < 2:
        return ""
    mean, start, stop = max(means)
    if mean < _NOTABLE * float(np.nanmean(errors)):
        return "No part of the recording stands out."
    return (
        f"Worst from {start:.0f} to {stop:.0f} s, with a mean of {mean:.1f} px; best fifth: "
        f"{min(means)[0]:.1f} px."
    )


@styled
def _over_turn(row: RecordingReport, table: FrameTable, errors: Array, kind: str) -> Drawing:
    turns = table.turn_deg
    known = np.isfinite(turns).all(axis=1) & np.isfinite(errors)
    spread = np.where(known.any(), turns[known].std(axis=0), 0.0)
    first, second = sorted(np.argsort(-spread, kind="stable")[:2])
    chart = Chart(2.9, left=0.62, right=0.42)
    axes = chart.axes()
    dots = axes.scatter(
        turns[known, first],
        turns[known, second],
        c=errors[known],
        s=16,
        cmap="viridis",
        linewidths=0.3,
        edgecolors=MUTED,
    )
    bar = chart.canvas.colorbar(dots, ax=axes, fraction=0.05, pad=0.04)
    bar.set_label("error [px]" if "error" in kind else "distance [px]")
    bar.outline.set_visible(False)
    axes.set_xlabel(f"{_AXES[first]} [deg]")
    axes.set_ylabel(f"{_AXES[second]} [deg]")
    bare(axes, "both")
    worst = _worst_sector(turns[known][:, [first, second]], errors[known], (first, second))
    return chart.drawing(
        f"{row.name}-over-turn",
        "Error over wrist pose",
        f"Test frames of {row.name} by the hand's turn, coloured by {kind}. {worst}",
        f"Each dot is a test frame, placed by the hand's turn from its mean orientation, seen "
        f"from the camera, and coloured by its {kind}. {worst}",
        ("frame", "turn_x_deg", "turn_y_deg", "turn_z_deg", "error_px"),
        [
            [str(int(frame)), *(number(float(v), 3) for v in turn), number(float(error))]
            for frame, turn, error in zip(
                table.frames[known], turns[known], errors[known], strict=True
            )
        ],
    )


def _worst_sector(turns: Array, errors: Array, axes: tuple[int, int]) -> str:
    """Say which third of the hand's turns has the largest mean error."""
    found = []
    for column, axis in enumerate(axes):
        low, high = np.percentile(turns[:, column], [100 / 3, 200 / 3])
        for name, inside in (
            (f"more than {round(high)} degrees", turns[:, column] > high),
            (f"less than {round(low)} degrees", turns[:, column] < low),
        ):
            if inside.sum() >= _LEAST_IN_SECTOR:
                found.append((float(errors[inside].mean()), f"{_AXES[axis]} is {name}"))
    if not found:
        return ""
    mean, where = max(found)
    if mean < _NOTABLE * float(errors.mean()):
        return "No part of the wrist's range stands out."
    return (
        f"Worst where its {where}: {mean:.1f} px, against {float(errors.mean()):.1f} px over all."
    )
