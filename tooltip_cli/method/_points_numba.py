"""The list of the points of an edge image, as machine code.

This module imports numba; `machine_code` imports it where there is something to compile.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np


def point_lister() -> Callable[..., int]:
    """Return the loop of `blocks.matchable_points`, to be compiled.

    Its arguments are the image, its rows and columns, the margin to leave out, and the u, v to
    fill, with room for all points within the margin. It returns how many there are.
    """

    def list_points(mask: Any, height: int, width: int, margin: int, points: Any) -> int:
        count = np.int64(0)
        for v in range(margin, height - margin):
            for u in range(margin, width - margin):
                # written always and counted if it is one: no branch to guess, a third of the time
                points[2 * count], points[2 * count + 1] = u, v
                count += mask[v * width + u] != 0
        return int(count)

    return list_points
