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
_STRONG = np.int64(0x0202020202020202)  # a bit of every strong point among eight
_POINT, _LAST = np.int64(8), np.int64(56)  # bits to the next point of a word, and to its last


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


def _first_point(chosen: Any) -> Any:
    """Return which of a word's eight points its lowest bit belongs to; there is one."""
    lowest = np.float64(chosen & -chosen)  # a power of two, which a double holds
    return ((lowest.view(np.int64) >> 52) - 1023) >> 3


_first_point = numba.njit(forceinline=True, error_model="numpy")(_first_point)
_gradients_of = numba.njit(forceinline=True, error_model="numpy")(_gradients)
_suppressed = numba.njit(forceinline=True, error_model="numpy")(_suppress)


def edge_finder() -> Callable[..., int]:
    """Return the longhand of Canny's detector, to be compiled.

    Its arguments are the image, its rows and columns, both thresholds, the margin to leave out of
    the result; scratch space: 3 rows of 3 parts of zeros, a map of zeros with a border of one
    point and eight points more, the same as words of eight points, and a queue, with room for all
    points and eight more; and the u, v to fill, with room for all points within the margin and
    eight more. Parts and the map's rows are as many whole words long as hold W + 2 points. Words
    have their first point in their lowest byte. An image has at least 3 rows and
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
        queue: Any,
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
        last, across = np.int64(0), stride // 8
        for word in range(across, (height + 1) * across):
            near = words[word - across] | words[word] | words[word + across]
            left = words[word - across - 1] | words[word - 1] | words[word + across - 1]
            right = words[word - across + 1] | words[word + 1] | words[word + across + 1]
            near |= near << _POINT | near >> _POINT | left >> _LAST | right << _LAST
            # only a strong point with a weak one beside it has anybody to make strong
            chosen = words[word] & (near << 1) & _STRONG
            while chosen:
                queue[last] = 8 * word + _first_point(chosen)
                last += 1
                chosen &= chosen - 1
        done = np.int64(0)
        while done < last:
            at = np.int64(queue[done])
            done += 1
            for middle in (at - stride, at, at + stride):
                for other in range(middle - 1, middle + 2):
                    weak = map_[other] & 1  # no branch to guess, here too
                    map_[other] += weak
                    queue[last] = other
                    last += weak
        count = np.int64(0)
        for v in range(margin, height - margin):
            first = (v + 1) * stride
            for word in range(first // 8, first // 8 + across):
                chosen = words[word] & _STRONG
                while chosen:
                    u = 8 * word - first - 1 + _first_point(chosen)
                    points[2 * count], points[2 * count + 1] = u, v
                    count += (u >= margin) & (u < width - margin)
                    chosen &= chosen - 1
        return int(count)

    return find
