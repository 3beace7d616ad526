"""The iterated fit of `affine.fit_background` as machine code.

The edges are laid out column by column once, so that every later pass over them runs in vector
instructions: one pass adds up the normal equations of appendix A, one computes the distances, one
ranks them. This module imports numba; import it only where `_jit.numba_available` has said yes.
"""

from __future__ import annotations

import functools
import math
import sys
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numba import types

from tooltip_cli.method import _jit

_BINS = 1024  # of the squared distance, 32 to an octave, from 2^-8 to 2^24
_HALF_BIN, _BIN_BITS = np.int64(1 << 46), np.int64(47)
_FIRST_BIN = np.int64((1023 - 8) << 5)
_NO_LIMIT = sys.float_info.max  # the infinity of edges that were dropped lies above it


def _helper(function: Callable[..., Any], **options: Any) -> Any:
    """Compile what only `background_fitter` calls, together with it."""
    return numba.njit(nogil=True, error_model="numpy", **options)(function)


# Sums in any order are what lets them be formed in vector lanes; the order depends on the
# processor's lanes but never on the run.
_ANY_ORDER = {"reassoc", "contract", "nsz"}


def _middle(pairs: Any) -> tuple[float, float, float]:
    """Return a point amid flat (u, v) pairs and a power of two that scales them to about 1."""
    count = pairs.size // 2
    u = v = uu = vv = 0.0
    for i in range(count):
        u += pairs[2 * i]
        v += pairs[2 * i + 1]
        uu += float(pairs[2 * i]) * pairs[2 * i]
        vv += float(pairs[2 * i + 1]) * pairs[2 * i + 1]
    u, v = u / count, v / count
    spread = max(uu / count - u * u, vv / count - v * v)
    exponent = math.ceil(0.5 * math.log2(spread)) if 0.0 < spread < math.inf else 0
    return float(round(u)), float(round(v)), 2.0**-exponent


def _lay_out(
    edges: Any, translations: Any, covariances: Any, u: float, v: float, scale: float, columns: Any
) -> None:
    """Write u, v (centred and scaled), tu, tv and the terms c1, c3, c4 of C^-1 into columns.

    Where C is not positive definite its terms become nan, and so does every sum.
    """
    us, vs, tus, tvs = columns[0], columns[1], columns[2], columns[3]
    c1s, c3s, c4s = columns[4], columns[5], columns[6]
    for i in range(columns.shape[1]):
        us[i] = (edges[2 * i] - u) * scale
        vs[i] = (edges[2 * i + 1] - v) * scale
        tus[i] = translations[2 * i]
        tvs[i] = translations[2 * i + 1]
        uu, uv, vv = covariances[3 * i], covariances[3 * i + 1], covariances[3 * i + 2]
        determinant = uu * vv - uv * uv
        inverse = 1.0 / determinant if (determinant > 0.0) & (uu > 0.0) else math.nan
        c1s[i] = vv * inverse
        c3s[i] = -uv * inverse
        c4s[i] = uu * inverse


def _add_up(columns: Any, squared: Any, limit: float, sums: Any) -> None:
    """Add up the terms of appendix A over the edges with a squared distance up to `limit`.

    The sums are those of c1, c3 and c4 times (1, u, v, uu, uv, vv), of (c1 tu + c3 tv) and
    (c3 tu + c4 tv) times (1, u, v).
    """
    us, vs, tus, tvs = columns[0], columns[1], columns[2], columns[3]
    c1s, c3s, c4s = columns[4], columns[5], columns[6]
    a = au = av = auu = auv = avv = 0.0
    b = bu = bv = buu = buv = bvv = 0.0
    d = du = dv = duu = duv = dvv = 0.0
    g = gu = gv = h = hu = hv = 0.0
    for i in range(columns.shape[1]):
        weight = 1.0 if squared[i] <= limit else 0.0
        u, v, tu, tv = us[i], vs[i], tus[i], tvs[i]
        c1, c3, c4 = weight * c1s[i], weight * c3s[i], weight * c4s[i]
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


