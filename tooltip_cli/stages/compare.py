"""Comparing reports: did a parameter, a calibration or a method make the estimates better?"""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tooltip_cli.errors import TooltipError
from tooltip_cli.method.types import Array
from tooltip_cli.report.model import SCHEMA, EvaluationReport, RecordingReport, from_plain
from tooltip_cli.report.overall import MeanOfTools
from tooltip_cli.report.tables import FRAME_COLUMNS

BETTER, WORSE, SAME = "better", "worse", "no difference shown"
NOT_COMPARED = "not compared"
OVERALL = "all"
_LEAST_FRAMES = 10  # fewer paired frames show nothing


@dataclass(frozen=True)
class Difference:
    """One tool in two reports; errors are means over the frames that both scored."""

    name: str
    frames: int  # scored in both
    before_px: float | None
    after_px: float | None
    change_px: float | None  # mean of the paired differences, after minus before
    low_px: float | None  # 95 % interval of it
    high_px: float | None
    before_mm: float | None  # tip errors, where truth exists
    after_mm: float | None
    verdict: str  # better, worse, no difference shown, or not compared
    remark: str  # why it was not compared, or what else differs


@dataclass(frozen=True)
class Comparison:
    """A report against the one before it."""

    before: str  # path of the report
    after: str
    tools: tuple[Difference, ...]
    overall: Difference | None  # over the tools that were compared, each counting alike
    only_before: tuple[str, ...]  # tools that the other report lacks
    only_after: tuple[str, ...]


@dataclass(frozen=True)
class _Loaded:
    path: Path
    report: EvaluationReport
    frames: Mapping[str, Mapping[int, tuple[float, float, float]]]  # tool -> stamp -> label, error


def compare(paths: Sequence[Path]) -> list[Comparison]:
    """Compare every report with the first, frame by frame where both scored the same label.

    Intervals come from resampling blocks of paired frames: they say what other test frames of the
    same recordings would have shown, not what other training frames or recordings would.

    Args:
        paths: two or more folders of reports, or their ``report.json``.

    Raises:
        TooltipError: fewer than two, or one that is not a report.
    """
    if len(paths) < 2:
        raise TooltipError("comparing needs at least two reports")
    first = _load(paths[0])
    return [_compare(first, _load(path)) for path in paths[1:]]


def _load(path: Path) -> _Loaded:
    place = path / "report.json" if path.is_dir() else path
    try:
        document = json.loads(place.read_text(encoding="utf-8"))
    except OSError as error:
        raise TooltipError(
            f"{place}: no report ({error.strerror}); make it with evaluate"
        ) from error
    except (ValueError, RecursionError) as error:
        raise TooltipError(f"{place}: not a report ({error})") from error
    schema = document.get("schema") if isinstance(document, dict) else None
    if schema != SCHEMA:
        raise TooltipError(f"{place}: expected the schema {SCHEMA}, found {schema!r}")
    try:
        report = from_plain(EvaluationReport, document)
    except TooltipError as error:
        raise TooltipError(f"{place}: {error}; make it anew with evaluate --force") from error
    return _Loaded(place, report, _frames(place.with_name("frames.csv")))


def _frames(place: Path) -> dict[str, dict[int, tuple[float, float, float]]]:
    found: dict[str, dict[int, tuple[float, float, float]]] = {}
    try:
        with place.open(encoding="utf-8", newline="") as file:
            rows = csv.DictReader(file)
            if tuple(rows.fieldnames or ()) != FRAME_COLUMNS:
                raise TooltipError(f"{place}: not the frames of a report (other columns)")
            for row in rows:
                if row["prediction_error_px"]:
                    label = float(row["label_u"]), float(row["label_v"])
                    stamp = int(row["stamp_ns"])
                    error = float(row["prediction_error_px"])
                    found.setdefault(row["tool"], {})[stamp] = (*label, error)
    except OSError as error:
        raise TooltipError(f"{place}: cannot be read ({error.strerror})") from error
    except (TypeError, ValueError, csv.Error) as error:
        raise TooltipError(f"{place}: a damaged table of frames ({error})") from error
    return found


