"""The loops that fit an end to what images show of it, as machine code; see `_voting_numba`."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numba
import numpy as np

_SIDE, _MIDDLE = 2, 1  # kinds of equations, as in equations.py
_LINE = 7  # unknowns before the outlines, as in equations.py
_TINY = 1e-8  # m^2, as in equations.py


def chooser() -> Callable[..., int]:
    """Return the choice of edges about an end whose motion fits its depth, placed by its axis.

    Its arguments are the (E, 2) pixels, (E,) rows, (E, samples) profiles, and first depth and step
    of each profile, of ``count`` edges; the parts of a `sight.Sight`; how far across, behind and
    beyond the end is looked; the least sine and ratio; and the (E,) rows, metres along, across and
    along the axis itself to fill. It returns how many edges there are.
    """

    def choose(
        pixels: Any,
        rows: Any,
        profiles: Any,
        first: Any,
        step: Any,
        count: int,
        samples: int,
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
        found = np.int64(0)
        for e in range(count):
            row = rows[e]
            if sine[row] <= min_sine:
                continue
            du, dv = pixels[2 * e] - at[2 * row], pixels[2 * e + 1] - at[2 * row + 1]
            right, down = direction[2 * row], direction[2 * row + 1]
            forward = (du * right + dv * down) / scale[row]
            if forward >= beyond or forward <= -reach:
                continue
            aside = (dv * right - du * down) / scale[row]
            if abs(aside) >= width:
                continue
            length = forward / sine[row]
            if samples > 0:
                z = depth[row] + min(length, 0.0) * axis_depth[row]
                sample = np.floor((z - first[e]) / step[e] + 0.5)
                sample = min(max(sample, 0.0), float(samples - 1))
                if profiles[e * samples + np.int64(sample)] <= min_ratio:
                    continue
            kept[found], along[found], across[found] = row, forward, aside
            lengthwise[found] = length
            found += 1
        return int(found)

    return choose


def _smallest(values: Any, count: int, rank: int) -> float:
    """Return the value that would be at ``rank`` if values[:count] were sorted; moves them.

    Hoare's selection.
    """
    left, right = np.int64(0), count - 1
    while left < right:
        pivot = values[rank]
        i, j = left, right
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if j < rank:
            left = i
        if rank < i:
            right = j
    return float(values[rank])


_smallest = numba.njit(forceinline=True, error_model="numpy")(_smallest)


def measurer() -> Callable[..., int]:
    """Return the measuring of where a tool stops and where its sides are, in each frame.

    Its arguments are the (E,) rows, ascending, metres along, across and along the axis itself of
    ``count`` edges; the (F,) sines of ``frames``; the (S, 2) ``slabs``; how far across the end
    edges are looked at, the least sine there, the fewest edges, and the share of them beyond a
    side; (E,) scratch; and the (F,) stops and (F, S) middles and halves to fill, NaN so far.
    """

    def measure(
        rows: Any,
        along: Any,
        across: Any,
        lengthwise: Any,
        count: int,
        sine: Any,
        frames: int,
        limits: Any,
        slabs: int,
        end_width: float,
        min_sine: float,
        min_edges: int,
        quantile: float,
        values: Any,
        stops: Any,
        middles: Any,
        halves: Any,
    ) -> int:
        edge = np.int64(0)
        for frame in range(frames):
            begin = edge
            at_end = np.int64(0)
            farthest = -np.inf
            while edge < count and rows[edge] == frame:
                if abs(across[edge]) < end_width:
                    at_end += 1
                    farthest = max(farthest, along[edge])
                edge += 1
            if at_end >= min_edges:
                stops[frame] = farthest
            for slab in range(slabs):
                if slab == 0 and not sine[frame] > min_sine:
                    continue
                low, high = limits[2 * slab], limits[2 * slab + 1]
                found = np.int64(0)
                for e in range(begin, edge):
                    if slab == 0 and not abs(across[e]) < end_width:
                        continue
                    if lengthwise[e] > low and lengthwise[e] < high:
                        values[found] = across[e]
                        found += 1
                if found < min_edges:
                    continue
                share = quantile * (found - 1)
                skipped = np.int64(math.floor(share + 0.5))
                if skipped - share == 0.5:  # to even, as numpy rounds
                    skipped -= skipped % 2
                left = _smallest(values, found, skipped)
                right = _smallest(values, found, found - 1 - skipped)
                middles[frame * slabs + slab] = (left + right) / 2
                halves[frame * slabs + slab] = (right - left) / 2
        return 0

    return measure


def summer() -> Callable[..., int]:
    """Return the normal equations of a step of `equations.solve`.

    Its arguments are the parts of an `equations.System`: (R,) targets, (R, 7) derivatives, (R, 2)
    directions, (R,) outlines, (R,) kinds and (R,) frames of ``count`` equations, of which the last
    2 ``sides`` are the two sides of each middle; the (U,) unknowns and their number; the scale of
    the loss, the weights of a side and of a missed one, and the width that is odd; the (F,) weights
    of frames; (R,) and (U,) scratch; and the (U, U) matrix, of which the lower half is filled, and
    the (U,) right side to add to.
    """

    def add_up(
        targets: Any,
        linear: Any,
        seen_along: Any,
        outline: Any,
        kinds: Any,
        frames: Any,
        count: int,
        sides: int,
        unknowns: Any,
        size: int,
        loss: float,
        side_weight: float,
        missed_weight: float,
        odd_width: float,
        frame_weights: Any,
        residuals: Any,
        row: Any,
        normal: Any,
        right: Any,
    ) -> int:
        for r in range(count):
            residual = targets[r]
            for k in range(_LINE):
                residual -= linear[_LINE * r + k] * unknowns[k]
            if outline[r] >= 0:
                at = _LINE + 3 * outline[r]
                u, w = seen_along[2 * r], seen_along[2 * r + 1]
                first, second = unknowns[at] * u + unknowns[at + 1] * w, unknowns[at + 2] * w
                residual -= math.sqrt(first * first + second * second + _TINY)
            residuals[r] = residual
        first_side = count - 2 * sides
        middle = first_side - sides
        for r in range(count):
            residual = residuals[r]
            weight = frame_weights[frames[r]] / (loss * loss + residual * residual)
            if kinds[r] == _SIDE:
                weight *= side_weight
                if residual < 0:
                    weight *= missed_weight
            elif kinds[r] == _MIDDLE:
                pair = first_side + r - middle
                odd = (residuals[pair] + residuals[pair + sides]) / 2 / odd_width
                weight /= (1.0 + odd * odd) * (1.0 + odd * odd)
            for k in range(_LINE):
                row[k] = linear[_LINE * r + k]
            at = np.int64(0)
            if outline[r] >= 0:
                at = _LINE + 3 * outline[r]
                u, w = seen_along[2 * r], seen_along[2 * r + 1]
                first, second = unknowns[at] * u + unknowns[at + 1] * w, unknowns[at + 2] * w
                width = math.sqrt(first * first + second * second + _TINY)
                row[at], row[at + 1], row[at + 2] = (
                    first * u / width,
                    first * w / width,
                    second * w / width,
                )
            for i in range(_LINE):
                weighted = weight * row[i]
                right[i] += weighted * residual
                for k in range(i + 1):
                    normal[size * i + k] += weighted * row[k]
            if at > 0:
                for i in range(at, at + 3):
                    weighted = weight * row[i]
                    right[i] += weighted * residual
                    for k in range(_LINE):
                        normal[size * i + k] += weighted * row[k]
                    for k in range(at, i + 1):
                        normal[size * i + k] += weighted * row[k]
        return 0

    return add_up
