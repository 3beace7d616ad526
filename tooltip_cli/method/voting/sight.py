"""What each image shows of a tool's end: where the tool stops, and where its sides are.

Seen along the image of its axis, a tool's edges stop at its end, and lie as far to one side of its
middle as to the other. Both are measured in metres at the end's depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tooltip_cli.method.types import Array, Indices
from tooltip_cli.method.voting.loops import run
from tooltip_cli.method.voting.params import RefineParams
from tooltip_cli.method.voting.silhouette import HandSilhouettes
from tooltip_cli.method.voting.volume import Cloud, HandEdges

_CHOOSER = (
    "f64* i64* f32* f64* f64* i64 i64 f64* f64* f64* f64* f64* f64* "
    "f64 f64 f64 f64 f64 i64* f64* f64* f64*"
)
_MEASURER = "i64* f64* f64* f64* i64 f64* i64 f64* i64 f64 f64 i64 f64 f64* f64* f64* f64*"
_FARTHEST = 3  # edges of a frame, whose median is its farthest one


@dataclass(frozen=True)
class NearEdges:
    """Edges about an end that may belong to the tool."""

    pixels: Array  # (E, 2) ideal pixels about the optical centre
    rows: Indices  # (E,) row of the chosen frames, ascending
    profiles: npt.NDArray[np.float32]  # (E, depths) log-likelihood ratios over depth; 0 depths: all
    first: Array  # (E,) depth of a profile's first sample, metres
    step: Array  # (E,) between its samples, metres
    camera_from_hand: Array  # (F, 4, 4) of the chosen frames
    focal_px: float

    def thinned(self, every: int) -> NearEdges:
        """Return the same of one in so many frames."""
        kept = self.rows % every == 0
        return NearEdges(
            self.pixels[kept],
            self.rows[kept] // every,
            self.profiles[kept],
            self.first[kept],
            self.step[kept],
            self.camera_from_hand[::every],
            self.focal_px,
        )

    def scale_at(self, position: Array) -> float:
        """Return the median over the frames of pixels per metre at a point (3,), hand frame."""
        depths = self.camera_from_hand[:, 2, :3] @ position + self.camera_from_hand[:, 2, 3]
        return self.focal_px / float(np.median(np.maximum(depths, 1e-3)))


@dataclass(frozen=True)
class Sight:
    """How each frame sees an end."""

    pixel: Array  # (F, 2) where the end is, ideal pixels
    along: Array  # (F, 2) unit vector in the image, along the axis
    scale: Array  # (F,) pixels per metre
    sine: Array  # (F,) of the angle between axis and line of sight
    depth: Array  # (F,) metres
    axis_depth: Array  # (F,) metres of depth for each metre along the axis
    stop_direction: Array  # (F, 3) hand frame: a step along it moves the image along the axis
    side_direction: Array  # (F, 3) hand frame: a step along it moves the image across the axis


@dataclass(frozen=True)
class Measured:
    """What the frames say about an end; NaN: nothing."""

    stops: Array  # (F,) how far the tool reaches along the image of its axis, metres
    middles: Array  # (F, S) middle between its sides in each slab, metres across
    halves: Array  # (F, S) half the distance between them, metres


def near_edges(edges: HandEdges, cloud: Cloud, position: Array, params: RefineParams) -> NearEdges:
    """Return the edges that lie near a point (3,), hand frame, in the images."""
    camera = edges.camera_from_hand[edges.moving.frames]
    at = camera[:, :3, :3] @ position + camera[:, :3, 3]
    rows = cloud.edge_rows
    away = cloud.edges - (at[:, :2] / at[:, 2:])[rows]
    limit = (params.reach + 2 * params.max_move) / at[:, 2]
    near = np.square(away).sum(axis=1) < np.square(limit)[rows]
    rows = rows[near]
    return NearEdges(
        edges.focal_px * cloud.edges[near],
        rows,
        cloud.profiles[near],
        cloud.depths[rows, 0],
        cloud.depths[rows, 1],
        camera,
        edges.focal_px,
    )


def near_outlines(silhouettes: HandSilhouettes, position: Array, params: RefineParams) -> NearEdges:
    """Return the points of silhouettes' outlines that lie near a point (3,), hand frame."""
    camera = silhouettes.camera_from_hand
    at = camera[:, :3, :3] @ position + camera[:, :3, 3]
    rows = silhouettes.rows
    away = silhouettes.points - (at[:, :2] / at[:, 2:])[rows]
    limit = (params.reach + 2 * params.max_move) / at[:, 2]
    near = np.square(away).sum(axis=1) < np.square(limit)[rows]
    rows = rows[near]
    return NearEdges(
        silhouettes.focal_px * silhouettes.points[near],
        rows,
        np.zeros((len(rows), 0), np.float32),
        np.zeros(len(rows)),
        np.ones(len(rows)),
        camera,
        silhouettes.focal_px,
    )


