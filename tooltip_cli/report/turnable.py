"""Figure 4: rays, hypothesised intersections, clusters and the tip in the hand frame.

Panels: what voting saw of hand and tool, where it did; training by detection; test by label. The
page turns them in the browser; the printed figure shows the same things from the side on which the
rays fan out.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tooltip_cli.log.views import Views
from tooltip_cli.method.estimators import EstimatorParams
from tooltip_cli.method.kmeans import nearest
from tooltip_cli.method.rays import intersections, plausible, rays_in_hand, sphere_array
from tooltip_cli.method.types import Array, Rays, TipPixels
from tooltip_cli.method.voting.estimate import METHOD as VOTING
from tooltip_cli.report import words
from tooltip_cli.report.charts import (
    BASELINE,
    DETECTOR,
    INK,
    MUTED,
    TRUTH,
    Chart,
    Drawing,
    styled,
)
from tooltip_cli.report.model import EstimateScore, RecordingReport
from tooltip_cli.report.ray_panels import COLUMNS, Panel, axis_ends, common_rows, panel_rows
from tooltip_cli.report.scenes import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CLUSTER_COLORS = (  # told apart by most kinds of colour vision (Okabe and Ito), on light and dark
    DETECTOR,
    "#e69f00",
    "#009e73",
    "#cc79a7",
    "#d55e00",
    "#56b4e9",
    "#b0a000",
    "#8a8a8a",
)
_MOST_RAYS, _MOST_POINTS = 160, 600
_SEED = 0  # of which rays and points are shown where there are more


@styled
def rays_figure(row: RecordingReport, scene: Scene) -> Drawing | None:
    """Return Figure 4; None where no ray is known."""
    pixels = scene.detections.tip_pixels()
    train = pixels.select(np.isin(pixels.frames, scene.split.train))
    labels = None if scene.labels is None else scene.labels.visible
    center, radius = _frame(row)
    panels = [
        _voted(row, scene, center, radius),
        _panel("training, by detection", train, row.detector, scene, scene.views, center, radius),
        _panel("test, by label", labels, row.baseline, scene, scene.given, center, radius),
    ]
    shown = [panel for panel in panels if panel is not None]
    if not shown:
        return None
    basis = _basis(shown[-1])
    spheres = sphere_array([(item.center, item.radius) for item in scene.views.spheres])
    side = 3.5 if len(shown) < len(panels) else 2.6  # inches
    chart = Chart(side, side * len(shown), left=0.42, right=0.1, top=0.25, bottom=0.28)
    chart.canvas.subplots_adjust(wspace=0.18)
    grid = np.atleast_1d(chart.axes(1, len(shown)))
    for axes, panel in zip(grid, shown, strict=True):
        _draw(axes, panel, basis, center, radius, spheres, row)
    text = "; ".join(panel.words for panel in shown)
    drawing = chart.drawing(
        f"{row.name}-rays",
        "The tip in the hand frame",
        f"Hand, tool and viewing rays of {row.name} in the hand frame, seen from the side. {text}.",
        f"{words.sentence(text)} {_key(row, shown)}",
        COLUMNS,
        [
            *common_rows(basis, center, radius, spheres, row),
            *(line for panel in shown for line in panel_rows(panel)),
        ],
    )
    payload = json.dumps(_payload(shown, basis, center, radius, spheres, row)).replace("<", "")
    script = f'<script type="application/json">{payload}</script>'
    return replace(drawing, inline=f'<div class="turn">{drawing.inline}{script}</div>')


def _key(row: RecordingReport, panels: Sequence[Panel]) -> str:
    """Say what the marks mean."""
    parts = []
    if any(panel.shares is not None for panel in panels):
        parts.append(
            "Grey points: places that move with the hand, darker where more frames agree; this is "
            "what the estimate was voted from."
        )
    if any(panel.shares is None for panel in panels):
        parts.append(
            "Coloured points: hypothesised intersections of pairs of rays, by the nearest "
            "candidate (blue: the estimate's)."
        )
    if row.detector is not None and row.detector.method == VOTING:
        parts.append("Voting does not use these intersections; they are for comparison.")
    parts.append(
        "Large circles: the hand and wrist, where no tip can be. Ring with cross: the estimate, "
        "with its 95 % region and, where known, the tool's axis. Small rings: other candidates."
    )
    if row.truth_m is not None:
        parts.append("Green diamond: the true tip.")
    if row.detector is not None and row.detector.ambiguous:
        parts.append(
            "The tool has several ends; select one, in the view or by its button, to see the "
            "command that takes it."
        )
    return " ".join([*parts, "(Figure 4 of the paper.)"])


def _voted(row: RecordingReport, scene: Scene, center: Array, radius: float) -> Panel | None:
    """Return the panel of what voting saw; None where nothing was voted."""
    shape = scene.shape()
    if shape is None or not len(shape.points):
        return None
    near = np.linalg.norm(shape.points - center, axis=1) < 1.5 * radius
    points, nobody = shape.points[near], np.zeros((0, 3))
    return Panel(
        "what moves with the hand",
        nobody,
        nobody,
        points,
        np.zeros(len(points), np.intp),
        row.detector,
        0,
        len(points),
        shape.shares[near],
        shape.frames,
    )


def _frame(row: RecordingReport) -> tuple[Array, float]:
    """Return the centre and the radius of what is shown, metres, hand frame."""
    known = [
        np.array(score.position_m)
        for score in (row.detector, row.baseline)
        if score is not None and score.position_m is not None
    ]
    tip = known[-1] if known else np.zeros(3)
    radius = max(0.12, 0.85 * float(np.linalg.norm(tip)))
    if row.detector is not None and row.detector.ambiguous:  # all ends are shown
        places = np.array([item.position_m for item in row.detector.candidates])
        radius = max(radius, 1.2 * float(np.linalg.norm(places - tip / 2, axis=1).max()))
    return tip / 2, radius


def viewing_rays(views: Views, pixels: TipPixels) -> Rays:
    """Return the rays of pixels in the hand frame, where the hand's pose is known."""
    directions = views.camera.directions(pixels.pixels)
    usable = views.known[pixels.frames] & np.isfinite(directions).all(axis=1)
    frames = pixels.frames[usable]
    return rays_in_hand(frames, directions[usable], views.hand_from_camera[frames])


