"""The tables: one row a tool, one row a test frame, and LaTeX for a paper."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from tooltip_cli.method.evaluation import ErrorSummary
from tooltip_cli.report.model import EvaluationReport, FrameTable, RecordingReport, mean_of

ALL_TOOLS = "mean of tools"
_STATISTICS = ("count", "mean", "median", "low", "high", "rms", "p95", "maximum")
TOOL_COLUMNS = (
    "tool",
    "status",
    "reasons",
    "simulated_labels",
    "scored_frames",
    "train_frames",
    *(f"detector_{name}" for name in ("status", *(f"px_{item}" for item in _STATISTICS))),
    *(f"baseline_{name}" for name in ("status", *(f"px_{item}" for item in _STATISTICS))),
    *(f"detection_px_{item}" for item in _STATISTICS),
    "nearest_candidate_px",
    "tip_error_mm",
    "baseline_tip_error_mm",
    *(f"tip_{axis}_m" for axis in "xyz"),
    *(f"deviation_{axis}_mm" for axis in "xyz"),
)
FRAME_COLUMNS = (
    "tool",
    "frame",
    "stamp_ns",
    "state",
    *(
        f"{name}_{axis}"
        for name in ("label", "detection", "prediction", "baseline", "truth")
        for axis in "uv"
    ),
    "detection_weight",
    "detection_error_px",
    "prediction_error_px",
    "baseline_error_px",
    *(f"turn_{axis}_deg" for axis in "xyz"),
)


def number(value: float | None, digits: int = 4) -> str:
    """Return a number for a CSV file; empty where there is none."""
    return "" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def csv_text(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a CSV file's text."""
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return out.getvalue()


def tool_rows(report: EvaluationReport) -> Iterator[list[str]]:
    """Yield the rows of ``tools.csv``; the last is the mean over tools."""
    for row in report.recordings:
        yield _tool_row(row)
    overall = report.overall
    filler = [""] * len(_STATISTICS)
    yield [
        ALL_TOOLS,
        report.status,
        "",
        "",
        "",
        "",
        "",
        *_statistics(overall.detector_px),
        "",
        *_statistics(overall.baseline_px),
        *filler,
        "",
        number(mean_of(overall.tip_error_mm)),
        *[""] * 7,
    ]


def _tool_row(row: RecordingReport) -> list[str]:
    detector, baseline = row.detector, row.baseline
    position = detector.position_m if detector and detector.position_m else (None,) * 3
    deviations = detector.deviations_mm if detector and detector.deviations_mm else (None,) * 3
    return [
        row.name,
        row.status,
        " ".join(reason.code for reason in row.reasons),
        "" if row.labels is None else str(row.labels.simulated).lower(),
        str(row.scored),
        "" if row.split is None else str(row.split.train),
        "" if detector is None else detector.status,
        *_statistics(row.detector_px),
        "" if baseline is None else baseline.status,
        *_statistics(row.baseline_px),
        *_statistics(row.detection_px),
        number(None if detector is None else detector.nearest_px),
        number(row.tip_error_mm),
        number(row.baseline_tip_error_mm),
        *(number(value, 6) for value in position),
        *(number(value) for value in deviations),
    ]


def _statistics(errors: ErrorSummary | None) -> list[str]:
    if errors is None:
        return [""] * len(_STATISTICS)
    return [str(errors.count), *(number(getattr(errors, name)) for name in _STATISTICS[1:])]


def frame_rows(name: str, table: FrameTable) -> Iterator[list[str]]:
    """Yield the rows of ``frames.csv`` of one recording."""
    pixels = (table.label, table.detection, table.prediction, table.baseline, table.truth)
    errors = (table.detection_error_px, table.prediction_error_px, table.baseline_error_px)
    for index, frame in enumerate(table.frames):
        yield [
            name,
            str(int(frame)),
            str(int(table.stamps_ns[index])),
            table.states[index],
            *(number(value, 3) for column in pixels for value in column[index]),
            number(table.weight[index], 3),
            *(number(column[index]) for column in errors),
            *(number(value, 3) for value in table.turn_deg[index]),
        ]


def latex_table(report: EvaluationReport) -> str:
    """Return a table for a paper: booktabs, errors with their 95 % intervals."""
    lines = [
        r"% needs \usepackage{booktabs}; made by tooltip " + report.version,
        r"\begin{tabular}{lrrrr}",
        r"\toprule",
        r"tool & detections [px] & labels (baseline) [px] & tip [mm] & frames \\",
        r"\midrule",
    ]
    for row in report.recordings:
        cells = [
            _latex_text(row.name),
            _latex_interval(row.detector_px) if row.detector_px else row.status,
            _latex_interval(row.baseline_px),
            _latex_number(row.tip_error_mm),
            str(row.scored) if row.scored else "--",
        ]
        lines.append(" & ".join(cells) + r" \\")
    overall = report.overall
    lines += [
        r"\midrule",
        " & ".join(
            [
                f"mean of {overall.compared} tools",
                _latex_interval(overall.detector_px),
                _latex_interval(overall.baseline_px),
                _latex_number(mean_of(overall.tip_error_mm)),
                "",
            ]
        )
        + r" \\",
        r"\bottomrule",
        r"\end{tabular}",
    ]
    return "\n".join(lines) + "\n"


def _latex_interval(errors: ErrorSummary | None) -> str:
    if errors is None:
        return "--"
    if errors.low is None or errors.high is None:
        return f"{errors.mean:.2f}"
    return f"{errors.mean:.2f} [{errors.low:.2f}, {errors.high:.2f}]"


def _latex_number(value: float | None) -> str:
    return "--" if value is None else f"{value:.2f}"


_LATEX_ESCAPES = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    **{character: f"\\{character}" for character in "&%$#_{}"},
}


def _latex_text(text: str) -> str:
    return "".join(_LATEX_ESCAPES.get(character, character) for character in text)
