"""A shelf gathered recording by recording, in memory that does not grow with their number."""

from __future__ import annotations

import datetime
import heapq
import math
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from tooltip_cli.report.shelf_model import (
    SCHEMA,
    Case,
    Cause,
    Counts,
    Drift,
    Group,
    Period,
    Sample,
    ShelfReport,
    Spread,
)

OTHERS = "(others)"
NO_TOOL, NO_RIG = "(not named)", "(not known)"
MOST_GROUPS = 500  # tools or rigs told apart; what comes later is gathered
MOST_WORST = 30
_MOST_CAUSES = 100
_EXAMPLES = 3
_MOST_PERIODS = 60
_DAY_S = 86400
_SPANS_S = (60, 600, 3600, 6 * 3600, _DAY_S, 7 * _DAY_S, 28 * _DAY_S, 364 * _DAY_S, 3640 * _DAY_S)
"""Lengths of a period; each is a multiple of the one before, so that periods can be joined."""
_GROWTH = 1.02  # from one bin to the next: quantiles are right to 1 %
_FEWEST = 12  # recordings behind a statement about drift
_Z95 = 1.959964


@dataclass
class _Numbers:
    """Mean, spread and quantiles of positive numbers.

    Quantiles come from bins of equal ratio, as in DDSketch (Masson, Rim, Lee: DDSketch, VLDB 2019).
    """

    count: int = 0
    mean: float = 0.0
    maximum: float = -math.inf
    bins: Counter[int] = field(default_factory=Counter)
    _square: float = 0.0  # sum of squared distances from the mean (Welford)

    def add(self, value: float | None) -> None:
        if value is None or not math.isfinite(value):
            return
        self.count += 1
        step = value - self.mean
        self.mean += step / self.count
        self._square += step * (value - self.mean)
        self.maximum = max(self.maximum, value)
        self.bins[bin_of(value)] += 1

    def spread(self) -> Spread | None:
        if not self.count:
            return None
        half = None
        if self.count > 1:
            half = _Z95 * math.sqrt(self._square / (self.count - 1) / self.count)
        return Spread(
            self.count,
            self.mean,
            None if half is None else self.mean - half,
            None if half is None else self.mean + half,
            self._quantile(0.5),
            self._quantile(0.95),
            self.maximum,
        )

    def _quantile(self, share: float) -> float:
        left = share * (self.count - 1)
        for number in sorted(self.bins):
            left -= self.bins[number]
            if left < 0:
                return min(middle_of(number), self.maximum)
        return self.maximum


def bin_of(value: float) -> int:
    """Return the bin of a number; all below a thousandth are one."""
    return math.ceil(math.log(max(value, 1e-3)) / math.log(_GROWTH))


def middle_of(number: int) -> float:
    """Return the number that is at most 1 % from all of a bin."""
    return 2 * _GROWTH**number / (1 + _GROWTH)


@dataclass
class _Line:
    """Sums for a straight line through points that come one by one."""

    count: int = 0
    _x: float = 0.0
    _y: float = 0.0
    sxx: float = 0.0
    sxy: float = 0.0
    syy: float = 0.0

    def add(self, x: float, y: float) -> None:
        self.count += 1
        dx, dy = x - self._x, y - self._y
        self._x += dx / self.count
        self._y += dy / self.count
        self.sxx += dx * (x - self._x)
        self.sxy += dx * (y - self._y)
        self.syy += dy * (y - self._y)


def drift_of(lines: Iterable[_Line]) -> Drift | None:
    """Return the slope that several lines share, each with a level of its own.

    x is days, y the logarithm of the error: a change in percent, on which single large errors weigh
    little. None where there are too few recordings, or all of one moment.
    """
    some = [line for line in lines if line.count > 1]
    count = sum(line.count for line in some)
    sxx = sum(line.sxx for line in some)
    free = count - len(some) - 1
    if count < _FEWEST or free < 1 or sxx <= 1e-9:
        return None
    from scipy.special import stdtrit

    sxy = sum(line.sxy for line in some)
    slope = sxy / sxx
    rest = max(sum(line.syy for line in some) - slope * sxy, 0.0)
    half = float(stdtrit(free, 0.975)) * math.sqrt(rest / free / sxx)
    percent, low, high = (
        100 * math.expm1(min(max(30 * value, -50.0), 50.0))
        for value in (slope, slope - half, slope + half)
    )
    return Drift(percent, low, high, count)


