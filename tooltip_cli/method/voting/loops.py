"""The loops of the voting method: machine code, or plain numpy where there is none.

The plain forms take the arguments of those in `_voting_numba` and `_ends_numba`, arrays in their
own shapes, and fill the same ones. They form the same sums in the same order.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from tooltip_cli import machine_code
from tooltip_cli.method.types import Array, Indices
from tooltip_cli.method.voting.silhouette import BACKGROUND, FOREGROUND, Image

Floats32 = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int32]

_NEAR = 0.02  # metres; nothing closer to the optical centre is seen
_LEAST_SCORE = 1e-3  # of the volume: less says nothing
_EDGES_AT_ONCE = 4096  # bounds the temporaries to a few megabytes


def run(name: str, signature: str, *arguments: object) -> int:
    """Run one of the loops by its name, and return what it returns."""
    module, plain = _LOOPS[name]
    return machine_code.fast_or_slow(
        lambda: machine_code.kernel(module, name, signature)(*arguments),
        lambda: plain(*arguments),
        None,
    )


def _profile(
    points: Array,
    moved: Array,
    covariances: Floats32,
    background: Array,
    rows: Indices,
    count: int,
    partner_from_camera: Array,
    depths: Array,
    samples: int,
    clip: float,
    variance: float,
    profiles: Floats32,
) -> int:
    for start in range(0, count, _EDGES_AT_ONCE):
        part = slice(start, start + _EDGES_AT_ONCE)
        row = rows[part]
        x, y = points[part].T
        first, step, focal = depths[row].T[:, :, None]
        z = first + np.arange(samples) * step
        for k in range(2):
            uu, b, vv = covariances[part, k].T
            a, c = uu.astype(float) + variance, vv.astype(float) + variance
            determinant = a * c - b * b
            ia, ib, ic = c / determinant, -b / determinant, a / determinant
            du, dv = (moved[part, k] - background[part, k]).T
            still = np.minimum(ia * du * du + 2 * ib * du * dv + ic * dv * dv, 2 * clip)
            m = partner_from_camera[row, k]
            rx, ry, rz = (m[:, i, 0] * x + m[:, i, 1] * y + m[:, i, 2] for i in range(3))
            ahead = rz[:, None] * z + m[:, 2, 3, None]
            seen = ahead >= _NEAR
            ahead = np.where(seen, ahead, 1.0)
            mu, mv = moved[part, k].T[:, :, None]
            eu = mu - focal * (rx[:, None] * z + m[:, 0, 3, None]) / ahead
            ev = mv - focal * (ry[:, None] * z + m[:, 1, 3, None]) / ahead
            ia, ib, ic = ia[:, None], ib[:, None], ic[:, None]
            hand = ia * eu * eu + 2 * ib * eu * ev + ic * ev * ev
            ratio = 0.5 * (still[:, None] - np.minimum(hand, 2 * clip))
            profiles[part] += np.where(seen, ratio, 0.0)
    return 0


def _vote(
    axis: Array,
    n: int,
    reach: float,
    cameras: Array,
    partners: Array,
    frames: int,
    focal: float,
    u0: float,
    v0: float,
    height: int,
    width: int,
    nearest: Integers,
    profiles: Floats32,
    samples: int,
    depths: Array,
    least_motion: float,
    full: float,
    _cells: Array,
    _spans: Indices,
    _sums: Array,
    hits: Floats32,
    expected: Floats32,
) -> int:
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    within = ~(x * x + y * y + z * z > reach * reach)
    x, y, z = x[within], y[within], z[within]
    votes, due = np.zeros((2, len(x)))
    for f in range(frames):
        (a, b, c), (d, e, g) = (
            [row[0] * x + row[1] * y + row[2] * z + row[3] for row in matrices[f]]
            for matrices in (cameras, partners)
        )
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            px, py = focal * a / c, focal * b / c
            u, v = np.floor(px - u0 + 0.5), np.floor(py - v0 + 0.5)
            du, dv = focal * d / g - px, focal * e / g - py
            shown = (c >= _NEAR) & (u >= 0) & (v >= 0) & (u < width) & (v < height) & (g >= _NEAR)
            shown &= du * du + dv * dv >= least_motion * least_motion
        due += shown
        voxel = np.flatnonzero(shown)
        edge = nearest[f, v[voxel].astype(int), u[voxel].astype(int)]
        sample = np.floor((c[voxel] - depths[f, 0]) / depths[f, 1] + 0.5).astype(int)
        met = (edge >= 0) & (sample >= 0) & (sample < samples)
        voxel, ratio = voxel[met], profiles[edge[met], sample[met]].astype(float)
        votes[voxel] += np.where(ratio > 0, np.minimum(ratio, full) / full, 0.0)
    hits[within], expected[within] = votes, due
    return 0


def _place(
    points: Array,
    rows: Indices,
    profiles: Floats32,
    edges: int,
    samples: int,
    hand_from_camera: Array,
    depths: Array,
    volume: Floats32,
    n: int,
    corner: float,
    step: float,
    weight: float,
    substeps: int,
    _blocks: Image,
    positions: Array,
    scores: Array,
) -> int:
    x, y = points.T
    m = hand_from_camera[rows]
    rays = np.stack([m[:, i, 0] * x + m[:, i, 1] * y + m[:, i, 2] for i in range(3)], axis=1)
    flat = volume.ravel().astype(float)
    best = np.full(edges, -np.inf)
    for q in range((samples - 1) * substeps + 1):
        i = q // substeps
        part = (q - i * substeps) / substeps
        ratio = profiles[:, i].astype(float)
        if part > 0:
            ratio += part * (profiles[:, i + 1] - ratio)
        z = depths[rows, 0] + (q / substeps) * depths[rows, 1]
        there = rays * z[:, None] + m[:, :3, 3]
        place = (there - corner) / step
        whole = np.floor(place)
        inside = ((whole >= 0) & (whole <= n - 2)).all(axis=1) & (ratio > 0)
        edge = np.flatnonzero(inside)
        a, b, c = (place[edge] - whole[edge]).T
        index = whole[edge].astype(int)
        at = (index[:, 0] * n + index[:, 1]) * n + index[:, 2]
        v00, v01, v10, v11 = (
            flat[at + corner_] * (1 - c) + flat[at + corner_ + 1] * c
            for corner_ in (0, n, n * n, n * n + n)
        )
        score = (v00 * (1 - b) + v01 * b) * (1 - a) + (v10 * (1 - b) + v11 * b) * a
        total = weight * np.log(np.maximum(score, _LEAST_SCORE)) + ratio[edge]
        better = total > best[edge]
        edge, score = edge[better], score[better]
        best[edge], positions[edge] = total[better], there[edge]
        scores[edge] = np.where(score > _LEAST_SCORE, score, 0.0)
    return 0


def _carve(
    voxels: Array,
    count: int,
    cameras: Array,
    masks: Image,
    order: Indices,
    frames: int,
    height: int,
    width: int,
    limit: int,
    inside: Integers,
    carved: Integers,
) -> int:
    left = np.arange(count)
    for f in order[:frames]:
        x, y, z = voxels[left].T
        right, down, depth = (row[0] * x + row[1] * y + row[2] * z + row[3] for row in cameras[f])
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            u, v = np.floor(right / depth + 0.5), np.floor(down / depth + 0.5)
            seen = (depth >= _NEAR) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
        value = masks[f, v[seen].astype(int), u[seen].astype(int)]
        shown = left[seen]
        inside[shown[value == FOREGROUND]] += 1
        carved[shown[value == BACKGROUND]] += 1
        left = left[carved[left] <= limit]
    return 0


def _choose(
    pixels: Array,
    rows: Indices,
    profiles: Floats32,
    first: Array,
    step: Array,
    _count: int,
    samples: int,
    at: Array,
    direction: Array,
    scale: Array,
    sine: Array,
    depth: Array,
    axis_depth: Array,
    width: float,
    reach: float,
    beyond: float,
    min_sine: float,
    min_ratio: float,
    kept: Indices,
    along: Array,
    across: Array,
    lengthwise: Array,
) -> int:
    (du, dv), (right, down) = (pixels - at[rows]).T, direction[rows].T
    with np.errstate(divide="ignore", invalid="ignore"):
        forward = (du * right + dv * down) / scale[rows]
        aside = (dv * right - du * down) / scale[rows]
        length = forward / sine[rows]
    fits = ~(sine[rows] <= min_sine) & ~(forward >= beyond) & ~(forward <= -reach)
    fits &= ~(np.abs(aside) >= width)
    edge = np.flatnonzero(fits)
    if samples > 0:
        row = rows[edge]
        z = depth[row] + np.minimum(length[edge], 0.0) * axis_depth[row]
        sample = np.floor((z - first[edge]) / step[edge] + 0.5)
        sample = np.clip(sample, 0.0, float(samples - 1)).astype(int)
        edge = edge[profiles[edge, sample] > min_ratio]
    found = len(edge)
    kept[:found], along[:found], across[:found] = rows[edge], forward[edge], aside[edge]
    lengthwise[:found] = length[edge]
    return found


def _measure(
    rows: Indices,
    along: Array,
    across: Array,
    lengthwise: Array,
    count: int,
    sine: Array,
    frames: int,
    limits: Array,
    _slabs: int,
    end_width: float,
    min_sine: float,
    min_edges: int,
    quantile: float,
    _values: Array,
    stops: Array,
    middles: Array,
    halves: Array,
) -> int:
    rows, along, across = rows[:count], along[:count], across[:count]
    lengthwise = lengthwise[:count]
    at_end = np.abs(across) < end_width
    ranked, starts, counts = _ranked(rows[at_end], along[at_end], frames)
    enough = counts >= min_edges
    stops[enough] = ranked[starts[enough] + counts[enough] - 1]
    for index, (low, high) in enumerate(limits):
        inside = (lengthwise > low) & (lengthwise < high)
        if index == 0:
            inside &= at_end & (sine[rows] > min_sine)
        ranked, starts, counts = _ranked(rows[inside], across[inside], frames)
        enough = counts >= min_edges
        starts, last = starts[enough], counts[enough] - 1
        skipped = np.round(quantile * last).astype(np.intp)
        left, right = ranked[starts + skipped], ranked[starts + last - skipped]
        middles[enough, index], halves[enough, index] = (left + right) / 2, (right - left) / 2
    return 0


def _ranked(rows: Indices, values: Array, frames: int) -> tuple[Array, Indices, Indices]:
    """Return values sorted within each frame, (F,) where each frame starts, and (F,) counts."""
    counts = np.bincount(rows, minlength=frames)
    return values[np.lexsort((values, rows))], np.cumsum(counts) - counts, counts


_VOTING, ENDS = "tooltip_cli.method._voting_numba", "tooltip_cli.method._ends_numba"
_LOOPS: dict[str, tuple[str, Callable[..., int]]] = {
    "profiler": (_VOTING, _profile),
    "voter": (_VOTING, _vote),
    "placer": (_VOTING, _place),
    "carver": (_VOTING, _carve),
    "chooser": (ENDS, _choose),
    "measurer": (ENDS, _measure),
}
