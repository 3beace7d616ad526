"""Canny's edge points as machine code, the same as OpenCV's.

All numbers are small integers, but stand in 32-bit floats: those are what numba leaves as they are,
so that LLVM turns the loops into vector instructions, and they are exact below 2^24.

This module imports numba; `machine_code` imports it where there is something to compile.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np

_F = np.float32
_ZERO, _ONE, _TWO = _F(0), _F(1), _F(2)
_TAN_22 = _F(13573)  # tan(22.5 deg) 2^15, rounded, as in OpenCV
_SCALE = _F(1 << 15)
_STRONG = 0x0202020202020202  # a bit of every strong point among eight


def _gradients(
    above: int, here: int, below: int, image: Any, width: int, row: int, ring: Any, stride: int
) -> None:
    """Write dx, dy and |dx| + |dy| of one row into a ring's row (Sobel 3x3, replicated border).

    `above`, `here` and `below` are where the three rows of the image start. The ring's row holds
    three parts of `stride` numbers, the first and last of which stay 0.
    """
    dxs, dys, magnitudes = row + 1, row + stride + 1, row + 2 * stride + 1
    for u in range(1, width - 1):
        a, b, c = _F(image[above + u - 1]), _F(image[here + u - 1]), _F(image[below + u - 1])
        d, e = _F(image[above + u]), _F(image[below + u])
        f, g, h = _F(image[above + u + 1]), _F(image[here + u + 1]), _F(image[below + u + 1])
        dx = (f - a) + _TWO * (g - b) + (h - c)
        dy = (c + _TWO * e + h) - (a + _TWO * d + f)
        ring[dxs + u], ring[dys + u], ring[magnitudes + u] = dx, dy, abs(dx) + abs(dy)
    for u in (0, width - 1):
        left, right = max(u - 1, 0), min(u + 1, width - 1)
        a, b, c = _F(image[above + left]), _F(image[here + left]), _F(image[below + left])
        d, e = _F(image[above + u]), _F(image[below + u])
        f, g, h = _F(image[above + right]), _F(image[here + right]), _F(image[below + right])
        dx = (f - a) + _TWO * (g - b) + (h - c)
        dy = (c + _TWO * e + h) - (a + _TWO * d + f)
        ring[dxs + u], ring[dys + u], ring[magnitudes + u] = dx, dy, abs(dx) + abs(dy)


def _suppress(
    up: int,
    row: int,
    down: int,
    ring: Any,
    stride: int,
    width: int,
    low: Any,
    high: Any,
    map_: Any,
    at: int,
) -> None:
    """Write 1 at the weak and 2 at the strong edge points of a row, 0 elsewhere.

    `up`, `row` and `down` are where the three rows' parts start in the ring, `at` where the map's
    row starts.
    """
    above, here, below = up + 2 * stride, row + 2 * stride, down + 2 * stride
    for u in range(1, width + 1):
        dx, dy, m = ring[row + u], ring[row + stride + u], ring[here + u]
        x, y = abs(dx), abs(dy)
        tan = x * _TAN_22
        level = y * _SCALE < tan
        upright = (y - x - x) * _SCALE > tan
        rising = dx * dy < _ZERO
        # all are loaded, whichever is wanted: a load that hangs on a condition is no vector's
        a, b, c = ring[above + u - 1], ring[above + u], ring[above + u + 1]
        d, e = ring[here + u - 1], ring[here + u + 1]
        f, g, h = ring[below + u - 1], ring[below + u], ring[below + u + 1]
        one = d if level else (b if upright else (c if rising else a))
        two = e - _ONE if level else (g - _ONE if upright else (f if rising else h))
        weak = _ONE if (m > low) & (m > one) & (m > two) else _ZERO
        map_[at + u] = np.uint8(weak + weak if m > high else weak)


_gradients_of = numba.njit(forceinline=True, error_model="numpy")(_gradients)
_suppressed = numba.njit(forceinline=True, error_model="numpy")(_suppress)


def edge_finder() -> Callable[..., int]:
    """Return the longhand of Canny's detector, to be compiled.

    Its arguments are the image, its rows and columns, both thresholds, the margin to leave out of
    the result; scratch space: 3 rows of 3 parts of zeros, a map of zeros with a border of one
    point, the same as words of eight points, and a stack, with room for all points and eight more;
    and the u, v to fill, with room for all points within the margin and eight more. Parts and the
    map's rows are as many whole words long as hold W + 2 points. An image has at least 3 rows and
    columns. It returns how many points there are.
    """

    def find(
        image: Any,
        height: int,
        width: int,
        low: float,
        high: float,
        margin: int,
        ring: Any,
        map_: Any,
        words: Any,
        stack: Any,
        points: Any,
    ) -> int:
        stride = (width + 9) & ~7
        size = 3 * stride
        for v in range(height + 1):
            if v < height:
                above, below = max(v - 1, 0) * width, min(v + 1, height - 1) * width
                _gradients_of(above, v * width, below, image, width, v % 3 * size, ring, stride)
            else:  # beyond the last row nothing has a magnitude
                for u in range(stride):
                    ring[v % 3 * size + 2 * stride + u] = _ZERO
            if v > 0:
                up, row, down = (v + 1) % 3 * size, (v + 2) % 3 * size, v % 3 * size
                _suppressed(up, row, down, ring, stride, width, _F(low), _F(high), map_, v * stride)
        top = np.int64(0)
        for at in range(stride, (height + 1) * stride):
            stack[top] = at  # written always and counted if it is one: there is no branch to guess
            top += map_[at] == 2
        while top > 0:
            top -= 1
            at = np.int64(stack[top])
            for middle in (at - stride, at, at + stride):
                for other in range(middle - 1, middle + 2):
                    if map_[other] == 1:
                        map_[other] = 2
                        stack[top] = other
                        top += 1
        count = np.int64(0)
        for v in range(margin, height - margin):
            first = (v + 1) * stride
            for word in range(first // 8, first // 8 + stride // 8):
                if words[word] & _STRONG:
                    for u in range(8 * word - first - 1, 8 * word - first + 7):
                        points[2 * count], points[2 * count + 1] = u, v
                        inside = (u >= margin) & (u < width - margin)
                        count += inside & (map_[first + u + 1] == 2)
        return int(count)

    return find
