"""All recordings together, gathered one after the other in constant memory."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field

import numpy as np

from tooltip_cli.method.evaluation import ErrorSummary, MeanInterval
from tooltip_cli.method.types import Array
from tooltip_cli.report.model import FrameTable, Histogram, Overall, RecordingReport

BIN_PX = 1.0
_BINS = 4096  # wider than any image's diagonal that matters; the last bin takes what is farther


@dataclass
class MeanOfTools:
    """The mean over tools of their mean errors, each tool's frames resampled for the interval."""

    means: list[float] = field(default_factory=list)
    _interval: MeanInterval = field(default_factory=MeanInterval)

    def add(self, errors: Array, name: str) -> None:
        """Add one tool by its frames' errors, in the order of the frames.

        Tools are drawn independently of one another, each by its name, whatever their order.
        """
        finite = errors[np.isfinite(errors)]
        if not len(finite):
            return
        self.means.append(float(finite.mean()))
        self._interval.add(finite, zlib.crc32(name.encode()))

    def summary(self) -> ErrorSummary | None:
        """Return statistics over the tools; the interval is that of the mean over these tools."""
        if not self.means:
            return None
        values = np.array(self.means)
        low, high = self._interval.interval() or (None, None)
        return ErrorSummary(
            len(values),
            float(values.mean()),
            float(np.median(values)),
            float(np.sqrt(np.square(values).mean())),
            float(np.percentile(values, 95)),
            float(values.max()),
            low,
            high,
        )


class Totals:
    """Adds recordings up as they come."""

    def __init__(self) -> None:
        self._status = {"ok": 0, "refused": 0, "failed": 0}
        self._detector, self._baseline = MeanOfTools(), MeanOfTools()
        self._millimetres: list[float] = []
        self._counts = np.zeros(_BINS, dtype=np.int64)

    def add(self, row: RecordingReport, table: FrameTable | None) -> None:
        """Add one recording; ``table`` is None where it failed."""
        self._status[row.status] += 1
        if table is None:
            return
        errors = table.detection_error_px
        index = (errors[np.isfinite(errors)] / BIN_PX).astype(int)
        np.add.at(self._counts, np.minimum(index, _BINS - 1), 1)
        if row.detector and row.detector.tip_error_mm is not None:
            self._millimetres.append(row.detector.tip_error_mm)
        if row.detector and row.baseline and row.detector.error_px and row.baseline.error_px:
            self._detector.add(table.prediction_error_px, row.name)
            self._baseline.add(table.baseline_error_px, row.name)

    def overall(self) -> Overall:
        """Return the sums."""
        used = np.flatnonzero(self._counts)
        counts = self._counts[: used[-1] + 1] if len(used) else self._counts[:0]
        return Overall(
            recordings=sum(self._status.values()),
            **self._status,
            compared=len(self._detector.means),
            detector_px=self._detector.summary(),
            baseline_px=self._baseline.summary(),
            tip_error_mm=_over_tools(self._millimetres),
            histogram=Histogram(BIN_PX, tuple(map(int, counts)), int(counts.sum())),
        )


def _over_tools(values: list[float]) -> ErrorSummary | None:
    gathered = MeanOfTools()
    for value in values:
        gathered.add(np.array([value]), "")
    return gathered.summary()
