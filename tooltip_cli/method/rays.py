"""Rays in the hand frame and their near-intersections (paper, 3.2)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from tooltip_cli import machine_code
from tooltip_cli.method.types import Array, Indices, Mask, Rays

MAX_PAIRS = 2_000_000
"""All pairs of 2,000 rays."""

_ROWS_AT_A_TIME = 1 << 16
_PARALLEL = 1e-12
_MANY_DIRECTIONS = 2048  # of more the widest angle is taken among the outermost
_PROBES = 1024

Pairs = npt.NDArray[np.int32]
"""Indices of rays, which are fewer than the pairs of them by far."""


def rays_in_hand(frames: Indices, directions_camera: Array, hand_from_camera: Array) -> Rays:
    """Transform viewing directions into rays in the hand frame.

    Args:
        frames: (N,) image indices.
        directions_camera: (N, 3) unit vectors, optical frame.
        hand_from_camera: (N, 4, 4) T_c of each image.
    """
    directions = np.einsum("nij,nj->ni", hand_from_camera[:, :3, :3], directions_camera)
    return Rays(frames, hand_from_camera[:, :3, 3].copy(), directions)


def closest_points(
    origins_1: Array, directions_1: Array, origins_2: Array, directions_2: Array
) -> tuple[Array, Array]:
    """Return the parameters of the closest points of pairs of lines.

    Solves ``[d1, -d2] [a1, a2]^T = o2 - o1`` in the least-squares sense. (As printed in the paper
    the second column lacks its minus sign, which negates the second parameter.)

    Args:
        origins_1: (..., 3) metres; likewise the others, directions as unit vectors.

    Returns:
        (...,) distances along each line, metres; NaN for parallel lines.
    """
    between = origins_2 - origins_1
    cosine = (directions_1 * directions_2).sum(axis=-1)
    along_1 = (between * directions_1).sum(axis=-1)
    along_2 = (between * directions_2).sum(axis=-1)
    determinant = 1.0 - cosine * cosine
    safe = np.where(determinant > _PARALLEL, determinant, np.nan)
    return (along_1 - cosine * along_2) / safe, (cosine * along_1 - along_2) / safe


def intersections(
    rays: Rays,
    *,
    max_distance: float,
    z_start: float = 0.0,
    max_pairs: int = MAX_PAIRS,
    seed: int = 0,
    use_numba: bool | None = None,
) -> tuple[Array, Pairs]:
    """Hypothesise the intersection of every pair of rays that nearly meet.

    Args:
        max_distance: largest distance between the two rays, metres (paper: 0.0254).
        z_start: where a ray starts, metres from the optical centre ("the outer surface of the
            lens"; its value is not in the paper).
        max_pairs: where there are more pairs, so many drawn at random are looked at.
        seed: of the draw.
        use_numba: whether to run the compiled form; None takes it where there is one. Both forms
            give exactly the same.

    Returns:
        (M, 3) midpoints x_m in metres and (M, 2) indices of their rays, ordered by pair.
        O(min(N^2, max_pairs)) time and memory.
    """
    first, second = pairs_of(len(rays), max_pairs, seed)
    points, rows = meeting_points(
        rays, first, second, max_distance=max_distance, z_start=z_start, use_numba=use_numba
    )
    return points, np.stack([first[rows], second[rows]], axis=1)


def meeting_points(
    rays: Rays,
    first: Pairs,
    second: Pairs,
    *,
    max_distance: float,
    z_start: float,
    use_numba: bool | None = None,
) -> tuple[Array, Pairs]:
    """Hypothesise the intersection of those pairs that nearly meet.

    Args are those of `intersections`, and (P,) ``first`` and ``second``, the pairs.

    Returns:
        (M, 3) midpoints in metres and (M,) which of the pairs they are of, ascending.
    """
    return machine_code.fast_or_slow(
        lambda: _intersect_compiled(rays, first, second, max_distance, z_start),
        lambda: _intersect_numpy(rays, first, second, max_distance, z_start),
        use_numba,
    )


def pairs_of(count: int, most: int, seed: int) -> tuple[Pairs, Pairs]:
    """Return (P,) and (P,) the rays of all pairs, the lower one first, or of a sample of them."""
    total = count * (count - 1) // 2
    if total <= most:
        rows = np.arange(count, dtype=np.int32)
        first = np.repeat(rows, rows[::-1])
        # in its row a pair stands as many places to the right as come before the row
        before = np.cumsum(rows[::-1], dtype=np.int32) - rows[::-1]
        second = np.arange(total, dtype=np.int32)
        second += np.repeat(rows + 1 - before, rows[::-1])
        return first, second
    rng = np.random.default_rng(seed)
    one = rng.integers(count, size=most, dtype=np.int32)
    other = rng.integers(count - 1, size=most, dtype=np.int32)
    other += other >= one  # any but the one
    first = np.minimum(one, other)
    return first, np.maximum(one, other, out=other)


def _intersect_compiled(
    rays: Rays, first: Pairs, second: Pairs, max_distance: float, z_start: float
) -> tuple[Array, npt.NDArray[np.int32]]:
    intersect = machine_code.kernel(
        "tooltip_cli.method._rays_numba",
        "intersector",
        "f64* f64* i32* i32* i64 f64 f64 f64 f64* i32*",
    )
    points, rows = np.empty((len(first), 3)), np.empty(len(first), np.int32)
    found = intersect(
        np.ascontiguousarray(rays.origins, np.float64),
        np.ascontiguousarray(rays.directions, np.float64),
        first,
        second,
        len(first),
        max_distance,
        z_start,
        _PARALLEL,
        points,
        rows,
    )
    return points[:found], rows[:found]


def _intersect_numpy(
    rays: Rays, first: Pairs, second: Pairs, max_distance: float, z_start: float
) -> tuple[Array, npt.NDArray[np.int32]]:
    points, rows = [np.zeros((0, 3))], [np.zeros(0, np.int32)]
    for start in range(0, len(first), _ROWS_AT_A_TIME):
        i, j = first[start : start + _ROWS_AT_A_TIME], second[start : start + _ROWS_AT_A_TIME]
        o1, d1 = rays.origins[i], rays.directions[i]
        o2, d2 = rays.origins[j], rays.directions[j]
        a1, a2 = closest_points(o1, d1, o2, d2)
        p1, p2 = o1 + a1[:, None] * d1, o2 + a2[:, None] * d2
        gap = np.linalg.norm(p2 - p1, axis=1)
        near = (gap <= max_distance) & (a1 > z_start) & (a2 > z_start)
        points.append((p1[near] + p2[near]) / 2)
        rows.append((start + np.flatnonzero(near)).astype(np.int32))
    return np.concatenate(points), np.concatenate(rows)


def plausible(points: Array, spheres: Array, max_range: float) -> Mask:
    """Return where the prior p(x_t) is not zero (paper, 3.2 and appendix B).

    Args:
        points: (M, 3) metres, hand frame.
        spheres: (S, 4) centre and radius of the hand's and wrist's spheres, metres.
        max_range: largest distance from the hand, metres (paper: 3).
    """
    keep = np.empty(len(points), dtype=bool)
    for start in range(0, len(points), _ROWS_AT_A_TIME):
        block = points[start : start + _ROWS_AT_A_TIME]
        inside = np.linalg.norm(block, axis=1) <= max_range
        for *center, radius in spheres:
            inside &= np.linalg.norm(block - np.array(center), axis=1) > radius
        keep[start : start + _ROWS_AT_A_TIME] = inside
    return keep


def angular_spread(directions: Array) -> float:
    """Return the largest angle between any two of (N, 3) unit vectors, radians.

    Of more than 2,048 the outermost along 1,024 axes are compared: of two unit vectors that lie
    furthest apart, each is the outermost along their difference. The widest of these falls short
    of the widest of all by less than a hundredth, because no axis is further than 4 degrees from
    any direction.
    """
    if len(directions) > _MANY_DIRECTIONS:
        directions = directions[_outermost(directions)]
    if len(directions) < 2:
        return 0.0
    return float(np.arccos(np.clip((directions @ directions.T).min(), -1.0, 1.0)))


def _outermost(directions: Array) -> Indices:
    """Return the rows that lie outermost along axes spread over a half of the sphere."""
    steps = np.arange(_PROBES) + 0.5
    z, turn = steps / _PROBES, steps * np.pi * (3.0 - np.sqrt(5.0))  # a Fibonacci lattice
    radius = np.sqrt(1.0 - z * z)
    axes = np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)
    rows = []
    for start in range(0, _PROBES, 16):  # bounds the products to a few megabytes
        along = directions @ axes[start : start + 16].T
        rows += [along.argmin(axis=0), along.argmax(axis=0)]
    return np.unique(np.concatenate(rows))


def sphere_array(spheres: Sequence[tuple[Sequence[float], float]]) -> Array:
    """Return (S, 4) rows of centre and radius, metres, for spheres given as pairs."""
    rows = [[*center, radius] for center, radius in spheres]
    return np.array(rows, dtype=float).reshape(-1, 4)