def _panel(
    title: str,
    pixels: TipPixels | None,
    estimate: EstimateScore | None,
    scene: Scene,
    views: Views,
    center: Array,
    radius: float,
) -> Panel | None:
    rays = None if pixels is None else viewing_rays(views, pixels)
    if rays is None or not len(rays):
        return None
    params: EstimatorParams = scene.estimator
    points, _ = intersections(rays, max_distance=params.max_ray_distance, z_start=params.z_start)
    spheres = sphere_array([(item.center, item.radius) for item in scene.views.spheres])
    points = points[plausible(points, spheres, params.max_range)]
    hypotheses = len(points)
    rng = np.random.default_rng(_SEED)
    near = points[np.linalg.norm(points - center, axis=1) < 1.5 * radius]
    points = near[np.sort(rng.permutation(len(near))[:_MOST_POINTS])]
    chosen = rays.select(np.sort(rng.permutation(len(rays))[:_MOST_RAYS]))
    along = np.einsum("ni,ni->n", center - chosen.origins, chosen.directions)
    starts = chosen.origins + np.maximum(0, along - 2 * radius)[:, None] * chosen.directions
    ends = chosen.origins + (along + 2 * radius)[:, None] * chosen.directions
    candidates = [] if estimate is None else [item.position_m for item in estimate.candidates]
    clusters = nearest(points, np.array(candidates)) if candidates else np.zeros(len(points), int)
    return Panel(
        title, starts, ends, points, clusters.astype(np.intp), estimate, len(rays), hypotheses
    )


def _basis(panel: Panel) -> Array:
    """Return (3, 3) rows right, up and towards the viewer: the rays fan out in the picture."""
    if not len(panel.starts):
        return np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    directions = panel.ends - panel.starts
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    mean = directions.mean(axis=0)
    spread = np.linalg.svd(directions - mean)[2]
    up = -mean / np.linalg.norm(mean)  # the camera at the top
    right = spread[0] - (spread[0] @ up) * up
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    right = right / np.linalg.norm(right)
    return np.stack([right, up, np.cross(right, up)])


def _draw(
    axes: Axes,
    panel: Panel,
    basis: Array,
    center: Array,
    radius: float,
    spheres: Array,
    row: RecordingReport,
) -> None:
    from matplotlib.collections import LineCollection
    from matplotlib.colors import to_rgba_array
    from matplotlib.patches import Circle

    def flat(points: Array) -> Array:
        return np.asarray((points - center) @ basis[:2].T * 1000)

    lines = np.stack([flat(panel.starts), flat(panel.ends)], axis=1)
    axes.add_collection(LineCollection(list(lines), colors=MUTED, linewidths=0.4, alpha=0.45))
    for place, *_, size in [(flat(s[:3]), s[3] * 1000) for s in spheres]:
        axes.add_patch(Circle(tuple(place), size, fill=False, edgecolor=MUTED, linewidth=1.0))
    dots = flat(panel.points)
    if panel.shares is None:
        colors = [CLUSTER_COLORS[index % len(CLUSTER_COLORS)] for index in panel.clusters]
        axes.scatter(dots[:, 0], dots[:, 1], s=2.5, c=colors, linewidths=0, rasterized=True)
    else:
        axes.scatter(
            dots[:, 0],
            dots[:, 1],
            s=3.5,
            c=to_rgba_array(MUTED, shades(panel.shares)),
            linewidths=0,
            rasterized=True,
        )
    _draw_axes(axes, flat)
    if panel.estimate is not None and panel.estimate.position_m is not None:
        _draw_estimate(axes, panel.estimate, flat)
    if row.truth_m is not None:
        axes.plot(*flat(np.array(row.truth_m)), marker="D", markersize=4.5, color=TRUTH)
    reach = 1000 * radius
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    axes.set_title(f"{panel.title} (mm)", fontsize=8.5)
    axes.grid(False)