def _compare(before: _Loaded, after: _Loaded) -> Comparison:
    old = {row.name: row for row in before.report.recordings}
    new = {row.name: row for row in after.report.recordings}
    paired = MeanOfTools()
    sides = MeanOfTools(), MeanOfTools()
    tools, frames = [], 0
    for name in (name for name in old if name in new):
        errors, label_changed = _pair(before.frames.get(name, {}), after.frames.get(name, {}))
        tools.append(_difference(old[name], new[name], errors, label_changed))
        if tools[-1].verdict != NOT_COMPARED:
            paired.add(errors[:, 1] - errors[:, 0], name)
            for side, column in zip(sides, errors.T, strict=True):
                side.add(column, name)
            frames += len(errors)
    return Comparison(
        before=str(before.path),
        after=str(after.path),
        tools=tuple(tools),
        overall=_overall(paired, sides, frames, tools) if paired.means else None,
        only_before=tuple(name for name in old if name not in new),
        only_after=tuple(name for name in new if name not in old),
    )


def _pair(
    before: Mapping[int, tuple[float, float, float]],
    after: Mapping[int, tuple[float, float, float]],
) -> tuple[Array, int]:
    """Return (F, 2) errors of frames that both scored, by stamp, and how many labels differ.

    Frames whose label moved between the reports are left out.
    """
    common = sorted(set(before) & set(after))
    same = [stamp for stamp in common if before[stamp][:2] == after[stamp][:2]]
    rows = [(before[stamp][2], after[stamp][2]) for stamp in same]
    return np.array(rows, dtype=float).reshape(-1, 2), len(common) - len(same)


def _difference(
    before: RecordingReport, after: RecordingReport, errors: Array, label_changed: int
) -> Difference:
    remarks = []
    if before.sha256 != after.sha256:
        remarks.append("the recordings differ")
    if label_changed:
        remarks.append(f"{label_changed} labels differ")
    for row, which in ((before, "before"), (after, "after")):
        if row.status != "ok":
            remarks.append(f"{row.status} {which}")
    if len(errors) < _LEAST_FRAMES:
        remarks.append(f"only {len(errors)} frames are scored in both")
        return Difference(
            before.name,
            len(errors),
            None,
            None,
            None,
            None,
            None,
            before.tip_error_mm,
            after.tip_error_mm,
            NOT_COMPARED,
            "; ".join(remarks),
        )
    changes = MeanOfTools()
    changes.add(errors[:, 1] - errors[:, 0], before.name)
    summary = changes.summary()
    low, high = (None, None) if summary is None else (summary.low, summary.high)
    return Difference(
        name=before.name,
        frames=len(errors),
        before_px=float(errors[:, 0].mean()),
        after_px=float(errors[:, 1].mean()),
        change_px=float((errors[:, 1] - errors[:, 0]).mean()),
        low_px=low,
        high_px=high,
        before_mm=before.tip_error_mm,
        after_mm=after.tip_error_mm,
        verdict=verdict(low, high),
        remark="; ".join(remarks),
    )


def verdict(low_px: float | None, high_px: float | None) -> str:
    """Return what an interval of the change in error shows."""
    if low_px is None or high_px is None or low_px <= 0 <= high_px:
        return SAME
    return BETTER if high_px < 0 else WORSE


def _overall(
    paired: MeanOfTools,
    sides: tuple[MeanOfTools, MeanOfTools],
    frames: int,
    tools: Sequence[Difference],
) -> Difference | None:
    change, before, after = paired.summary(), sides[0].summary(), sides[1].summary()
    if change is None or before is None or after is None:
        return None
    compared = [tool for tool in tools if tool.verdict != NOT_COMPARED]
    known = [
        (tool.before_mm, tool.after_mm)
        for tool in compared
        if tool.before_mm is not None and tool.after_mm is not None
    ]
    all_known = len(known) == len(compared)
    before_mm, after_mm = map(float, np.mean(known, axis=0)) if all_known else (None, None)
    return Difference(
        name=OVERALL,
        frames=frames,
        before_px=before.mean,
        after_px=after.mean,
        change_px=change.mean,
        low_px=change.low,
        high_px=change.high,
        before_mm=before_mm,
        after_mm=after_mm,
        verdict=verdict(change.low, change.high),
        remark=f"mean of {change.count} tools",
    )
