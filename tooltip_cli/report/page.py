"""The page: one self-contained HTML file that asks no host for anything."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from typing import Any

from tooltip_cli.log.views import STORED_RIG
from tooltip_cli.method.evaluation import ErrorSummary
from tooltip_cli.report import words
from tooltip_cli.report.charts import Drawing, escape
from tooltip_cli.report.document import head, packaged, table_rows
from tooltip_cli.report.model import EvaluationReport, RecordingReport, mean_of
from tooltip_cli.report.section import anchor, figure_html, grid

_NAMED = 4  # tools in the title


def page(
    report: EvaluationReport,
    figures: Sequence[Drawing],
    sections: Iterable[str],
    left_out: Sequence[str],
) -> Iterable[str]:
    """Yield ``index.html`` piece by piece.

    Args:
        figures: over all tools.
        sections: of the recordings that are shown in full.
        left_out: names of the others.
    """
    names = [row.name for row in report.recordings]
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    title = "Tool tips: " + ", ".join(names[:_NAMED]) + more
    yield head(title, words.headline(report))
    yield f"""<section aria-labelledby="summary"><h2 id="summary">Summary</h2>
{_tool_table(report, left_out)}
{_failures(report)}</section>
"""
    if figures:
        yield (
            '<section aria-labelledby="all-tools"><h2 id="all-tools">All tools</h2>'
            f'<div class="figures">{"".join(map(figure_html, figures))}</div></section>\n'
        )
    yield from sections
    if left_out:
        shown = ", ".join(map(escape, left_out[:50])) + (" ..." if len(left_out) > 50 else "")
        yield (
            "<section><h2>Further recordings</h2><p>Only the recordings with the largest errors "
            f"are shown in full. In the tables alone: {shown}. For one of them, run tooltip "
            "evaluate on it with another --out.</p></section>\n"
        )
    yield _method(report)
    yield _provenance(report)
    yield f"""</main>
<footer><p>Made by tooltip {escape(report.version)} on {escape(report.created)}. This page holds
everything it shows; links to figures, tables and frames need the folder it was written to.</p>
</footer>
<dialog id="viewer" aria-labelledby="viewer-title">
<form method="dialog"><h2 id="viewer-title">Frame</h2><button>Close</button></form>
<div id="viewer-picture"></div></dialog>
<script>
{packaged("page.js")}</script>
</body>
</html>
"""


def _tool_table(report: EvaluationReport, left_out: Sequence[str]) -> str:
    def cells(row: RecordingReport) -> list[str]:
        judged = words.verdict(row)
        linked = row.status != "failed" and row.name not in left_out
        name = f'<a href="#tool-{anchor(row.name)}">{escape(row.name)}</a>'
        spread = row.detector.deviations_mm if row.detector else None
        return [
            name if linked else escape(row.name),
            f'<span class="chip {judged.level}">{escape(judged.short)}</span>',
            _interval(row.detector_px),
            _interval(row.baseline_px),
            _number(row.tip_error_mm),
            _number(None if spread is None else max(spread)),
            _number(row.apart_mm),
            str(row.scored) if row.scored else "-",
        ]

    rows = [cells(row) for row in report.recordings]
    overall = report.overall
    if overall.compared > 1:
        rows.append(
            [
                f"mean of {overall.compared}",
                "",
                _interval(overall.detector_px),
                _interval(overall.baseline_px),
                _number(mean_of(overall.tip_error_mm)),
                "",
                "",
                "",
            ]
        )
    table = grid(
        "Mean prediction error of each tool",
        (
            "tool",
            "verdict",
            "from detections [px]",
            "from labels [px]",
            "to the true tip [mm]",
            "stated deviation [mm]",
            "between the two [mm]",
            "frames scored",
        ),
        table_rows(rows),
    )
    return (
        f'{table}<p class="note">Brackets: 95 % interval of the mean. Stated deviation: the '
        "estimate's own, along the axis where it is largest. Between the two: from the tip by "
        "detections to the tip by labels.</p>\n"
    )


def _failures(report: EvaluationReport) -> str:
    items = "".join(
        f"<li>{escape(row.name)}: {escape(words.sentence(reason.text))}</li>"
        for row in report.recordings
        if row.status != "ok"
        for reason in row.reasons
    )
    return f"<ul>{items}</ul>" if items else ""


def _interval(error: ErrorSummary | None) -> str:
    if error is None:
        return "-"
    mean, *rest = words.interval(error).split(" ", 1)
    return f"{mean} <small>{rest[0]}</small>" if rest else mean


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _method(report: EvaluationReport) -> str:
    items = "".join(f"<li>{escape(text)}</li>" for text in words.caveats(report))
    return (
        '<section aria-labelledby="method"><h2 id="method">How it was measured</h2>'
        "<p>The tip is estimated twice: from detections in the training frames, and from the "
        "labels (the baseline). Both are projected into the test frames; the error is the distance "
        f"to the label in pixels (section 4.3 of the paper).</p><ul>{items}</ul></section>\n"
    )


def _provenance(report: EvaluationReport) -> str:
    rows = []
    for row in report.recordings:
        origin = row.provenance
        if not origin:
            continue
        keys = [score.key[:12] for score in (row.detector, row.baseline) if score is not None]
        labels = "-" if row.labels is None else f"{row.labels.file} {row.labels.digest[:12]}"
        rig, made = origin["rig"], str(origin["created"])[:16].replace("T", " ")
        source = "in the recording" if rig["source"].endswith(STORED_RIG) else rig["source"]
        values = (
            row.recording,
            f"{row.sha256[:12]}...",
            labels,
            f"{source}, offset {1000 * rig['time_offset_s']:g} ms",
            f"{origin['detections_key'][:12]}...",
            " ".join(keys),
            f"{origin['version']}, {made}",
        )
        rows.append([escape(row.name), *(f"<code>{escape(value)}</code>" for value in values)])
    options = "".join(
        f"<div><dt>{escape(name)}</dt><dd><code>{escape(value)}</code></dd></div>"
        for name, value in _flat(report.options)
    )
    table = grid(
        "Where every number comes from",
        ("tool", "recording", "SHA-256", "labels", "rig", "detections", "estimates", "version"),
        table_rows(rows),
    )
    files = " ".join(
        f'<a href="{name}">{name}</a>'
        for name in ("report.json", "tools.csv", "frames.csv", "tools.tex")
    )
    return (
        f'<section aria-labelledby="provenance"><h2 id="provenance">Provenance</h2>{table}'
        f"<details><summary>Parameters</summary><dl class='parameters'>{options}</dl></details>"
        f"<p>Whole hashes and all numbers: {files}</p></section>\n"
    )


def _flat(options: dict[str, Any], prefix: str = "") -> Iterable[tuple[str, str]]:
    for name, value in options.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", json.dumps(value)
