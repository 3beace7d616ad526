"""How regularly a stream's stamps follow one another: pure functions over arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tooltip_cli.log.sync import sorted_unique

Array = npt.NDArray[np.float64]
Stamps = npt.NDArray[np.int64]

_GAP = 1.75  # times the usual interval: a message is missing in between


@dataclass(frozen=True)
class Timing:
    """The stamps of one stream."""

    count: int
    first_ns: int
    last_ns: int
    rate_hz: float  # by the median interval; 0 for a single stamp
    jitter_s: float  # 95 % of the intervals lie this near to the median one
    gaps: int  # intervals in which at least one message is missing
    missing: int  # messages that the gaps would have held
    longest_gap_s: float  # longest interval, seconds
    duplicates: int  # stamps that occurred before
    reversals: int  # stamps earlier than the one before, in the order of the file

    @property
    def duration_s(self) -> float:
        """From the first stamp to the last, seconds."""
        return (self.last_ns - self.first_ns) / 1e9


def timing(stamps_ns: Stamps) -> Timing:
    """Describe stamps.

    Args:
        stamps_ns: (N,) in the order of the file, N at least 1.
    """
    order, reversals, duplicates = sorted_unique(stamps_ns)
    stamps = stamps_ns[order]
    intervals = np.diff(stamps)
    first, last = int(stamps[0]), int(stamps[-1])
    if not len(intervals):
        return Timing(len(stamps_ns), first, last, 0.0, 0.0, 0, 0, 0.0, duplicates, reversals)
    usual = float(np.median(intervals))
    gaps = intervals > _GAP * usual
    return Timing(
        count=len(stamps_ns),
        first_ns=first,
        last_ns=last,
        rate_hz=1e9 / usual,
        jitter_s=float(np.quantile(np.abs(intervals - usual), 0.95)) / 1e9,
        gaps=int(np.count_nonzero(gaps)),
        missing=int(np.sum(np.round(intervals[gaps] / usual) - 1)),
        longest_gap_s=int(intervals.max()) / 1e9,
        duplicates=duplicates,
        reversals=reversals,
    )


def nearest_s(stamps_ns: Stamps, query_ns: Stamps) -> Array:
    """Return (N,) distances in seconds from each query time to the nearest stamp.

    Args:
        stamps_ns: (M,) ascending, M at least 1.
    """
    after = np.clip(np.searchsorted(stamps_ns, query_ns), 0, len(stamps_ns) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.minimum(np.abs(stamps_ns[after] - query_ns), np.abs(stamps_ns[before] - query_ns))
    return np.asarray(nearest / 1e9)