def _count(squared: Any, limit: float) -> int:
    """Count the edges of `_add_up`: a loop of its own, which needs a register less in the other."""
    count = 0
    for i in range(squared.size):
        count += squared[i] <= limit
    return count


def _solve(sums: Any, tolerance: float, model: Any) -> bool:
    """Solve the normal equations by Cholesky's method; False, and nothing written, if singular."""
    lower = np.empty((6, 6))
    for i in range(6):
        for j in range(i + 1):  # the product of terms i and j is one of the six in its block
            product = i % 3 + j % 3 + (min(i % 3, j % 3) > 0)
            lower[i, j] = sums[6 * (i // 3 + j // 3) + product]
    solution = np.empty(6)
    for i in range(6):
        solution[i] = sums[18 + i]
        if not math.isfinite(solution[i]):
            return False
    for j in range(6):
        diagonal = lower[j, j]
        pivot = diagonal
        for k in range(j):
            pivot -= lower[j, k] ** 2
        if not (diagonal * tolerance < pivot < math.inf):
            return False
        lower[j, j] = math.sqrt(pivot)
        for i in range(j + 1, 6):
            for k in range(j):
                lower[i, j] -= lower[i, k] * lower[j, k]
            lower[i, j] /= lower[j, j]
    for i in range(6):
        for k in range(i):
            solution[i] -= lower[i, k] * solution[k]
        solution[i] /= lower[i, i]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            solution[i] -= lower[k, i] * solution[k]
        solution[i] /= lower[i, i]
    for i in range(6):
        model[i] = solution[i]
    return True


def _square_distances(columns: Any, model: Any, limit: float, squared: Any) -> None:
    """Replace squared distances up to `limit` by those from the model, and others by infinity."""
    us, vs, tus, tvs = columns[0], columns[1], columns[2], columns[3]
    c1s, c3s, c4s = columns[4], columns[5], columns[6]
    m0, m1, m2, m3, m4, m5 = model[0], model[1], model[2], model[3], model[4], model[5]
    for i in range(squared.size):
        x = m0 + m1 * us[i] + m2 * vs[i] - tus[i]
        y = m3 + m4 * us[i] + m5 * vs[i] - tvs[i]
        square = max(c1s[i] * x * x + 2.0 * c3s[i] * x * y + c4s[i] * y * y, 0.0)
        squared[i] = square if squared[i] <= limit else math.inf


def _keep_best(squared: Any, keep: int, bins: Any) -> float:
    """Return the squared distance up to which `keep` edges or, with their ties, more lie."""
    bits = squared.view(np.int64)
    for lane in range(4):
        for key in range(_BINS):
            bins[lane, key] = 0
    whole = bits.size & ~3
    for i in range(0, whole, 4):
        for lane in range(4):  # of four counts, so that equal distances do not wait for each other
            key = ((bits[i + lane] + _HALF_BIN) >> _BIN_BITS) - _FIRST_BIN
            bins[lane, min(max(key, 0), _BINS - 1)] += 1
    for i in range(whole, bits.size):
        key = ((bits[i] + _HALF_BIN) >> _BIN_BITS) - _FIRST_BIN
        bins[0, min(max(key, 0), _BINS - 1)] += 1
    found = 0
    for key in range(_BINS - 1):
        found += bins[0, key] + bins[1, key] + bins[2, key] + bins[3, key]
        if found >= keep:
            return 2.0 ** (key // 32 - 8) * (1.0 + (key % 32 + 0.5) / 32.0)
    return _NO_LIMIT


def _to_scaled(model: Any, u: float, v: float, scale: float, scaled: Any) -> None:
    """Turn A into the constant and the two slopes of tu and of tv in the columns' coordinates."""
    for row in range(2):
        slope_u = model[3 * row] - (row == 0)
        slope_v = model[3 * row + 1] - (row == 1)
        scaled[3 * row] = model[3 * row + 2] + slope_u * u + slope_v * v
        scaled[3 * row + 1], scaled[3 * row + 2] = slope_u / scale, slope_v / scale


def _from_scaled(scaled: Any, u: float, v: float, scale: float, model: Any) -> None:
    """The inverse of `_to_scaled`; both may be the same array."""
    for row in range(2):
        constant = scaled[3 * row]
        slope_u, slope_v = scaled[3 * row + 1] * scale, scaled[3 * row + 2] * scale
        model[3 * row], model[3 * row + 1] = slope_u + (row == 0), slope_v + (row == 1)
        model[3 * row + 2] = constant - slope_u * u - slope_v * v


_middle_of = _helper(_middle, fastmath=_ANY_ORDER)
_laid_out = _helper(_lay_out)
_added_up = _helper(_add_up, fastmath=_ANY_ORDER)
_counted = _helper(_count)
_solved = _helper(_solve)
_squared_distances = _helper(_square_distances)
_kept_best = _helper(_keep_best)
_scaled = _helper(_to_scaled)
_unscaled = _helper(_from_scaled)


def _fit(
    edges: Any,
    translations: Any,
    covariances: Any,
    start: Any,
    iterations: int,
    drop_fraction: float,
    keep_below: float,
    tolerance: float,
    columns: Any,
    model: Any,
    distances: Any,
    inliers: Any,
) -> bool:
    u, v, scale = _middle_of(edges)
    _laid_out(edges, translations, covariances, u, v, scale, columns)
    sums, bins, fit, ranking = np.empty(24), np.empty((4, _BINS), np.int32), model, np.empty(6)
    squared, limit, count = distances, _NO_LIMIT, distances.size
    _added_up(columns, squared, limit, sums)
    if not _solved(sums, tolerance, fit):
        return False
    ranked_by_fit = start.size == 0
    if not ranked_by_fit:
        _scaled(start, u, v, scale, ranking)
    for _ in range(iterations):
        _squared_distances(columns, fit if ranked_by_fit else ranking, limit, squared)
        keep = count - math.ceil(drop_fraction * count)
        limit = max(_kept_best(squared, keep, bins), keep_below)
        left = _counted(squared, limit)
        if left == count and ranked_by_fit:
            break
        ranked_by_fit = True
        if left == count:
            continue
        _added_up(columns, squared, limit, sums)
        if not _solved(sums, tolerance, fit):
            limit = _NO_LIMIT
            break
        count = left
    for i in range(inliers.size):
        inliers[i] = squared[i] <= limit
    _squared_distances(columns, fit, math.inf, squared)
    for i in range(squared.size):
        distances[i] = math.sqrt(squared[i])
    _unscaled(fit, u, v, scale, model)
    return True


@functools.cache
def background_fitter(integers: bool) -> Callable[..., bool]:
    """Return the compiled `affine.fit_background` for int32 or for float64 edges.

    Its arguments are flat edges, translations and covariances, the (6,) model to rank by first or
    (0,), the number of iterations, the fraction to drop, the squared distance below which nothing
    is dropped, the tolerance for singularity, a (7, N) scratch array, and the results to fill: the
    (6,) model, (N,) distances, which must be zeros, and (N,) inliers. It returns whether there is
    a model.
    """
    pairs = types.Array(types.int32 if integers else types.float64, 1, "C", readonly=True)
    signature = types.boolean(
        pairs,
        pairs,
        types.Array(types.float64, 1, "C", readonly=True),
        types.Array(types.float64, 1, "C", readonly=True),
        types.int64,
        types.float64,
        types.float64,
        types.float64,
        types.float64[:, ::1],
        types.float64[::1],
        types.float64[::1],
        types.boolean[::1],
    )
    return _jit.compiled(_fit, signature)
