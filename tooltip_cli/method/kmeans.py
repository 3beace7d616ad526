"""K-means clustering of points (Lloyd's algorithm), independent of the points' order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tooltip_cli import machine_code
from tooltip_cli.method.types import Array, Indices

_SEEDING_SAMPLE = 2048  # at least
_SEEDING_SHARE = 40  # of more than 40 * 2048 points, one in 40
_SEEDING_RUNS = 8
_MAX_ITERATIONS = 300
_BLOCK = 1 << 16


@dataclass(frozen=True)
class Clusters:
    """The result of K-means, clusters in order of falling size."""

    means: Array  # (K, 3)
    labels: Indices  # (M,) cluster of each point, in the points' own order
    sizes: Indices  # (K,) members

    @property
    def largest(self) -> Array:
        """(3,) the mean with the most members (paper, 3.2)."""
        mean: Array = self.means[0]
        return mean


def kmeans(points: Array, k: int, seed: int) -> Clusters:
    """Cluster points around ``k`` means.

    The paper does not say how the means start: here, the best of eight seeded k-means++ runs on a
    sample. Points are sorted first, so that their order changes nothing, not even a bit.

    Args:
        points: (M, D); M of at least one.
        k: number of means; at most M are used.

    Returns:
        Clusters; ties in size are ordered by the mean's coordinates.
    """
    order = np.lexsort(points.T[::-1])
    ordered = points[order]
    rng = np.random.default_rng(seed)
    k = min(k, len(points))
    sample = ordered
    wanted = max(_SEEDING_SAMPLE, len(ordered) // _SEEDING_SHARE)
    if len(ordered) > wanted:
        sample = ordered[np.sort(rng.choice(len(ordered), wanted, replace=False))]
    runs = [lloyd(sample, _plus_plus(sample, k, rng)) for _ in range(_SEEDING_RUNS)]
    start = min(runs, key=lambda run: _inertia(sample, *run))[0]
    means, labels = lloyd(ordered, start)
    sizes = np.bincount(labels, minlength=len(means))
    rank = np.lexsort((*means.T[::-1], -sizes))
    position = np.empty_like(rank)
    position[rank] = np.arange(len(rank))
    unordered = np.empty_like(labels)
    unordered[order] = position[labels]
    return Clusters(means[rank], unordered, sizes[rank].astype(np.intp))


def lloyd(points: Array, means: Array, use_numba: bool | None = None) -> tuple[Array, Indices]:
    """Iterate assignment and mean until nothing changes; a mean that loses all stays put.

    Args:
        points: (M, D).
        means: (K, D) where to start.
        use_numba: whether to run the compiled form; None takes it where there is one. Both forms
            give exactly the same.

    Returns:
        (K, D) means and (M,) labels.
    """
    return machine_code.fast_or_slow(
        lambda: _lloyd_compiled(points, means), lambda: _lloyd_numpy(points, means), use_numba
    )


def _lloyd_compiled(points: Array, means: Array) -> tuple[Array, Indices]:
    count, dimensions = points.shape
    cluster = machine_code.kernel(
        "tooltip_cli.method._kmeans_numba",
        "clusterer",
        "f64* i64 i64 i64 f64* i64* f64* i64* i64* f64*",
        dimensions,
    )
    moved, labels = np.array(means, np.float64), np.full(count, -1, np.int64)
    cluster(
        np.ascontiguousarray(points.T, np.float64),
        count,
        len(means),
        _MAX_ITERATIONS,
        moved,
        labels,
        np.empty(512),
        np.empty(512, np.int64),
        np.empty(len(means), np.int64),
        np.empty(means.shape),
    )
    return moved, labels.astype(np.intp, copy=False)


def _lloyd_numpy(points: Array, means: Array) -> tuple[Array, Indices]:
    labels = nearest(points, means)
    for _ in range(_MAX_ITERATIONS):
        sizes = np.bincount(labels, minlength=len(means))
        sums = np.stack(
            [np.bincount(labels, weights=axis, minlength=len(means)) for axis in points.T], axis=1
        )
        means = np.where(sizes[:, None] > 0, sums / np.maximum(sizes, 1)[:, None], means)
        updated = nearest(points, means)
        if np.array_equal(updated, labels):
            break
        labels = updated
    return means, labels


def nearest(points: Array, means: Array) -> Indices:
    """Return (M,) the index of the nearest of (K, D) means; the first of equals."""
    labels = np.empty(len(points), dtype=np.intp)
    for start in range(0, len(points), _BLOCK):
        block = points[start : start + _BLOCK]
        distances = [np.square(block - mean).sum(axis=1) for mean in means]
        labels[start : start + _BLOCK] = np.argmin(distances, axis=0)
    return labels


def _plus_plus(points: Array, k: int, rng: np.random.Generator) -> Array:
    """Draw starting means far from one another (k-means++)."""
    means = [points[rng.integers(len(points))]]
    squared = np.square(points - means[0]).sum(axis=1)
    while len(means) < k:
        total = squared.sum()
        if total == 0:  # fewer distinct points than means
            break
        chosen = np.searchsorted(np.cumsum(squared), rng.random() * total)
        means.append(points[min(int(chosen), len(points) - 1)])
        squared = np.minimum(squared, np.square(points - means[-1]).sum(axis=1))
    return np.array(means)


def _inertia(points: Array, means: Array, labels: Indices) -> float:
    return float(np.square(points - means[labels]).sum())
