"""Rays in the hand frame and their near-intersections (paper, 3.2)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tooltip_cli.method.types import Array, Indices, Mask, Rays

_ROWS_AT_A_TIME = 1 << 16
_PARALLEL = 1e-12


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
    rays: Rays, *, max_distance: float, z_start: float = 0.0
) -> tuple[Array, Indices]:
    """Hypothesise the intersection of every pair of rays that nearly meet.

    Args:
        max_distance: largest distance between the two rays, metres (paper: 0.0254).
        z_start: where a ray starts, metres from the optical centre ("the outer surface of the
            lens"; its value is not in the paper).

    Returns:
        (M, 3) midpoints x_m in metres and (M, 2) indices of their rays, ordered by pair.
        O(N^2) time; memory bounded by the result and a block of pairs.
    """
    first, second = np.triu_indices(len(rays), k=1)
    points, pairs = [np.zeros((0, 3))], [np.zeros((0, 2), dtype=np.intp)]
    for start in range(0, len(first), _ROWS_AT_A_TIME):
        i, j = first[start : start + _ROWS_AT_A_TIME], second[start : start + _ROWS_AT_A_TIME]
        o1, d1 = rays.origins[i], rays.directions[i]
        o2, d2 = rays.origins[j], rays.directions[j]
        a1, a2 = closest_points(o1, d1, o2, d2)
        p1, p2 = o1 + a1[:, None] * d1, o2 + a2[:, None] * d2
        gap = np.linalg.norm(p2 - p1, axis=1)
        near = (gap <= max_distance) & (a1 > z_start) & (a2 > z_start)
        points.append((p1[near] + p2[near]) / 2)
        pairs.append(np.stack([i[near], j[near]], axis=1))
    return np.concatenate(points), np.concatenate(pairs)


def plausible(points: Array, spheres: Array, max_range: float) -> Mask:
    """Return where the prior p(x_t) is not zero (paper, 3.2 and appendix B).

    Args:
        points: (M, 3) metres, hand frame.
        spheres: (S, 4) centre and radius of the hand's and wrist's spheres, metres.
        max_range: largest distance from the hand, metres (paper: 3).
    """
    keep = np.linalg.norm(points, axis=1) <= max_range
    for *center, radius in spheres:
        keep &= np.linalg.norm(points - np.array(center), axis=1) > radius
    return np.asarray(keep)


def angular_spread(directions: Array) -> float:
    """Return the largest angle between any two of (N, 3) unit vectors, radians."""
    if len(directions) < 2:
        return 0.0
    largest = 0.0
    for start in range(0, len(directions), 1024):
        cosines = directions[start : start + 1024] @ directions.T
        largest = max(largest, float(np.arccos(np.clip(cosines.min(), -1.0, 1.0))))
    return largest


def sphere_array(spheres: Sequence[tuple[Sequence[float], float]]) -> Array:
    """Return (S, 4) rows of centre and radius, metres, for spheres given as pairs."""
    rows = [[*center, radius] for center, radius in spheres]
    return np.array(rows, dtype=float).reshape(-1, 4)
