"""Matching streams in time: pure functions over arrays of stamps."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Stamps = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]


def sorted_unique(stamps_ns: Stamps) -> tuple[npt.NDArray[np.intp], int, int]:
    """Return the order that sorts stamps and keeps the first of equal ones.

    Returns:
        Indices into ``stamps_ns``, the number of reversals in the given order and the number of
        duplicates left out.
    """
    reversals = int(np.count_nonzero(np.diff(stamps_ns) < 0))
    order = np.argsort(stamps_ns, kind="stable")
    first = np.ones(len(order), dtype=bool)
    first[1:] = np.diff(stamps_ns[order]) != 0
    kept = order[first]
    return kept, reversals, len(order) - len(kept)


def bracket(
    stamps_ns: Stamps, query_ns: Stamps, max_gap_ns: int
) -> tuple[npt.NDArray[np.intp], Array, Mask]:
    """Find the samples around each query time.

    Args:
        stamps_ns: (M,) strictly increasing.
        query_ns: (N,) in any order.
        max_gap_ns: largest distance between the two samples that may be bridged.

    Returns:
        (N,) index of the sample before, (N,) fraction of the way to the next in [0, 1], and
        (N,) whether the query lies within the stream and within a gap that may be bridged.
    """
    count = len(stamps_ns)
    if count == 0:
        none = np.zeros(len(query_ns), dtype=np.intp)
        return none, np.zeros(len(query_ns)), np.zeros(len(query_ns), dtype=bool)
    before = np.clip(np.searchsorted(stamps_ns, query_ns, side="right") - 1, 0, max(count - 2, 0))
    after = np.minimum(before + 1, count - 1)
    # integer differences first: float64 cannot hold a time of day to the nanosecond
    gap = stamps_ns[after] - stamps_ns[before]
    since = query_ns - stamps_ns[before]
    fraction = since / np.where(gap > 0, gap, 1)
    exact = (since == 0) | (since == gap)
    valid = (since >= 0) & (since <= gap) & (exact | (gap <= max_gap_ns))
    return before, np.where(valid, fraction, 0.0), valid


def interpolate(stamps_ns: Stamps, values: Array, query_ns: Stamps, max_gap_ns: int) -> Array:
    """Interpolate samples linearly at query times.

    Args:
        stamps_ns: (M,) strictly increasing.
        values: (M, ...) samples, e.g. joint positions in rad.

    Returns:
        (N, ...) values; NaN outside the stream and inside gaps longer than ``max_gap_ns``.
    """
    before, fraction, valid = bracket(stamps_ns, query_ns, max_gap_ns)
    result = np.full((len(query_ns), *values.shape[1:]), np.nan)
    if valid.any():
        low = before[valid]
        high = np.minimum(low + 1, len(stamps_ns) - 1)
        weight = fraction[valid].reshape(-1, *(1,) * (values.ndim - 1))
        # a NaN neighbour with no weight must not spoil an exact hit
        high = np.where(fraction[valid] == 0, low, high)
        low = np.where(fraction[valid] == 1, high, low)
        result[valid] = values[low] + weight * (values[high] - values[low])
    return result


def interpolate_poses(
    stamps_ns: Stamps,
    positions: Array,
    quaternions: Array,
    query_ns: Stamps,
    max_gap_ns: int,
) -> tuple[Array, Array]:
    """Interpolate poses at query times: positions linearly, rotations along the great arc.

    Args:
        stamps_ns: (M,) strictly increasing.
        positions: (M, 3) metres.
        quaternions: (M, 4) unit quaternions (x, y, z, w), either sign.

    Returns:
        (N, 3) positions and (N, 4) unit quaternions; NaN as in :func:`interpolate`.
    """
    before, fraction, valid = bracket(stamps_ns, query_ns, max_gap_ns)
    rotations = np.full((len(query_ns), 4), np.nan)
    if valid.any():
        low = before[valid]
        high = np.minimum(low + 1, len(stamps_ns) - 1)
        first, second = quaternions[low], quaternions[high]
        cosine = np.einsum("ij,ij->i", first, second)
        second = np.where(cosine[:, None] < 0, -second, second)
        angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
        t, sine = fraction[valid], np.sin(angle)
        small = sine < 1e-9
        safe = np.where(small, 1.0, sine)
        first_weight = np.where(small, 1 - t, np.sin((1 - t) * angle) / safe)
        second_weight = np.where(small, t, np.sin(t * angle) / safe)
        mixed = first_weight[:, None] * first + second_weight[:, None] * second
        rotations[valid] = mixed / np.linalg.norm(mixed, axis=1, keepdims=True)
    return interpolate(stamps_ns, positions, query_ns, max_gap_ns), rotations
