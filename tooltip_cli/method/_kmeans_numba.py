"""Lloyd's algorithm as machine code.

This module imports numba; `machine_code` imports it where there is something to compile.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

_BLOCK = 512  # points whose distances to all means stay close to the processor


def clusterer(dimensions: int) -> Callable[..., int]:
    """Return `kmeans.lloyd` for points of so many coordinates, to be compiled.

    Its arguments are the points, one coordinate after the other; the number of points, of means and
    of iterations at most; the means, which are moved, one after the other; the (M,) labels to fill,
    which must be -1; and scratch space: a block of distances, (K,) sizes and the means' sums. It
    returns the number of iterations.
    """

    def cluster(
        points: Any,
        count: int,
        k: int,
        iterations: int,
        means: Any,
        labels: Any,
        least: Any,
        chosen: Any,
        sizes: Any,
        sums: Any,
    ) -> int:
        for iteration in range(iterations + 1):
            changed = 0
            for c in range(k):
                sizes[c] = 0
                for d in range(dimensions):
                    sums[dimensions * c + d] = 0.0
            for start in range(0, count, _BLOCK):
                size = min(_BLOCK, count - start)
                for i in range(size):
                    least[i], chosen[i] = math.inf, 0
                for c in range(k):
                    for i in range(size):
                        squared = 0.0
                        for d in range(dimensions):
                            offset = points[d * count + start + i] - means[dimensions * c + d]
                            squared += offset * offset
                        nearer = squared < least[i]
                        least[i] = squared if nearer else least[i]
                        chosen[i] = c if nearer else chosen[i]
                for i in range(size):
                    label = chosen[i]
                    changed += label != labels[start + i]
                    labels[start + i] = label
                    sizes[label] += 1
                    for d in range(dimensions):
                        sums[dimensions * label + d] += points[d * count + start + i]
            if changed == 0 or iteration == iterations:
                return iteration
            for c in range(k):
                if sizes[c] > 0:
                    for d in range(dimensions):
                        means[dimensions * c + d] = sums[dimensions * c + d] / sizes[c]
        return iterations

    return cluster
