"""The tip and its uncertainty, seen along the axes of the hand frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tooltip_cli.method.types import Array
from tooltip_cli.report import words
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
from tooltip_cli.report.model import EstimateScore, RecordingReport
from tooltip_cli.report.scoring import CHI2_95_3D
from tooltip_cli.report.tables import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_VIEWS = ((0, 2), (1, 2), (0, 1))  # horizontal and vertical axis of each panel
_NAMES = "xyz"
_FAR = 3.0  # times the region: what lies farther off is told, not shown


@styled
def region_figure(row: RecordingReport) -> Drawing | None:
    """Return the estimate with its 95 % region, the baseline and the truth; None: refused."""
    ours, baseline = row.detector, row.baseline
    if ours is None or ours.position_m is None or ours.region_mm is None:
        return None
    center = np.array(ours.position_m)
    marks = {"estimate": np.zeros(3)}
    if baseline is not None and baseline.position_m is not None:
        marks["from labels"] = _millimetres(baseline.position_m, center)
    if row.truth_m is not None:
        marks["true tip"] = _millimetres(row.truth_m, center)
    near = max(_FAR * ours.region_mm[0], 5.0)
    shown = {name: place for name, place in marks.items() if np.linalg.norm(place) <= near}
    reach = 1.15 * max(ours.region_mm[0], *(float(np.abs(place).max()) for place in shown.values()))
    chart = Chart(3.75, left=0.5, right=0.12, top=0.1, bottom=0.42)
    chart.canvas.subplots_adjust(hspace=0.16, wspace=0.16)
    grid = chart.axes(2, 2)
    for axes, pair in zip((grid[0, 0], grid[0, 1], grid[1, 0]), _VIEWS, strict=True):
        _draw(axes, pair, ours, baseline, shown, reach)
    for axes in (grid[0, 0], grid[0, 1]):
        axes.tick_params(labelbottom=False)
    grid[0, 1].tick_params(labelleft=False, labelbottom=True)
    grid[0, 1].set_xlabel("y [mm]")
    grid[0, 0].set_ylabel("z [mm]")
    grid[1, 0].set(xlabel="x [mm]", ylabel="y [mm]")
    grid[1, 1].axis("off")
    grid[1, 1].legend(*grid[1, 0].get_legend_handles_labels(), loc="center", fontsize=8)
    far = [
        f"{name} {np.linalg.norm(place):.0f} mm away"
        for name, place in marks.items()
        if name not in shown
    ]
    beyond = f" Not in view: {', '.join(far)}." if far else ""
    spread = words.position_words(ours)
    return chart.drawing(
        f"{row.name}-region",
        "The tip's uncertainty",
        f"Three views of the estimated tip of {row.name} and its 95 % region along the hand's "
        f"axes. Tip {spread}; {words.region_words(ours)}.{beyond}",
        f"Millimetres from the estimate, along the axes of the hand frame. Ellipses: 95 % regions "
        f"of the estimate and of that from the labels. Tip {spread} (one standard deviation)."
        f"{beyond}",
        ("what", *(f"{axis}_mm" for axis in _NAMES), *(f"c_{pair}_mm2" for pair in _PAIRS)),
        [
            [name, *(number(float(value)) for value in place), *_spread(name, ours, baseline)]
            for name, place in marks.items()
        ],
    )


_PAIRS = ("xx", "xy", "xz", "yy", "yz", "zz")


def _millimetres(place_m: tuple[float, float, float], center: Array) -> Array:
    return np.asarray(1000 * (np.array(place_m) - center))


def _spread(name: str, ours: EstimateScore, baseline: EstimateScore | None) -> list[str]:
    """Return the six numbers of a mark's covariance; empty where it has none."""
    score = {"estimate": ours, "from labels": baseline}.get(name)
    if score is None or score.covariance_m2 is None:
        return [""] * len(_PAIRS)
    covariance = 1e6 * np.array(score.covariance_m2)
    return [number(float(value)) for value in covariance[np.triu_indices(3)]]


def _draw(
    axes: Axes,
    pair: tuple[int, int],
    ours: EstimateScore,
    baseline: EstimateScore | None,
    shown: dict[str, Array],
    reach: float,
) -> None:
    for name, score, color in (
        ("estimate", ours, DETECTOR),
        ("from labels", baseline, BASELINE),
    ):
        if name in shown and score is not None and score.covariance_m2 is not None:
            loop = shown[name][list(pair)] + shadow(np.array(score.covariance_m2), pair)
            axes.fill(*loop.T, color=color, alpha=0.14, linewidth=0)
            axes.plot(*loop.T, color=color, linewidth=1.1)
    axis = ours.candidates[0].axis if ours.candidates else None
    if axis is not None:
        along = 2 * reach * np.array(axis)[list(pair)]
        axes.plot(
            *zip(-along, along, strict=True),
            color=MUTED,
            linewidth=0.8,
            linestyle=(0, (4, 2)),
            label="tool's axis",
        )
    for name, color, marker in (
        ("estimate", DETECTOR, "+"),
        ("from labels", BASELINE, "x"),
        ("true tip", TRUTH, "D"),
    ):
        if name in shown:
            u, v = shown[name][list(pair)]
            axes.plot(
                [u],
                [v],
                color=color,
                marker=marker,
                markersize=4.5 if marker == "D" else 8,
                markeredgewidth=0.8 if marker == "D" else 1.6,
                markeredgecolor=INK if marker == "D" else color,
                linestyle="none",
                label=name,
            )
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    bare(axes, "both")


def shadow(covariance_m2: Array, pair: tuple[int, int], steps: int = 72) -> Array:
    """Return (steps + 1, 2) the outline of the 95 % ellipsoid seen along the third axis, mm.

    Args:
        covariance_m2: (3, 3).
        pair: the two axes that span the picture.
    """
    part = covariance_m2[np.ix_(pair, pair)]
    values, vectors = np.linalg.eigh(part)
    sizes = 1000 * np.sqrt(CHI2_95_3D * np.maximum(values, 0.0))
    angle = np.linspace(0, 2 * np.pi, steps + 1)
    return np.asarray((np.stack([np.cos(angle), np.sin(angle)], axis=1) * sizes) @ vectors.T)