@dataclass
class _Tips:
    """The mean of positions and their distance from it (Welford)."""

    count: int = 0
    _mean: np.ndarray[tuple[int], np.dtype[np.float64]] = field(default_factory=lambda: np.zeros(3))
    _square: float = 0.0

    def add(self, tip_m: tuple[float, float, float]) -> None:
        self.count += 1
        step = np.array(tip_m) - self._mean
        self._mean += step / self.count
        self._square += float(step @ (np.array(tip_m) - self._mean))

    def scatter_mm(self) -> float | None:
        if self.count < 2:
            return None
        return 1000 * math.sqrt(max(self._square, 0.0) / self.count)


@dataclass
class _Gathered:
    """What is known of some recordings."""

    status: Counter[str] = field(default_factory=Counter)
    error: _Numbers = field(default_factory=_Numbers)
    baseline: _Numbers = field(default_factory=_Numbers)
    tip: _Numbers = field(default_factory=_Numbers)
    tips: _Tips = field(default_factory=_Tips)

    def add(self, sample: Sample) -> None:
        self.status[sample.status] += 1
        self.error.add(sample.error_px)
        self.baseline.add(sample.baseline_px)
        self.tip.add(sample.tip_error_mm)
        if sample.tip_m is not None:
            self.tips.add(sample.tip_m)

    def group(self, name: str, drift: Drift | None, baseline_drift: Drift | None) -> Group:
        return Group(
            name,
            _counts(self.status),
            self.error.spread(),
            self.baseline.spread(),
            self.tip.spread(),
            self.tips.scatter_mm(),
            drift,
            baseline_drift,
        )


def _counts(status: Counter[str]) -> Counts:
    return Counts(status["ok"], status["refused"], status["failed"])


@dataclass
class _Span:
    """Sums of one period."""

    status: Counter[str] = field(default_factory=Counter)
    error: list[float] = field(default_factory=lambda: [0.0, 0.0])  # sum, count
    baseline: list[float] = field(default_factory=lambda: [0.0, 0.0])
    tip: list[float] = field(default_factory=lambda: [0.0, 0.0])

    def add(self, sample: Sample) -> None:
        self.status[sample.status] += 1
        for sums, value in (
            (self.error, sample.error_px),
            (self.baseline, sample.baseline_px),
            (self.tip, sample.tip_error_mm),
        ):
            if value is not None and math.isfinite(value):
                sums[0] += value
                sums[1] += 1

    def join(self, other: _Span) -> None:
        self.status += other.status
        for ours, theirs in (
            (self.error, other.error),
            (self.baseline, other.baseline),
            (self.tip, other.tip),
        ):
            ours[0] += theirs[0]
            ours[1] += theirs[1]


