"""The loops of the voting method as machine code.

Arrays are addresses here, as in C, with their sizes beside them. Every function returns one to
compile, which returns an integer: 0 where there is nothing to count.

This module imports numba; `machine_code` imports it where there is something to compile.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

_BACKGROUND, _FOREGROUND = 127, 255  # values of a mask, as in silhouette.py
_NEAR = 0.02  # metres; nothing closer to the optical centre is seen
_LEAST_SCORE = 1e-3  # of the volume, as in loops.py: less says nothing
_BLOCK = 8  # voxels, a power of two


def profiler() -> Callable[..., int]:
    """Return the log-likelihood ratios of "on the hand at depth z" against "background".

    Its arguments are the (E, 2) points, (E, 2, 2) matches, (E, 2, 3) covariances, (E, 2, 2)
    background motions and (E,) rows of ``count`` edges; the (F, 2, 4, 4) partner_from_camera; the
    (F, 3) first depth, step and focal length; the number of depths, the bound of a ratio's parts,
    the variance of predictions, and the (E, depths) ratios to add to, over both partners.
    """

    def profile(
        points: Any,
        moved: Any,
        covariances: Any,
        background: Any,
        rows: Any,
        count: int,
        partner_from_camera: Any,
        depths: Any,
        samples: int,
        clip: float,
        variance: float,
        profiles: Any,
    ) -> int:
        for e in range(count):
            row = rows[e]
            x, y = points[2 * e], points[2 * e + 1]
            for k in range(2):
                at = 2 * e + k
                a = covariances[3 * at] + variance
                b = covariances[3 * at + 1]
                c = covariances[3 * at + 2] + variance
                determinant = a * c - b * b
                ia, ib, ic = c / determinant, -b / determinant, a / determinant
                mu, mv = moved[2 * at], moved[2 * at + 1]
                du, dv = mu - background[2 * at], mv - background[2 * at + 1]
                still = min(ia * du * du + 2 * ib * du * dv + ic * dv * dv, 2 * clip)
                m = 16 * (2 * row + k)
                m03, m13, m23 = (
                    partner_from_camera[m + 3],
                    partner_from_camera[m + 7],
                    partner_from_camera[m + 11],
                )
                rx = partner_from_camera[m] * x + partner_from_camera[m + 1] * y
                rx += partner_from_camera[m + 2]
                ry = partner_from_camera[m + 4] * x + partner_from_camera[m + 5] * y
                ry += partner_from_camera[m + 6]
                rz = partner_from_camera[m + 8] * x + partner_from_camera[m + 9] * y
                rz += partner_from_camera[m + 10]
                first, step, focal = depths[3 * row], depths[3 * row + 1], depths[3 * row + 2]
                for i in range(samples):
                    z = first + i * step
                    ahead = rz * z + m23
                    if ahead < _NEAR:
                        continue
                    eu = mu - focal * (rx * z + m03) / ahead
                    ev = mv - focal * (ry * z + m13) / ahead
                    hand = ia * eu * eu + 2 * ib * eu * ev + ic * ev * ev
                    profiles[e * samples + i] += 0.5 * (still - min(hand, 2 * clip))
        return 0

    return profile


def voter() -> Callable[..., int]:
    """Return the count, for each voxel, of the frames that should show it moving and that do.

    Its arguments are the ``n`` coordinates of voxels along each axis and how far from the origin
    they go; the (F, 3, 4) cameras and partners of ``frames`` frames; focal length and first column
    and line of the raster, its size, and the (F, height, width) nearest edges; the edges'
    (E, samples) profiles; the (F, 3) first depth, step and focal length; the least motion; the
    ratio that is a whole vote; scratch space: (n,) cells, (n, 2) spans, (2, n, n) sums; and the
    (n, n, n) hits and expected frames to fill.

    One layer of voxels at a time meets all frames, so that a frame's edges and the sums stay close
    to the processor, and each row of voxels is projected in vector instructions.
    """

    def vote(
        axis: Any,
        n: int,
        reach: float,
        cameras: Any,
        partners: Any,
        frames: int,
        focal: float,
        u0: float,
        v0: float,
        height: int,
        width: int,
        nearest: Any,
        profiles: Any,
        samples: int,
        depths: Any,
        least_motion: float,
        full: float,
        cells: Any,
        spans: Any,
        sums: Any,
        hits: Any,
        expected: Any,
    ) -> int:
        columns, lines = float(width), float(height)
        least = least_motion * least_motion
        for i in range(n):
            x = axis[i]
            for j in range(n):
                y = axis[j]
                low, high = np.int64(0), np.int64(n)
                while low < n and x * x + y * y + axis[low] * axis[low] > reach * reach:
                    low += 1
                while (
                    high > low and x * x + y * y + axis[high - 1] * axis[high - 1] > reach * reach
                ):
                    high -= 1
                spans[2 * j], spans[2 * j + 1] = low, high
            for at in range(2 * n * n):
                sums[at] = 0.0
            for f in range(frames):
                m = 12 * f
                a0, a1, a2, a3 = cameras[m], cameras[m + 1], cameras[m + 2], cameras[m + 3]
                b0, b1, b2, b3 = cameras[m + 4], cameras[m + 5], cameras[m + 6], cameras[m + 7]
                c0, c1, c2, c3 = cameras[m + 8], cameras[m + 9], cameras[m + 10], cameras[m + 11]
                d0, d1, d2, d3 = partners[m], partners[m + 1], partners[m + 2], partners[m + 3]
                e0, e1, e2, e3 = partners[m + 4], partners[m + 5], partners[m + 6], partners[m + 7]
                g0, g1, g2, g3 = (
                    partners[m + 8],
                    partners[m + 9],
                    partners[m + 10],
                    partners[m + 11],
                )
                first, step = depths[3 * f], depths[3 * f + 1]
                image = f * height * width
                for j in range(n):
                    y = axis[j]
                    low, high = spans[2 * j], spans[2 * j + 1]
                    due = n * n + j * n
                    for k in range(low, high):
                        z = axis[k]
                        depth = c0 * x + c1 * y + c2 * z + c3
                        px = focal * (a0 * x + a1 * y + a2 * z + a3) / depth
                        py = focal * (b0 * x + b1 * y + b2 * z + b3) / depth
                        u, v = np.floor(px - u0 + 0.5), np.floor(py - v0 + 0.5)
                        there = g0 * x + g1 * y + g2 * z + g3
                        du = focal * (d0 * x + d1 * y + d2 * z + d3) / there - px
                        dv = focal * (e0 * x + e1 * y + e2 * z + e3) / there - py
                        shown = (depth >= _NEAR) & (u >= 0.0) & (v >= 0.0)
                        shown &= (u < columns) & (v < lines) & (there >= _NEAR)
                        shown &= du * du + dv * dv >= least
                        sums[due + k] += 1.0 if shown else 0.0
                        cells[k] = v * columns + u if shown else -1.0
                    for k in range(low, high):
                        if cells[k] < 0.0:
                            continue
                        edge = np.int64(nearest[image + np.int64(cells[k])])
                        if edge < 0:
                            continue
                        depth = c0 * x + c1 * y + c2 * axis[k] + c3
                        sample = np.int64(np.floor((depth - first) / step + 0.5))
                        if 0 <= sample < samples:
                            ratio = profiles[edge * samples + sample]
                            if ratio > 0:
                                sums[j * n + k] += min(ratio, full) / full
            for at in range(n * n):
                hits[i * n * n + at] = sums[at]
                expected[i * n * n + at] = sums[n * n + at]
        return 0

    return vote


def placer() -> Callable[..., int]:
    """Return the choice of each edge's depth: where the volume and its own motion agree best.

    Its arguments are the (E, 2) points, (E,) rows and (E, samples) profiles of ``edges`` edges; the
    (F, 4, 4) hand_from_camera; the (F, 3) first depth, step and focal length; the (n, n, n) volume
    with its first coordinate and step; the weight of its logarithm; the depths tried from one
    sample to the next; (b, b, b) scratch, 0, b * 8 > n; and the (E, 3) positions and (E,) scores to
    fill, 0. Where the volume says next to nothing the score stays 0.

    Most of the volume is empty. Whether all of 8 voxels in each direction are is kept close to the
    processor, and spares looking them up.
    """

    def place(
        points: Any,
        rows: Any,
        profiles: Any,
        edges: int,
        samples: int,
        hand_from_camera: Any,
        depths: Any,
        volume: Any,
        n: int,
        corner: float,
        step: float,
        weight: float,
        substeps: int,
        blocks: Any,
        positions: Any,
        scores: Any,
    ) -> int:
        across = n // _BLOCK + 1
        for i in range(n):
            for j in range(n):
                for k in range(n):
                    if volume[(i * n + j) * n + k] <= _LEAST_SCORE:
                        continue
                    # whoever looks between voxels looks from the lower of two
                    for bi in range(max(i - 1, 0) // _BLOCK, i // _BLOCK + 1):
                        for bj in range(max(j - 1, 0) // _BLOCK, j // _BLOCK + 1):
                            for bk in range(max(k - 1, 0) // _BLOCK, k // _BLOCK + 1):
                                blocks[(bi * across + bj) * across + bk] = 1
        least = weight * math.log(_LEAST_SCORE)
        for e in range(edges):
            row = rows[e]
            m = 16 * row
            x, y = points[2 * e], points[2 * e + 1]
            rx = hand_from_camera[m] * x + hand_from_camera[m + 1] * y + hand_from_camera[m + 2]
            ry = hand_from_camera[m + 4] * x + hand_from_camera[m + 5] * y + hand_from_camera[m + 6]
            rz = hand_from_camera[m + 8] * x + hand_from_camera[m + 9] * y
            rz += hand_from_camera[m + 10]
            tx, ty, tz = hand_from_camera[m + 3], hand_from_camera[m + 7], hand_from_camera[m + 11]
            best = -math.inf
            first, stride = depths[3 * row], depths[3 * row + 1]
            after = float(profiles[e * samples])
            for i in range(samples):
                here = after
                after = float(profiles[e * samples + i + 1]) if i + 1 < samples else -1.0
                if here <= 0 and after <= 0:
                    continue
                for part in range(substeps if i + 1 < samples else 1):
                    ratio = here
                    if part > 0:
                        ratio += part / substeps * (after - here)
                    if ratio <= 0:
                        continue
                    z = first + ((i * substeps + part) / substeps) * stride
                    hx, hy, hz = rx * z + tx, ry * z + ty, rz * z + tz
                    a, b, c = (hx - corner) / step, (hy - corner) / step, (hz - corner) / step
                    ia, ib, ic = np.floor(a), np.floor(b), np.floor(c)
                    if ia < 0 or ib < 0 or ic < 0 or ia > n - 2 or ib > n - 2 or ic > n - 2:
                        continue
                    block = (np.int64(ia) // _BLOCK * across + np.int64(ib) // _BLOCK) * across
                    if blocks[block + np.int64(ic) // _BLOCK] == 0:
                        if least + ratio > best:
                            best = least + ratio
                            scores[e] = 0.0
                        continue
                    a, b, c = a - ia, b - ib, c - ic
                    at = (np.int64(ia) * n + np.int64(ib)) * n + np.int64(ic)
                    v00 = volume[at] * (1 - c) + volume[at + 1] * c
                    v01 = volume[at + n] * (1 - c) + volume[at + n + 1] * c
                    at += n * n
                    v10 = volume[at] * (1 - c) + volume[at + 1] * c
                    v11 = volume[at + n] * (1 - c) + volume[at + n + 1] * c
                    score = (v00 * (1 - b) + v01 * b) * (1 - a) + (v10 * (1 - b) + v11 * b) * a
                    said = score > _LEAST_SCORE
                    total = (weight * math.log(score) if said else least) + ratio
                    if total > best:
                        best = total
                        positions[3 * e], positions[3 * e + 1], positions[3 * e + 2] = hx, hy, hz
                        scores[e] = score if said else 0.0
        return 0

    return place


def carver() -> Callable[..., int]:
    """Return the count, for each voxel, of the masks in which it is foreground and background.

    Its arguments are ``count`` voxels (V, 3); the (F, 3, 4) cameras, to pixels of the masks, and
    the (F, height, width) masks of ``frames`` frames, in the order in which they are to be looked
    at; how many may show background before a voxel is left; and the (V,) counts to add to.
    """

    def carve(
        voxels: Any,
        count: int,
        cameras: Any,
        masks: Any,
        order: Any,
        frames: int,
        height: int,
        width: int,
        limit: int,
        inside: Any,
        carved: Any,
    ) -> int:
        for i in range(count):
            x, y, z = voxels[3 * i], voxels[3 * i + 1], voxels[3 * i + 2]
            for turn in range(frames):
                f = order[turn]
                m = 12 * f
                depth = cameras[m + 8] * x + cameras[m + 9] * y + cameras[m + 10] * z
                depth += cameras[m + 11]
                if depth < _NEAR:
                    continue
                right = cameras[m] * x + cameras[m + 1] * y + cameras[m + 2] * z + cameras[m + 3]
                down = cameras[m + 4] * x + cameras[m + 5] * y + cameras[m + 6] * z
                down += cameras[m + 7]
                u, v = np.floor(right / depth + 0.5), np.floor(down / depth + 0.5)
                if u < 0 or v < 0 or u >= width or v >= height:
                    continue
                value = masks[(f * height + np.int64(v)) * width + np.int64(u)]
                if value == _FOREGROUND:
                    inside[i] += 1
                elif value == _BACKGROUND:
                    carved[i] += 1
                    if carved[i] > limit:
                        break
        return 0

    return carve