def shades(shares: Array) -> Array:
    """Return (P,) opacities: the places that most frames agree on are the darkest."""
    most = float(np.quantile(shares, 0.95)) if len(shares) else 1.0
    return np.asarray(0.2 + 0.8 * np.clip(shares / max(most, 1e-9), 0.0, 1.0))


def _draw_estimate(axes: Axes, estimate: EstimateScore, flat: Any) -> None:
    along = axis_ends(estimate)
    if along is not None:
        axes.plot(*flat(along).T, color=DETECTOR, linewidth=1.1, linestyle=(0, (4, 2)))
    place = flat(np.array(estimate.position_m))
    axes.plot(*place, marker="o", markersize=11, color=INK, fillstyle="none", markeredgewidth=1.4)
    axes.plot(*place, marker="+", markersize=11, color=INK, markeredgewidth=1.0)
    for loop in region_loops(estimate):
        axes.plot(*flat(loop).T, color=BASELINE, linewidth=0.9)
    if not estimate.ambiguous:
        return
    for which, item in enumerate(estimate.candidates, start=1):
        spot = flat(np.array(item.position_m))
        if which > 1:
            axes.plot(*spot, marker="o", markersize=8, color=INK, fillstyle="none")
        axes.annotate(
            str(which), tuple(spot), fontsize=8, xytext=(7, 3), textcoords="offset points"
        )


def _draw_axes(axes: Axes, flat: Any) -> None:
    origin = flat(np.zeros(3))
    for name, end in zip("xyz", np.eye(3) * 0.03, strict=True):
        tip = flat(end)
        axes.plot(*zip(origin, tip, strict=True), color=INK, linewidth=1.2)
        axes.annotate(name, tuple(tip), fontsize=7.5, xytext=(1, 1), textcoords="offset points")


def region_loops(score: EstimateScore, steps: int = 48) -> list[Array]:
    """Return three (steps + 1, 3) great ellipses of the 95 % region, metres, hand frame."""
    if score.region_mm is None or score.region_axes is None or score.position_m is None:
        return []
    angle = np.linspace(0, 2 * np.pi, steps + 1)[:, None]
    axes = np.array(score.region_axes) * np.array(score.region_mm)[:, None] / 1000
    pairs = ((0, 1), (1, 2), (2, 0))
    return [
        np.array(score.position_m) + np.cos(angle) * axes[i] + np.sin(angle) * axes[j]
        for i, j in pairs
    ]


def _payload(
    panels: Sequence[Panel],
    basis: Array,
    center: Array,
    radius: float,
    spheres: Array,
    row: RecordingReport,
) -> dict[str, Any]:
    """Return what the page's script turns; millimetres from the centre, whole numbers."""

    def whole(points: Array) -> list[int]:
        return [int(value) for value in np.round(1000 * (points.reshape(-1, 3) - center)).ravel()]

    def panel_data(panel: Panel) -> dict[str, Any]:
        estimate = panel.estimate
        known = estimate is not None and estimate.position_m is not None
        others = [] if estimate is None else estimate.candidates[1:]
        along = None if estimate is None else axis_ends(estimate)
        shares = panel.shares
        return {
            "title": panel.title,
            "rays": whole(np.concatenate([panel.starts, panel.ends], axis=1)),
            "points": whole(panel.points),
            "clusters": [int(value) for value in panel.clusters],
            "shades": None if shares is None else [int(v) for v in np.round(100 * shades(shares))],
            "tip": whole(np.array(estimate.position_m)) if estimate and known else None,
            "axis": None if along is None else whole(along),
            "others": [whole(np.array(item.position_m)) for item in others],
            "region": [whole(loop) for loop in region_loops(estimate)] if estimate else [],
            "ends": bool(estimate and estimate.source == "detections" and estimate.ambiguous),
        }

    ends = row.detector.candidates if row.detector and row.detector.ambiguous else ()
    return {
        "radius": round(1000 * radius),
        "basis": [round(float(value), 5) for value in basis.ravel()],
        "origin": whole(np.zeros(3)),
        "axes": [whole(end) for end in np.eye(3) * 0.03],
        "spheres": [[*whole(item[:3]), round(1000 * float(item[3]))] for item in spheres],
        "truth": None if row.truth_m is None else whole(np.array(row.truth_m)),
        "colors": [*CLUSTER_COLORS],
        "panels": [panel_data(panel) for panel in panels],
        "ends": [
            {
                "at": whole(np.array(item.position_m)),
                "text": words.end_words(item),
                "command": words.prefer_command(row, item),
            }
            for item in ends
        ],
    }