def see(near: NearEdges, position: Array, axis: Array) -> Sight:
    """Project an end (3,) with its axis (3,) into all frames."""
    rotation = near.camera_from_hand[:, :3, :3]
    at = rotation @ position + near.camera_from_hand[:, :3, 3]
    towards = rotation @ axis
    depth = np.maximum(at[:, 2], 1e-3)
    slope = at[:, :2] / depth[:, None]
    image = towards[:, :2] - slope * towards[:, 2:]
    sine = np.linalg.norm(image, axis=1)
    along = image / np.maximum(sine, 1e-9)[:, None]

    def lifted(direction: Array) -> Array:
        # this direction's row of the projection's derivative, turned into the hand frame
        row = np.column_stack([direction, -(direction * slope).sum(axis=1)])
        return np.asarray(np.einsum("fji,fj->fi", rotation, row))

    return Sight(
        near.focal_px * slope,
        along,
        near.focal_px / depth,
        sine,
        depth,
        np.ascontiguousarray(towards[:, 2]),
        lifted(along),
        lifted(_left_of(along)),
    )


def measure(
    near: NearEdges,
    sight: Sight,
    slabs: Array,
    width: float,
    end_width: float,
    params: RefineParams,
) -> Measured:
    """Measure where the tool stops and where its sides are.

    Args:
        slabs: (S, 2) stretches along the axis, metres; the first is the end itself.
        width: how far across the axis edges are looked at; ``end_width``: the same at the end.
    """
    rows, along, across, lengthwise = _on_tool(near, sight, width, params)
    frames = len(sight.scale)
    stops = np.full(frames, np.nan)
    middles, halves = np.full((2, frames, len(slabs)), np.nan)
    run(
        "measurer",
        _MEASURER,
        rows,
        along,
        across,
        lengthwise,
        len(rows),
        sight.sine,
        frames,
        slabs,
        len(slabs),
        end_width,
        params.min_sine_at_end,
        params.min_edges,
        params.side_quantile,
        np.empty(len(rows)),
        stops,
        middles,
        halves,
    )
    return Measured(stops, middles, halves)


def point_of(
    near: NearEdges, position: Array, axis: Array, width: float, params: RefineParams
) -> Array | None:
    """Return the (3,) step across the axis to the one thing that reaches farthest, if it is one.

    A pen's point, a plug's longest pin: the farthest edges of most frames meet on one line along
    the axis. The farthest edges of a flat end are anywhere on its rim, and None is returned.
    """
    sight = see(near, position, axis)
    rows, along, across, _ = _on_tool(near, sight, width, params)
    order = np.lexsort((along, rows))
    counts = np.bincount(rows, minlength=len(sight.scale))
    last = np.cumsum(counts) - 1
    shown = (counts >= params.min_edges) & (sight.sine > params.min_sine_at_end)
    if shown.sum() < params.min_frames:
        return None
    farthest = np.median([across[order[last[shown] - i]] for i in range(_FARTHEST)], axis=0)
    basis = across_axis(axis)
    directions = sight.side_direction[shown] @ basis
    pixels = near.scale_at(position)
    tolerance = max(params.point_tolerance, params.point_tolerance_px / pixels)
    starts = np.arange(-width, width + tolerance, 1.5 * tolerance)
    grid = np.stack(np.meshgrid(starts, starts), axis=-1).reshape(-1, 2)
    steps = _meeting_points(farthest, directions, grid, tolerance)
    shares = np.mean(np.abs(farthest - steps @ directions.T) < tolerance, axis=1)
    best = int(np.argmax(shares))
    return None if shares[best] < params.point_share else np.asarray(basis @ steps[best])


def across_axis(axis: Array) -> Array:
    """Return (3, 2) two unit vectors across an axis (3,) and each other."""
    basis: Array = np.linalg.svd(axis[None])[2][1:].T
    return basis


def _meeting_points(offsets: Array, directions: Array, starts: Array, tolerance: float) -> Array:
    """Solve ``directions @ step = offsets`` robustly, from each of (K, 2) starts on."""
    steps = starts
    x, y = directions.T
    squares = np.stack([x * x, x * y, x * y, y * y], axis=1)
    for scale in (2.0, 1.5, 1.0, 0.75, 0.75):
        residuals = offsets - steps @ directions.T
        weights = 1.0 / (1.0 + np.square(residuals / (scale * tolerance)))
        normal = (weights @ squares).reshape(-1, 2, 2) + 1e-6 * np.eye(2)
        right = (weights * offsets) @ directions
        steps = np.linalg.solve(normal, right[..., None])[..., 0]
    return steps


def _on_tool(
    near: NearEdges, sight: Sight, width: float, params: RefineParams
) -> tuple[Indices, Array, Array, Array]:
    """Return the edges whose motion fits the tool at its depth there.

    Returns:
        of each edge its frame's row, metres along the axis in the image, metres across, and
        metres along the axis itself.
    """
    rows = np.empty(len(near.rows), dtype=np.intp)
    along, across, lengthwise = np.empty((3, len(near.rows)))
    count = run(
        "chooser",
        _CHOOSER,
        near.pixels,
        near.rows,
        near.profiles,
        near.first,
        near.step,
        *near.profiles.shape,
        sight.pixel,
        sight.along,
        sight.scale,
        sight.sine,
        sight.depth,
        sight.axis_depth,
        width,
        params.reach,
        params.beyond,
        params.min_sine,
        params.min_ratio,
        rows,
        along,
        across,
        lengthwise,
    )
    return rows[:count], along[:count], across[:count], lengthwise[:count]


def _left_of(along: Array) -> Array:
    return np.stack([-along[:, 1], along[:, 0]], axis=1)