class _Timeline:
    """Periods of equal length, as short as their number allows."""

    def __init__(self) -> None:
        self._length = 0  # index of the length
        self._spans: dict[int, _Span] = {}

    def add(self, sample: Sample) -> None:
        if sample.recorded_s is None:
            return
        number = math.floor(sample.recorded_s / _SPANS_S[self._length])
        self._spans.setdefault(number, _Span()).add(sample)
        while len(self._spans) > _MOST_PERIODS and self._length + 1 < len(_SPANS_S):
            self._lengthen()

    def _lengthen(self) -> None:
        ratio = _SPANS_S[self._length + 1] // _SPANS_S[self._length]
        joined: dict[int, _Span] = {}
        for number, span in self._spans.items():
            joined.setdefault(number // ratio, _Span()).join(span)
        self._spans, self._length = joined, self._length + 1

    def periods(self) -> tuple[Period, ...]:
        length = _SPANS_S[self._length]
        return tuple(
            Period(
                _moment(number * length),
                float(length),
                _counts(span.status),
                *(
                    sums[0] / sums[1] if sums[1] else None
                    for sums in (span.error, span.baseline, span.tip)
                ),
            )
            for number, span in sorted(self._spans.items())
        )


def _moment(seconds: float) -> str:
    moment = datetime.datetime.fromtimestamp(seconds, datetime.timezone.utc)
    return moment.isoformat(timespec="seconds")


class ShelfTotals:
    """Takes recordings one by one, in the order of the shelf; keeps none of them."""

    def __init__(self) -> None:
        self._all = _Gathered()
        self._tools: dict[str, _Gathered] = {}
        self._rigs: dict[str, _Gathered] = {}
        self._rig_names: dict[str, str] = {}
        self._lines: dict[tuple[str, str], tuple[_Line, _Line]] = {}
        self._left_out: Counter[str] = Counter()
        self._timeline = _Timeline()
        self._worst: list[tuple[float, int, Case]] = []
        self._causes: dict[tuple[str, str], list[str]] = {}
        self._cause_counts: Counter[tuple[str, str]] = Counter()
        self._reasons: dict[tuple[str, str], str] = {}
        self._seconds = 0.0
        self._origin_s: float | None = None

    def add(self, sample: Sample) -> None:
        """Take one recording into account."""
        self._all.add(sample)
        self._seconds += sample.seconds or 0.0
        tool = self._gather(self._tools, "tools", sample.tool or NO_TOOL, sample)
        rig = self._gather(self._rigs, "rigs", sample.rig_id or sample.rig or NO_RIG, sample)
        if rig not in self._rig_names:
            stored = rig if rig in (OTHERS, NO_RIG) else f"stored {rig}"
            self._rig_names[rig] = stored if sample.rig is None or rig == OTHERS else sample.rig
        self._timeline.add(sample)
        self._follow(tool, rig, sample)
        if sample.error_px is not None and math.isfinite(sample.error_px):
            self._compare(sample, sample.error_px)
        if sample.status != "ok":
            self._explain(sample)

    def _gather(self, groups: dict[str, _Gathered], kind: str, name: str, sample: Sample) -> str:
        if name not in groups and len(groups) >= MOST_GROUPS:
            self._left_out[kind] += 1
            name = OTHERS
        groups.setdefault(name, _Gathered()).add(sample)
        return name

    def _follow(self, tool: str, rig: str, sample: Sample) -> None:
        if sample.recorded_s is None:
            return
        if self._origin_s is None:
            self._origin_s = sample.recorded_s
        if (tool, rig) not in self._lines and len(self._lines) >= MOST_GROUPS**2 // 50:
            return
        days = (sample.recorded_s - self._origin_s) / _DAY_S
        lines = self._lines.setdefault((tool, rig), (_Line(), _Line()))
        for line, value in zip(lines, (sample.error_px, sample.baseline_px), strict=True):
            if value is not None and math.isfinite(value):
                line.add(days, math.log(max(value, 1e-3)))

    def _compare(self, sample: Sample, error_px: float) -> None:
        case = Case(
            sample.name,
            sample.recording,
            sample.tool,
            sample.rig or sample.rig_id,
            error_px,
            sample.baseline_px,
            sample.code,
        )
        heapq.heappush(self._worst, (error_px, -self._all.error.count, case))
        if len(self._worst) > MOST_WORST:
            heapq.heappop(self._worst)

    def _explain(self, sample: Sample) -> None:
        key = (sample.status, sample.code or sample.status)
        if key not in self._causes and len(self._causes) >= _MOST_CAUSES:
            key = (sample.status, OTHERS)
        self._cause_counts[key] += 1
        examples = self._causes.setdefault(key, [])
        if len(examples) < _EXAMPLES:
            examples.append(sample.name)
        self._reasons.setdefault(key, sample.reason or "")

    def report(self, source: str, version: str, created: str) -> ShelfReport:
        """Return what was gathered so far."""
        error, baseline = ([lines[i] for lines in self._lines.values()] for i in (0, 1))
        return ShelfReport(
            SCHEMA,
            version,
            created,
            source,
            self._all.group("all", drift_of(error), drift_of(baseline)),
            self._seconds,
            self._groups(self._tools, lambda key: key[0], str),
            self._groups(self._rigs, lambda key: key[1], lambda rig: self._rig_names[rig]),
            self._timeline.periods(),
            tuple(case for _, _, case in sorted(self._worst, key=lambda item: item[:2])[::-1]),
            tuple(
                Cause(*key, count, tuple(self._causes[key]), self._reasons[key])
                for key, count in self._cause_counts.most_common()
            ),
            self._histogram(),
            dict(self._left_out),
        )

    def _groups(
        self,
        groups: dict[str, _Gathered],
        of: Callable[[tuple[str, str]], str],
        called: Callable[[str], str],
    ) -> tuple[Group, ...]:
        by_name: dict[str, list[tuple[_Line, _Line]]] = {}
        for key, pair in self._lines.items():
            by_name.setdefault(of(key), []).append(pair)
        found = []
        for name, gathered in groups.items():
            pairs = by_name.get(name, [])
            drift, baseline_drift = (drift_of(pair[i] for pair in pairs) for i in (0, 1))
            found.append(gathered.group(called(name), drift, baseline_drift))
        return tuple(sorted(found, key=_severity))

    def _histogram(self) -> dict[str, int]:
        """Return the errors in bins of a quarter octave."""
        wide: Counter[float] = Counter()
        for number, count in self._all.error.bins.items():
            quarter = math.ceil(4 * math.log2(middle_of(number)))
            wide[2 ** (quarter / 4)] += count
        return {f"{edge:.4g}": wide[edge] for edge in sorted(wide)}


def _severity(group: Group) -> tuple[float, str]:
    return (math.inf if group.error_px is None else -group.error_px.mean, group.name)
