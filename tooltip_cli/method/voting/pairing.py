"""Frames and partners, chosen by the hand's motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tooltip_cli.method.types import Array, Indices, Mask
from tooltip_cli.method.voting.params import PairingParams

_ROWS_AT_ONCE = 512  # images whose partners are looked for together; bounds memory
_NONE_KEPT: Indices = np.zeros(0, dtype=np.intp)
_PROBE_QUANTILE = 0.75  # of the probes' displacements: those on the axis of rotation never move


@dataclass(frozen=True)
class Pairing:
    """Chosen frames with a partner before and after each."""

    frames: Indices  # (F,) image indices, ascending
    partners: Indices  # (F, 2) image indices before and after
    displacements: Array  # (F, 2) pixels that the probes move by
    fastest_px: float  # median motion of the probes between consecutive frames, pixels
    levels: Indices  # (F,) how often images are halved, for the motion to fit the search window


def pair_frames(
    camera_from_hand: Array, focal_px: float, params: PairingParams, allowed: Mask | None = None
) -> Pairing:
    """Choose frames spread over the hand's orientations, each with two partners.

    For every frame, the partner on either side is the one to which points at a tool's distance
    from the hand move nearest to the wanted displacement. Frames without both are not used.
    Where that leaves fewer frames than are wanted, because even neighbouring images are too far
    apart, others are paired for images half the size, and then a quarter.

    Args:
        camera_from_hand: (N, 4, 4); NaN where the hand's pose is unknown.
        focal_px: pixels per unit of normalized coordinates.
        allowed: (N,) images that may be used at all; default: all.
    """
    count = len(camera_from_hand)
    if allowed is not None:
        camera_from_hand = np.where(allowed[:, None, None], camera_from_hand, np.nan)
    probes = probe_pixels(camera_from_hand, focal_px, params)
    partners, moved, levels = find_partners(probes, np.arange(count), params)
    consecutive = displacement(probes[:-1], probes[1:])
    consecutive = consecutive[np.isfinite(consecutive)]
    features = orientations(camera_from_hand)
    chosen = np.zeros(0, dtype=np.intp)
    for level in range(params.levels):
        usable = np.asarray((levels >= 0) & (levels <= level))
        chosen = farthest_points(features, usable, params.frames, chosen)
    fastest = float(np.median(consecutive)) if len(consecutive) else 0.0
    return Pairing(chosen, partners[chosen], moved[chosen], fastest, levels[chosen])


def find_partners(
    probes: Array, rows: Indices, params: PairingParams
) -> tuple[Indices, Array, Indices]:
    """Find the images to which the probes move nearest to the wanted displacement.

    That displacement, its least and its most are those of images as large as can be for there to
    be a partner on either side.

    Args:
        probes: (N, S, 2) the probes' pixels in consecutive images; NaN where they are unknown.
        rows: (R,) images that partners are looked for.

    Returns:
        (R, 2) images before and after; (R, 2) pixels that the probes move by; and (R,) how often
        images are halved for that motion to fit the search window, -1: there are no partners.
    """
    partners = np.full((len(rows), 2), -1, dtype=np.intp)
    moved = np.zeros((len(rows), 2))
    levels = np.full(len(rows), -1, dtype=np.intp)
    for level in range(params.levels):
        left = np.flatnonzero(levels < 0)
        pairs, pixels = _partners_at(probes, rows[left], 2.0**level, params)
        found = np.asarray((pairs >= 0).all(axis=1))
        at = left[found]
        partners[at], moved[at], levels[at] = pairs[found], pixels[found], level
    return partners, moved, levels


def _partners_at(
    probes: Array, rows: Indices, scale: float, params: PairingParams
) -> tuple[Indices, Array]:
    """Return (R, 2) the images to either side, -1: none, and (R, 2) pixels that probes move by."""
    count, gaps = len(probes), np.arange(1, params.max_gap + 1)
    partners = np.full((len(rows), 2), -1, dtype=np.intp)
    moved = np.zeros((len(rows), 2))
    for start in range(0, len(rows), _ROWS_AT_ONCE):
        some = rows[start : start + _ROWS_AT_ONCE]
        for side, step in enumerate((-1, 1)):
            others = some[:, None] + step * gaps
            inside = (others >= 0) & (others < count)
            first, second = probes[some][:, None], probes[np.clip(others, 0, count - 1)]
            pixels = displacement(first, second)
            usable = (
                inside
                & (pixels >= scale * params.min_displacement_px)
                & (pixels <= scale * params.max_displacement_px)
            )
            with np.errstate(divide="ignore", invalid="ignore"):
                cost = np.abs(np.log(pixels / (scale * params.displacement_px)))
            best = np.argmin(np.where(usable, cost, np.inf), axis=1)
            found = np.flatnonzero(usable.any(axis=1))
            partners[start + found, side] = others[found, best[found]]
            moved[start + found, side] = pixels[found, best[found]]
    return partners, moved


def probe_pixels(camera_from_hand: Array, focal_px: float, params: PairingParams) -> Array:
    """Return (N, S, 2) where points at a tool's distance from the hand project; NaN: unknown."""
    return _project(camera_from_hand, _probe_points(params.probe_radius), focal_px)


