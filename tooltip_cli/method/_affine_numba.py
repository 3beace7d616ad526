"""The iterated fit of `affine.fit_background` as machine code.

The edges are laid out column by column once, so that every later pass over them runs in vector
instructions: one pass adds up the normal equations of appendix A, one computes the distances and
their ranks, one counts the ranks. Arrays are addresses here, as in C: what numba calls an array
counts references and lets indices wrap around, which keeps loops from becoming vector code.

This module imports numba; `machine_code` imports it where there is something to compile.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from typing import Any

import numba
import numpy as np

_BINS = 1024  # of the squared distance, 32 to an octave, from 2^-8 to 2^24
_HALF_BIN, _BIN_BITS = np.int64(1 << 46), np.int64(47)
_FIRST_BIN = np.int64((1023 - 8) << 5)
_NO_LIMIT = sys.float_info.max  # the infinity of edges that were dropped lies above it


def _helper(function: Callable[..., Any], **options: Any) -> Any:
    """Compile what only `background_fitter` calls into it, so that LLVM sees that nothing raises.

    Code that may raise needs numba to run.
    """
    return numba.njit(forceinline=True, error_model="numpy", **options)(function)


# Sums in any order are what lets them be formed in vector lanes; the order depends on the
# processor's lanes but never on the run.
_ANY_ORDER = {"reassoc", "contract", "nsz"}


def _middle(pairs: Any, size: int) -> tuple[float, float, float]:
    """Return a point amid flat (u, v) pairs and a power of two that scales them to about 1."""
    u = v = uu = vv = 0.0
    for i in range(size):
        u += pairs[2 * i]
        v += pairs[2 * i + 1]
        uu += float(pairs[2 * i]) * pairs[2 * i]
        vv += float(pairs[2 * i + 1]) * pairs[2 * i + 1]
    u, v = u / size, v / size
    spread = max(uu / size - u * u, vv / size - v * v)
    exponent = math.ceil(0.5 * math.log2(spread)) if 0.0 < spread < math.inf else 0
    return float(round(u)), float(round(v)), 2.0 ** float(-exponent)


def _lay_out(
    edges: Any,
    translations: Any,
    covariances: Any,
    size: int,
    middle: tuple[float, float, float],
    columns: Any,
) -> None:
    """Write u, v (centred and scaled), tu, tv and the terms c1, c3, c4 of C^-1 into columns.

    Where C is not positive definite its terms become nan, and so does every sum.
    """
    u, v, scale = middle
    for i in range(size):
        columns[i] = (edges[2 * i] - u) * scale
        columns[size + i] = (edges[2 * i + 1] - v) * scale
        columns[2 * size + i] = translations[2 * i]
        columns[3 * size + i] = translations[2 * i + 1]
        uu, uv, vv = covariances[3 * i], covariances[3 * i + 1], covariances[3 * i + 2]
        determinant = uu * vv - uv * uv
        inverse = 1.0 / determinant if (determinant > 0.0) & (uu > 0.0) else math.nan
        columns[4 * size + i] = vv * inverse
        columns[5 * size + i] = -uv * inverse
        columns[6 * size + i] = uu * inverse


def _add_up(columns: Any, size: int, squared: Any, limit: float, sums: Any) -> None:
    """Add up the terms of appendix A over the edges with a squared distance up to `limit`.

    The sums are those of c1, c3 and c4 times (1, u, v, uu, uv, vv), of (c1 tu + c3 tv) and
    (c3 tu + c4 tv) times (1, u, v).
    """
    a = au = av = auu = auv = avv = 0.0
    b = bu = bv = buu = buv = bvv = 0.0
    d = du = dv = duu = duv = dvv = 0.0
    g = gu = gv = h = hu = hv = 0.0
    for i in range(size):
        kept = squared[i] <= limit
        u, v, tu, tv = columns[i], columns[size + i], columns[2 * size + i], columns[3 * size + i]
        c1, c3, c4 = columns[4 * size + i], columns[5 * size + i], columns[6 * size + i]
        c1, c3, c4 = c1 if kept else 0.0, c3 if kept else 0.0, c4 if kept else 0.0
        c1u, c1v, c3u, c3v, c4u, c4v = c1 * u, c1 * v, c3 * u, c3 * v, c4 * u, c4 * v
        a, au, av = a + c1, au + c1u, av + c1v
        auu, auv, avv = auu + c1u * u, auv + c1u * v, avv + c1v * v
        b, bu, bv = b + c3, bu + c3u, bv + c3v
        buu, buv, bvv = buu + c3u * u, buv + c3u * v, bvv + c3v * v
        d, du, dv = d + c4, du + c4u, dv + c4v
        duu, duv, dvv = duu + c4u * u, duv + c4u * v, dvv + c4v * v
        s, t = c1 * tu + c3 * tv, c3 * tu + c4 * tv
        g, gu, gv = g + s, gu + s * u, gv + s * v
        h, hu, hv = h + t, hu + t * u, hv + t * v
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5] = a, au, av, auu, auv, avv
    sums[6], sums[7], sums[8], sums[9], sums[10], sums[11] = b, bu, bv, buu, buv, bvv
    sums[12], sums[13], sums[14], sums[15], sums[16], sums[17] = d, du, dv, duu, duv, dvv
    sums[18], sums[19], sums[20], sums[21], sums[22], sums[23] = g, gu, gv, h, hu, hv


def _count(squared: Any, size: int, limit: float) -> int:
    """Count the edges of `_add_up`: a loop of its own, which needs a register less in the other."""
    count = 0
    for i in range(size):
        count += squared[i] <= limit
    return count


def _solve(sums: Any, tolerance: float, lower: Any, model: Any) -> bool:
    """Solve the normal equations by Cholesky's method; False, and no model, if singular.

    `lower` is scratch space for 42 numbers: the triangle, and the solution as it is found.
    """
    for i in range(6):
        for j in range(i + 1):  # the product of terms i and j is one of the six in its block
            product = i % 3 + j % 3 + (min(i % 3, j % 3) > 0)
            lower[6 * i + j] = sums[6 * (i // 3 + j // 3) + product]
    for i in range(6):
        lower[36 + i] = sums[18 + i]
        if not math.isfinite(lower[36 + i]):
            return False
    for j in range(6):
        diagonal = lower[7 * j]
        pivot = diagonal
        for k in range(j):
            pivot -= lower[6 * j + k] ** 2
        if not (diagonal * tolerance < pivot < math.inf):
            return False
        lower[7 * j] = math.sqrt(pivot)
        for i in range(j + 1, 6):
            for k in range(j):
                lower[6 * i + j] -= lower[6 * i + k] * lower[6 * j + k]
            lower[6 * i + j] /= lower[7 * j]
    for i in range(6):
        for k in range(i):
            lower[36 + i] -= lower[6 * i + k] * lower[36 + k]
        lower[36 + i] /= lower[7 * i]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            lower[36 + i] -= lower[6 * k + i] * lower[36 + k]
        lower[36 + i] /= lower[7 * i]
    for i in range(6):
        model[i] = lower[36 + i]
    return True


def _square_distances(
    columns: Any, size: int, model: Any, limit: float, squared: Any, keys: Any
) -> None:
    """Replace squared distances up to `limit` by those from the model, and others by infinity.

    `keys` become their bins.
    """
    m0, m1, m2, m3, m4, m5 = model[0], model[1], model[2], model[3], model[4], model[5]
    for i in range(size):
        u, v = columns[i], columns[size + i]
        x = m0 + m1 * u + m2 * v - columns[2 * size + i]
        y = m3 + m4 * u + m5 * v - columns[3 * size + i]
        c1, c3, c4 = columns[4 * size + i], columns[5 * size + i], columns[6 * size + i]
        square = max(c1 * x * x + 2.0 * c3 * x * y + c4 * y * y, 0.0)
        square = square if squared[i] <= limit else math.inf
        squared[i] = square
        key = ((np.float64(square).view(np.int64) + _HALF_BIN) >> _BIN_BITS) - _FIRST_BIN
        keys[i] = min(max(key, 0), _BINS - 1)


def _keep_best(keys: Any, size: int, keep: int, bins: Any) -> Any:
    """Return the squared distance up to which `keep` edges or, with their ties, more lie."""
    for key in range(4 * _BINS):
        bins[key] = 0
    whole = size & ~3
    for i in range(0, whole, 4):  # four counts, so that equal distances do not wait for each other
        bins[keys[i]] += 1
        bins[_BINS + keys[i + 1]] += 1
        bins[2 * _BINS + keys[i + 2]] += 1
        bins[3 * _BINS + keys[i + 3]] += 1
    for i in range(whole, size):
        bins[keys[i]] += 1
    found = 0
    for key in range(_BINS - 1):
        found += bins[key] + bins[_BINS + key] + bins[2 * _BINS + key] + bins[3 * _BINS + key]
        if found >= keep:
            return 2.0 ** float((key >> 5) - 8) * (1.0 + ((key & 31) + 0.5) / 32.0)
    return _NO_LIMIT


def _to_scaled(model: Any, middle: tuple[float, float, float]) -> None:
    """Turn A into the constant and the two slopes of tu and of tv in the columns' coordinates."""
    u, v, scale = middle
    for row in range(2):
        slope_u = model[3 * row] - (row == 0)
        slope_v = model[3 * row + 1] - (row == 1)
        model[3 * row] = model[3 * row + 2] + slope_u * u + slope_v * v
        model[3 * row + 1], model[3 * row + 2] = slope_u / scale, slope_v / scale


