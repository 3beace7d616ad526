"""What the panels of Figure 4 hold, and the data file beside them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tooltip_cli.method.types import Array, Indices
from tooltip_cli.report.model import EstimateScore, RecordingReport
from tooltip_cli.report.tables import number

COLUMNS = (
    "panel",
    "kind",
    "cluster",
    "share",
    *(f"{axis}{end}_m" for end in "12" for axis in "xyz"),
)
_AXIS_M = (0.06, 0.02)  # how far back from a tip its axis is drawn, and how far beyond it


@dataclass(frozen=True)
class Panel:
    """One cloud of rays and what was made of it; metres, hand frame."""

    title: str
    starts: Array  # (N, 3) where the rays are drawn from
    ends: Array  # (N, 3)
    points: Array  # (M, 3) hypothesised intersections
    clusters: Indices  # (M,) nearest candidate of each
    estimate: EstimateScore | None
    rays: int  # before thinning out
    hypotheses: int
    shares: Array | None = None  # (M,) where points are what was voted: frames that agree on each
    frames: int = 0  # that voted

    @property
    def words(self) -> str:
        """What is drawn, with numbers."""
        if self.shares is not None:
            return f"{self.title}: {len(self.points)} places, from {self.frames} frames"
        thinned = (
            f" ({len(self.starts)} and {len(self.points)} of them drawn)"
            if len(self.starts) < self.rays or len(self.points) < self.hypotheses
            else ""
        )
        return f"{self.title}: {self.rays} rays, {self.hypotheses} intersections{thinned}"


def axis_ends(score: EstimateScore) -> Array | None:
    """Return (2, 3) the ends of the line that shows the tool's axis; None: not known."""
    first = score.candidates[0] if score.candidates else None
    if first is None or first.axis is None:
        return None
    back, beyond = _AXIS_M
    tip, along = np.array(first.position_m), np.array(first.axis)
    return np.stack([tip - back * along, tip + beyond * along])


def _line(
    panel: str, kind: str, *ends: Array, cluster: str = "", share: str = "", digits: int = 5
) -> list[str]:
    """Return a row of the figure's data: one place in the hand frame, or two."""
    cells = [f"{value:.{digits}f}" for end in ends for value in end]
    return [panel, kind, cluster, share, *cells, *[""] * (6 - len(cells))]


def common_rows(
    basis: Array, center: Array, radius: float, spheres: Array, row: RecordingReport
) -> list[list[str]]:
    """Return what all panels share: the view, the hand's spheres and the true tip.

    The second place of a view is at the picture's right or upper edge, of a sphere on its surface.
    """
    right, up = center + radius * basis[:2]
    lines = [_line("all", "view right", center, right), _line("all", "view up", center, up)]
    lines += [
        _line("all", "sphere", sphere[:3], sphere[:3] + sphere[3] * np.eye(3)[0])
        for sphere in spheres
    ]
    if row.truth_m is not None:
        lines.append(_line("all", "true tip", np.array(row.truth_m)))
    return lines


def panel_rows(panel: Panel) -> list[list[str]]:
    """Return what one panel holds, in the hand frame."""
    title, estimate = panel.title, panel.estimate
    lines = [_line(title, "ray", *ends) for ends in zip(panel.starts, panel.ends, strict=True)]
    if panel.shares is None:
        lines += [
            _line(title, "intersection", point, cluster=str(int(cluster)))
            for point, cluster in zip(panel.points, panel.clusters, strict=True)
        ]
    else:
        lines += [
            _line(title, "voted", point, share=number(float(share), 3))
            for point, share in zip(panel.points, panel.shares, strict=True)
        ]
    if estimate is None or estimate.position_m is None:
        return lines
    tip = np.array(estimate.position_m)
    places = [np.array(item.position_m) for item in estimate.candidates] or [tip]
    lines += [
        _line(title, "candidate" if index else "estimate", place, cluster=str(index))
        for index, place in enumerate(places)
    ]
    along = axis_ends(estimate)
    if along is not None:
        lines.append(_line(title, "tool's axis", *along))
    if estimate.region_mm is not None and estimate.region_axes is not None:
        semi = np.array(estimate.region_axes) * np.array(estimate.region_mm)[:, None] / 1000
        lines += [_line(title, "95 % semi-axis", tip, tip + axis, digits=7) for axis in semi]
    return lines
