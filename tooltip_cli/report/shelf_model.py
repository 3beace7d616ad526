"""What a report over a shelf says, as plain numbers: the content of ``shelf.json``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

SCHEMA = 1


@dataclass(frozen=True)
class Sample:
    """One recording of a shelf, as the report over all of them needs it."""

    name: str
    recording: str  # where it lies
    status: str  # ok, refused, or failed
    code: str | None = None  # of the first reason
    reason: str | None = None
    tool: str | None = None
    rig: str | None = None  # the file that was given
    rig_id: str | None = None  # the same for equal rigs, wherever they were stored
    recorded_s: float | None = None  # seconds since 1970 UTC
    error_px: float | None = None
    baseline_px: float | None = None
    tip_error_mm: float | None = None
    tip_m: tuple[float, float, float] | None = None  # hand frame
    seconds: float | None = None  # that it took


@dataclass(frozen=True)
class Spread:
    """How one number is distributed over recordings."""

    count: int
    mean: float
    low: float | None  # 95 % interval of the mean; None: of a single recording
    high: float | None
    median: float  # to 1 %
    p95: float  # to 1 %
    maximum: float


@dataclass(frozen=True)
class Drift:
    """How the error changes with time at equal tool and rig, percent in 30 days."""

    percent: float
    low: float  # 95 % interval
    high: float
    recordings: int

    @property
    def clear(self) -> bool:
        """Whether the interval leaves no doubt about its direction."""
        return self.low > 0 or self.high < 0


@dataclass(frozen=True)
class Counts:
    """Recordings by what became of them."""

    ok: int
    refused: int
    failed: int

    @property
    def all(self) -> int:
        """Recordings."""
        return self.ok + self.refused + self.failed


@dataclass(frozen=True)
class Group:
    """Recordings that have something in common."""

    name: str
    counts: Counts
    error_px: Spread | None
    baseline_px: Spread | None
    tip_error_mm: Spread | None
    scatter_mm: float | None  # RMS distance of their tips from the mean tip
    drift: Drift | None  # of error_px
    baseline_drift: Drift | None  # of baseline_px: clocks, camera and joints, not the detector


@dataclass(frozen=True)
class Period:
    """Recordings of one span of time."""

    start: str  # ISO 8601, UTC
    seconds: float  # its length
    counts: Counts
    error_px: float | None  # means
    baseline_px: float | None
    tip_error_mm: float | None


@dataclass(frozen=True)
class Case:
    """A recording worth a look."""

    name: str
    recording: str
    tool: str | None
    rig: str | None
    error_px: float
    baseline_px: float | None
    code: str | None  # what to keep in mind


@dataclass(frozen=True)
class Cause:
    """Why recordings have no estimate."""

    status: str
    code: str
    recordings: int
    examples: tuple[str, ...]  # names of the first
    reason: str  # of the first


@dataclass(frozen=True)
class ShelfReport:
    """Everything; tools and rigs with the largest mean error first."""

    schema: int
    version: str
    created: str
    source: str  # what was read
    overall: Group
    seconds: float  # of work, all recordings
    tools: tuple[Group, ...]
    rigs: tuple[Group, ...]
    periods: tuple[Period, ...]
    worst: tuple[Case, ...]
    causes: tuple[Cause, ...]
    histogram: Mapping[str, int]  # upper edge of a bin of error_px -> recordings
    left_out: Mapping[str, int]  # tools and rigs gathered under one name, by kind
