"""The near-intersections of pairs of rays as machine code.

This module imports numba; `machine_code` imports it where there is something to compile.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np


def intersector() -> Callable[..., int]:
    """Return the loop of `rays.intersections`, to be compiled.

    Its arguments are the (N, 3) origins and directions, the rays of ``count`` pairs, the largest
    distance between the two rays, where a ray starts, the square of the sine below which rays are
    parallel, and the points and rows of pairs to fill. It returns how many there are.
    """

    def intersect(
        origins: Any,
        directions: Any,
        first: Any,
        second: Any,
        count: int,
        max_distance: float,
        z_start: float,
        parallel: float,
        points: Any,
        rows: Any,
    ) -> int:
        found = np.int64(0)
        for row in range(count):
            i, j = 3 * np.int64(first[row]), 3 * np.int64(second[row])
            d1x, d1y, d1z = directions[i], directions[i + 1], directions[i + 2]
            d2x, d2y, d2z = directions[j], directions[j + 1], directions[j + 2]
            bx, by, bz = (
                origins[j] - origins[i],
                origins[j + 1] - origins[i + 1],
                origins[j + 2] - origins[i + 2],
            )
            cosine = d1x * d2x + d1y * d2y + d1z * d2z
            along_1 = bx * d1x + by * d1y + bz * d1z
            along_2 = bx * d2x + by * d2y + bz * d2z
            determinant = 1.0 - cosine * cosine
            if not determinant > parallel:
                continue
            a1 = (along_1 - cosine * along_2) / determinant
            a2 = (cosine * along_1 - along_2) / determinant
            p1x, p1y, p1z = (
                origins[i] + a1 * d1x,
                origins[i + 1] + a1 * d1y,
                origins[i + 2] + a1 * d1z,
            )
            p2x, p2y, p2z = (
                origins[j] + a2 * d2x,
                origins[j + 1] + a2 * d2y,
                origins[j + 2] + a2 * d2z,
            )
            gx, gy, gz = p2x - p1x, p2y - p1y, p2z - p1z
            gap = math.sqrt(gx * gx + gy * gy + gz * gz)
            if gap <= max_distance and a1 > z_start and a2 > z_start:
                points[3 * found] = (p1x + p2x) / 2
                points[3 * found + 1] = (p1y + p2y) / 2
                points[3 * found + 2] = (p1z + p2z) / 2
                rows[found] = row
                found += 1
        return int(found)

    return intersect
