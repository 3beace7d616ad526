"""The loops of the voting method, compiled."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

from numba import float32, float64, int32, int64, uint8, void

from tooltip_cli.method._jit import compiled

_BACKGROUND, _FOREGROUND = 127, 255  # values of a mask, as in silhouette.py
_NEAR = 0.02  # metres; nothing closer to the optical centre is seen


def _profiles(
    points: Any,
    moved: Any,
    covariances: Any,
    background: Any,
    rows: Any,
    partner_from_camera: Any,
    depths: Any,
    clip: float,
    variance: float,
    profiles: Any,
) -> None:
    """Log-likelihood ratio of "on the hand at depth z" against "background", both partners."""
    for e in range(len(points)):
        row = rows[e]
        x, y = points[e, 0], points[e, 1]
        for k in range(2):
            a = covariances[e, k, 0] + variance
            b = covariances[e, k, 1]
            c = covariances[e, k, 2] + variance
            determinant = a * c - b * b
            ia, ib, ic = c / determinant, -b / determinant, a / determinant
            du = moved[e, k, 0] - background[e, k, 0]
            dv = moved[e, k, 1] - background[e, k, 1]
            still = min(ia * du * du + 2 * ib * du * dv + ic * dv * dv, 2 * clip)
            m = partner_from_camera[row, k]
            rx = m[0, 0] * x + m[0, 1] * y + m[0, 2]
            ry = m[1, 0] * x + m[1, 1] * y + m[1, 2]
            rz = m[2, 0] * x + m[2, 1] * y + m[2, 2]
            for i in range(profiles.shape[1]):
                z = depths[row, 0] + i * depths[row, 1]
                ahead = rz * z + m[2, 3]
                if ahead < _NEAR:
                    continue
                eu = moved[e, k, 0] - depths[row, 2] * (rx * z + m[0, 3]) / ahead
                ev = moved[e, k, 1] - depths[row, 2] * (ry * z + m[1, 3]) / ahead
                hand = ia * eu * eu + 2 * ib * eu * ev + ic * ev * ev
                profiles[e, i] += 0.5 * (still - min(hand, 2 * clip))


def _vote(
    axis: Any,
    reach: float,
    cameras: Any,
    partners: Any,
    raster: Any,
    nearest: Any,
    profiles: Any,
    depths: Any,
    least_motion: float,
    full: float,
    hits: Any,
    expected: Any,
) -> None:
    """Count, for each voxel, the frames that should show it moving and those that do."""
    focal, u0, v0 = raster[0], raster[1], raster[2]
    height, width = nearest.shape[1], nearest.shape[2]
    samples = profiles.shape[1]
    n = len(axis)
    for i in range(n):
        for j in range(n):
            for k in range(n):
                x, y, z = axis[i], axis[j], axis[k]
                if x * x + y * y + z * z > reach * reach:
                    continue
                seen, due = 0.0, 0.0
                for f in range(len(cameras)):
                    m = cameras[f]
                    depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
                    if depth < _NEAR:
                        continue
                    px = focal * (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / depth
                    py = focal * (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / depth
                    u, v = math.floor(px - u0 + 0.5), math.floor(py - v0 + 0.5)
                    if u < 0 or v < 0 or u >= width or v >= height:
                        continue
                    p = partners[f]
                    there = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
                    if there < _NEAR:
                        continue
                    du = focal * (p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]) / there - px
                    dv = focal * (p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]) / there - py
                    if du * du + dv * dv < least_motion * least_motion:
                        continue
                    due += 1.0
                    edge = nearest[f, v, u]
                    if edge < 0:
                        continue
                    at = math.floor((depth - depths[f, 0]) / depths[f, 1] + 0.5)
                    if 0 <= at < samples:
                        ratio = profiles[edge, at]
                        if ratio > 0:
                            seen += min(ratio, full) / full
                hits[i, j, k] = seen
                expected[i, j, k] = due


def _place(
    points: Any,
    rows: Any,
    profiles: Any,
    hand_from_camera: Any,
    depths: Any,
    volume: Any,
    corner: float,
    step: float,
    weight: float,
    substeps: int,
    positions: Any,
    scores: Any,
    ratios: Any,
) -> None:
    """Give each edge the depth on which the volume and its own motion agree best."""
    n = volume.shape[0]
    count = (profiles.shape[1] - 1) * substeps + 1
    for e in range(len(points)):
        row = rows[e]
        m = hand_from_camera[row]
        x, y = points[e, 0], points[e, 1]
        rx = m[0, 0] * x + m[0, 1] * y + m[0, 2]
        ry = m[1, 0] * x + m[1, 1] * y + m[1, 2]
        rz = m[2, 0] * x + m[2, 1] * y + m[2, 2]
        best = -math.inf
        for q in range(count):
            i = q // substeps
            part = (q - i * substeps) / substeps
            ratio = profiles[e, i]
            if part > 0:
                ratio += part * (profiles[e, i + 1] - ratio)
            if ratio <= 0:
                continue
            z = depths[row, 0] + (q / substeps) * depths[row, 1]
            hx, hy, hz = rx * z + m[0, 3], ry * z + m[1, 3], rz * z + m[2, 3]
            a, b, c = (hx - corner) / step, (hy - corner) / step, (hz - corner) / step
            ia, ib, ic = math.floor(a), math.floor(b), math.floor(c)
            if ia < 0 or ib < 0 or ic < 0 or ia > n - 2 or ib > n - 2 or ic > n - 2:
                continue
            a, b, c = a - ia, b - ib, c - ic
            v00 = volume[ia, ib, ic] * (1 - c) + volume[ia, ib, ic + 1] * c
            v01 = volume[ia, ib + 1, ic] * (1 - c) + volume[ia, ib + 1, ic + 1] * c
            v10 = volume[ia + 1, ib, ic] * (1 - c) + volume[ia + 1, ib, ic + 1] * c
            v11 = volume[ia + 1, ib + 1, ic] * (1 - c) + volume[ia + 1, ib + 1, ic + 1] * c
            score = (v00 * (1 - b) + v01 * b) * (1 - a) + (v10 * (1 - b) + v11 * b) * a
            total = weight * math.log(max(score, 1e-3)) + ratio
            if total > best:
                best = total
                positions[e, 0], positions[e, 1], positions[e, 2] = hx, hy, hz
                scores[e], ratios[e] = score, ratio


def _carve(voxels: Any, cameras: Any, masks: Any, limit: int, inside: Any, carved: Any) -> None:
    """Count, for each voxel, the masks in which it is foreground and background.

    Stops at voxels that are background in more than ``limit`` masks.
    """
    height, width = masks.shape[1], masks.shape[2]
    for i in range(len(voxels)):
        x, y, z = voxels[i, 0], voxels[i, 1], voxels[i, 2]
        for f in range(len(cameras)):
            m = cameras[f]
            depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
            if depth < _NEAR:
                continue
            u = math.floor((m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / depth + 0.5)
            v = math.floor((m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / depth + 0.5)
            if u < 0 or v < 0 or u >= width or v >= height:
                continue
            value = masks[f, v, u]
            if value == _FOREGROUND:
                inside[i] += 1
            elif value == _BACKGROUND:
                carved[i] += 1
                if carved[i] > limit:
                    break


def _on_tool(
    pixels: Any,
    rows: Any,
    profiles: Any,
    first: Any,
    step: Any,
    at: Any,
    direction: Any,
    scale: Any,
    sine: Any,
    depth: Any,
    axis_depth: Any,
    width: float,
    reach: float,
    beyond: float,
    min_sine: float,
    min_ratio: float,
    kept: Any,
    along: Any,
    across: Any,
    lengthwise: Any,
) -> int:
    """Choose the edges about an end whose motion fits its depth, and place them by its axis."""
    samples = profiles.shape[1]
    count = 0
    for e in range(len(rows)):
        row = rows[e]
        if sine[row] <= min_sine:
            continue
        du, dv = pixels[e, 0] - at[row, 0], pixels[e, 1] - at[row, 1]
        forward = (du * direction[row, 0] + dv * direction[row, 1]) / scale[row]
        if forward >= beyond or forward <= -reach:
            continue
        aside = (dv * direction[row, 0] - du * direction[row, 1]) / scale[row]
        if abs(aside) >= width:
            continue
        length = forward / sine[row]
        if samples > 0:
            z = depth[row] + min(length, 0.0) * axis_depth[row]
            sample = math.floor((z - first[e]) / step[e] + 0.5)
            if profiles[e, min(max(sample, 0), samples - 1)] <= min_ratio:
                continue
        kept[count], along[count], across[count], lengthwise[count] = row, forward, aside, length
        count += 1
    return count


@functools.cache
def profile_kernel() -> Callable[..., None]:
    """Return the compiled depth profiles."""
    signature = void(
        float64[:, ::1],
        float64[:, :, ::1],
        float32[:, :, ::1],
        float64[:, :, ::1],
        int64[::1],
        float64[:, :, :, ::1],
        float64[:, ::1],
        float64,
        float64,
        float32[:, ::1],
    )
    return compiled(_profiles, signature)


@functools.cache
def vote_kernel() -> Callable[..., None]:
    """Return the compiled vote."""
    signature = void(
        float64[::1],
        float64,
        float64[:, :, ::1],
        float64[:, :, ::1],
        float64[::1],
        int32[:, :, ::1],
        float32[:, ::1],
        float64[:, ::1],
        float64,
        float64,
        float32[:, :, ::1],
        float32[:, :, ::1],
    )
    return compiled(_vote, signature)


@functools.cache
def on_tool_kernel() -> Callable[..., int]:
    """Return the compiled choice of edges about an end."""
    plane, line = float64[:, ::1], float64[::1]
    signature = int64(
        plane, int64[::1], float32[:, ::1], line, line, plane, plane, *[line] * 4,
        *[float64] * 5, int64[::1], line, line, line,
    )  # fmt: skip
    return compiled(_on_tool, signature)


@functools.cache
def carve_kernel() -> Callable[..., None]:
    """Return the compiled carving."""
    signature = void(
        float64[:, ::1], float64[:, :, ::1], uint8[:, :, ::1], int64, int32[::1], int32[::1]
    )
    return compiled(_carve, signature)


@functools.cache
def place_kernel() -> Callable[..., None]:
    """Return the compiled choice of depths."""
    signature = void(
        float64[:, ::1],
        int64[::1],
        float32[:, ::1],
        float64[:, :, ::1],
        float64[:, ::1],
        float32[:, :, ::1],
        float64,
        float64,
        float64,
        int64,
        float64[:, ::1],
        float64[::1],
        float64[::1],
    )
    return compiled(_place, signature)
