"""Frames and partners, chosen by the hand's motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tooltip_cli.method.types import Array, Indices, Mask
from tooltip_cli.method.voting.params import PairingParams

_PROBE_QUANTILE = 0.75  # of the probes' displacements: those on the axis of rotation never move


@dataclass(frozen=True)
class Pairing:
    """Chosen frames with a partner before and after each."""

    frames: Indices  # (F,) image indices, ascending
    partners: Indices  # (F, 2) image indices before and after
    displacements: Array  # (F, 2) pixels that the probes move by
    fastest_px: float  # median motion of the probes between consecutive frames, pixels


def pair_frames(
    camera_from_hand: Array, focal_px: float, params: PairingParams, allowed: Mask | None = None
) -> Pairing:
    """Choose frames spread over the hand's orientations, each with two partners.

    For every frame, the partner on either side is the one to which points at a tool's distance
    from the hand move nearest to the wanted displacement. Frames without both are not used.

    Args:
        camera_from_hand: (N, 4, 4); NaN where the hand's pose is unknown.
        focal_px: pixels per unit of normalized coordinates.
        allowed: (N,) images that may be used at all; default: all.
    """
    count = len(camera_from_hand)
    if allowed is not None:
        camera_from_hand = np.where(allowed[:, None, None], camera_from_hand, np.nan)
    probes = _project(camera_from_hand, _probe_points(params.probe_radius), focal_px)
    partners = np.full((count, 2), -1, dtype=np.intp)
    moved = np.zeros((count, 2))
    consecutive = np.zeros(0)
    for side, step in enumerate((-1, 1)):
        best = np.full(count, np.inf)
        for gap in range(1, min(params.max_gap, count - 1) + 1):
            other = np.arange(count) + step * gap
            inside = (other >= 0) & (other < count)
            pixels = _displacement(probes, probes[np.clip(other, 0, count - 1)])
            if gap == 1 and step == 1:
                consecutive = pixels[inside & np.isfinite(pixels)]
            usable = (
                inside
                & (pixels >= params.min_displacement_px)
                & (pixels <= params.max_displacement_px)
            )
            with np.errstate(divide="ignore", invalid="ignore"):
                cost = np.abs(np.log(pixels / params.displacement_px))
            better = usable & (cost < best)
            partners[better, side], best[better] = other[better], cost[better]
            moved[better, side] = pixels[better]
    paired = np.asarray((partners >= 0).all(axis=1))
    chosen = farthest_points(camera_from_hand[:, :3, :3].reshape(count, 9), paired, params.frames)
    fastest = float(np.median(consecutive)) if len(consecutive) else 0.0
    return Pairing(chosen, partners[chosen], moved[chosen], fastest)


def farthest_points(features: Array, usable: Mask, count: int) -> Indices:
    """Choose rows far from one another (farthest-point sampling), from the first usable one on.

    Args:
        features: (N, D).

    Returns:
        At most ``count`` ascending indices of usable rows.
    """
    candidates = np.flatnonzero(usable)
    if len(candidates) <= count:
        return candidates
    points = features[candidates]
    distances = np.full(len(points), np.inf)
    chosen = [0]
    while len(chosen) < count:
        last = chosen[-1]
        distances = np.minimum(distances, np.linalg.norm(points - points[last], axis=1))
        distances[last] = -1.0  # where all others are the same, none is chosen twice
        chosen.append(int(np.argmax(distances)))
    return np.sort(candidates[np.array(chosen)])


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


def _displacement(first: Array, second: Array) -> Array:
    """Return (N,) the upper quartile over the probes of how far they move, pixels."""
    lengths = np.linalg.norm(second - first, axis=2)
    known = np.isfinite(lengths).all(axis=1)
    result: npt.NDArray[np.float64] = np.full(len(lengths), np.nan)
    result[known] = np.quantile(lengths[known], _PROBE_QUANTILE, axis=1)
    return result