def _from_scaled(model: Any, middle: tuple[float, float, float]) -> None:
    """The inverse of `_to_scaled`."""
    u, v, scale = middle
    for row in range(2):
        constant = model[3 * row]
        slope_u, slope_v = model[3 * row + 1] * scale, model[3 * row + 2] * scale
        model[3 * row], model[3 * row + 1] = slope_u + (row == 0), slope_v + (row == 1)
        model[3 * row + 2] = constant - slope_u * u - slope_v * v


_middle_of = _helper(_middle, fastmath=_ANY_ORDER)
_laid_out = _helper(_lay_out)
_added_up = _helper(_add_up, fastmath=_ANY_ORDER)
_counted = _helper(_count)
_solved = _helper(_solve)
_squared_distances = _helper(_square_distances, fastmath={"contract"})
_kept_best = _helper(_keep_best)
_scaled = _helper(_to_scaled)
_unscaled = _helper(_from_scaled)


def background_fitter() -> Callable[..., int]:
    """Return the longhand of `affine.fit_background`, to be compiled.

    Its arguments are what `affine._fit_compiled` gives: edges, translations and covariances of N
    edges; the (6,) model to rank by first, which is overwritten, unless ``started`` is 0; the
    number of iterations, the fraction to drop, the squared distance below which nothing is dropped,
    the tolerance for singularity; scratch space: (7, N) columns, (N,) keys, (4, bins) counts, 24
    sums and 42 numbers; and the results to fill: the (6,) model, (N,) distances and (N,) inliers.
    It returns whether there is a model.
    """

    def fit_edges(
        edges: Any,
        translations: Any,
        covariances: Any,
        size: int,
        ranking: Any,
        started: int,
        iterations: int,
        drop_fraction: float,
        keep_below: float,
        tolerance: float,
        columns: Any,
        keys: Any,
        bins: Any,
        sums: Any,
        lower: Any,
        model: Any,
        squared: Any,
        inliers: Any,
    ) -> int:
        middle = _middle_of(edges, size)
        _laid_out(edges, translations, covariances, size, middle, columns)
        limit, count = _NO_LIMIT, size
        for i in range(size):
            squared[i] = 0.0
        _added_up(columns, size, squared, limit, sums)
        if not _solved(sums, tolerance, lower, model):
            return 0
        if started:
            _scaled(ranking, middle)
        ranked_by_fit = not started
        for _ in range(iterations):
            leading = model if ranked_by_fit else ranking
            _squared_distances(columns, size, leading, limit, squared, keys)
            keep = count - math.ceil(drop_fraction * count)
            limit = max(_kept_best(keys, size, keep, bins), keep_below)
            left = _counted(squared, size, limit)
            if left == count and ranked_by_fit:
                break
            ranked_by_fit = True
            if left == count:
                continue
            _added_up(columns, size, squared, limit, sums)
            if not _solved(sums, tolerance, lower, model):
                limit = _NO_LIMIT
                break
            count = left
        for i in range(size):
            inliers[i] = squared[i] <= limit
        _squared_distances(columns, size, model, math.inf, squared, keys)
        for i in range(size):
            squared[i] = math.sqrt(squared[i])
        _unscaled(model, middle)
        return 1

    return fit_edges