def orientations(camera_from_hand: Array) -> Array:
    """Return (N, 9) what hand orientations are told apart by."""
    return camera_from_hand[:, :3, :3].reshape(-1, 9)


def farthest_points(
    features: Array, usable: Mask, count: int, kept: Indices = _NONE_KEPT
) -> Indices:
    """Choose rows far from one another (farthest-point sampling), from the first usable one on.

    Args:
        features: (N, D).
        kept: usable rows, at most ``count``, that are chosen already.

    Returns:
        At most ``count`` ascending indices of usable rows.
    """
    candidates = np.flatnonzero(usable)
    if len(candidates) <= count:
        return candidates
    points = features[candidates]
    distances = np.full(len(points), np.inf)
    start = np.searchsorted(candidates, kept).tolist() or [0]
    chosen: list[int] = []
    while len(chosen) < count:
        last = start[len(chosen)] if len(chosen) < len(start) else int(np.argmax(distances))
        chosen.append(last)
        distances = np.minimum(distances, np.linalg.norm(points - points[last], axis=1))
        distances[last] = -1.0  # where all others are the same, none is chosen twice
    return np.sort(candidates[np.array(chosen, dtype=np.intp)])


def _probe_points(radius: float) -> Array:
    """Return (14, 3) points in the directions of a cube's faces and corners."""
    steps = np.array(np.meshgrid(*[[-1, 0, 1]] * 3)).reshape(3, -1).T.astype(float)
    steps = steps[np.isin(np.abs(steps).sum(axis=1), (1, 3))]
    points: Array = radius * steps / np.linalg.norm(steps, axis=1, keepdims=True)
    return points


def _project(camera_from_hand: Array, points: Array, focal_px: float) -> Array:
    """Return (N, S, 2) ideal pixels about the optical centre; NaN behind the camera."""
    rotated = np.einsum("nij,sj->nsi", camera_from_hand[:, :3, :3], points)
    camera = rotated + camera_from_hand[:, None, :3, 3]
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = np.where(camera[..., 2:] > 0.02, camera[..., 2:], np.nan)
        return np.asarray(focal_px * camera[..., :2] / depth)


def displacement(first: Array, second: Array) -> Array:
    """Return (...) the upper quartile over the probes (..., S, 2) of how far they move, pixels."""
    lengths = np.linalg.norm(second - first, axis=-1)
    known = np.isfinite(lengths).all(axis=-1)
    result: npt.NDArray[np.float64] = np.full(known.shape, np.nan)
    result[known] = np.quantile(lengths[known], _PROBE_QUANTILE, axis=-1)
    return result
