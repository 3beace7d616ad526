"""The page: one self-contained HTML file that asks no host for anything."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from importlib import resources
from typing import Any

from tooltip_cli.method.evaluation import ErrorSummary
from tooltip_cli.report import words
from tooltip_cli.report.charts import Drawing, escape
from tooltip_cli.report.model import (
    ErrorShares,
    EvaluationReport,
    FrameTable,
    RecordingReport,
    mean_of,
)
from tooltip_cli.report.scenes import by_severity

_POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "base-uri 'none'; form-action 'none'"
)
_STRIP = 6  # the worst frames, shown without opening the table
_SAMPLES = {"svg": "SVG", "png": "PNG", "csv": "data"}


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
    title = "Tool tips: " + ", ".join(names[:4]) + (" ..." if len(names) > 4 else "")
    yield f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{_POLICY}">
<meta name="color-scheme" content="light dark">
<title>{escape(title)}</title>
<style>
{_resource("page.css")}</style>
</head>
<body>
<header>
<h1>{escape(title)}</h1>
<p class="lead">{escape(words.headline(report))}</p>
</header>
<main>
<section aria-labelledby="summary"><h2 id="summary">Summary</h2>
{_tool_table(report, left_out)}
</section>
<section aria-labelledby="all-tools"><h2 id="all-tools">All tools</h2>
<div class="figures">{"".join(map(figure_html, figures))}</div>
</section>
"""
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
{_resource("page.js")}</script>
</body>
</html>
"""


def _resource(name: str) -> str:
    return resources.files("tooltip_cli.report").joinpath(name).read_text(encoding="utf-8")


def _table(caption: str, head: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    """Return a table in a frame that scrolls sideways; cells are HTML, the first names the row."""
    columns = "".join(f'<th scope="col">{cell}</th>' for cell in head)
    rows = "".join(
        f'<tr><th scope="row">{first}</th>{"".join(f"<td>{cell}</td>" for cell in rest)}</tr>\n'
        for first, *rest in body
    )
    return (
        f'<div class="wide" role="region" aria-label="{escape(caption)}" tabindex="0"><table>'
        f"<caption>{escape(caption)}</caption><thead><tr>{columns}</tr></thead>\n"
        f"<tbody>{rows}</tbody></table></div>"
    )


def _tool_table(report: EvaluationReport, left_out: Sequence[str]) -> str:
    def cells(row: RecordingReport) -> list[str]:
        judged = words.verdict(row)
        linked = row.status != "failed" and row.name not in left_out
        name = f'<a href="#tool-{escape(row.name)}">{escape(row.name)}</a>'
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
    return _table(
        "Mean prediction error of each tool",
        (
            "tool",
            "verdict",
            "from detections [px]",
            "from labels [px]",
            "to the true tip [mm]",
            "stated deviation [mm]",
            "between the two [mm]",
            "frames",
        ),
        rows,
    )


def _interval(error: ErrorSummary | None) -> str:
    if error is None:
        return "-"
    mean, *rest = words.interval(error).split(" ", 1)
    return f"{mean} <small>{rest[0]}</small>" if rest else mean


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def figure_html(figure: Drawing) -> str:
    """Return a figure with its caption and its files."""
    links = " ".join(
        f'<a href="figures/{escape(figure.name)}.{kind}">{word}</a>'
        for kind, word in _SAMPLES.items()
    )
    return (
        f'<figure id="{escape(figure.name)}"><h3>{escape(figure.title)}</h3>{figure.inline}'
        f'<figcaption>{escape(figure.caption)} <span class="files">{links}</span></figcaption>'
        "</figure>\n"
    )


def recording_section(
    row: RecordingReport,
    table: FrameTable,
    figures: Sequence[Drawing],
    thumbnails: dict[int, str],
    frame_files: dict[int, str],
) -> str:
    """Return the part of the page about one recording.

    Args:
        thumbnails: SVG of places in the table.
        frame_files: whole frames of places in the table, relative to the page.
    """
    judged = words.verdict(row)
    name = escape(row.name)
    shares = "" if row.shares is None else _shares(row.shares)
    notes = "".join(f"<li>{escape(words.sentence(note))}</li>" for note in row.notes)
    return f"""<section aria-labelledby="tool-{name}" class="tool">
<h2 id="tool-{name}">{name} <span class="chip {judged.level}">{escape(judged.short)}</span></h2>
<p class="lead">{escape(judged.text)}</p>
{shares}
<dl>{"".join(_fact(term, text) for term, text in _facts(row))}</dl>
{f"<ul>{notes}</ul>" if notes else ""}
<div class="figures">{"".join(map(figure_html, figures))}</div>
{_audit(row, table, thumbnails, frame_files)}
</section>
"""


def _fact(term: str, text: str) -> str:
    return f"<div><dt>{escape(term)}</dt><dd>{escape(text)}</dd></div>"


def _facts(row: RecordingReport) -> Iterable[tuple[str, str]]:
    detector = row.detector
    if detector is not None and detector.position_m is not None:
        yield "Tip in the hand frame", words.position_words(detector)
        yield "95 % region", words.region_words(detector)
        for text in words.candidate_words(detector):
            yield "Candidates", text
    for reason in row.reasons:
        yield reason.code, words.sentence(reason.text)
    if row.baseline is not None:
        yield "Tip from labels", words.position_words(row.baseline)
    if detector is not None:
        yield "Method", f"{detector.method}, {detector.frames_used} frames with a ray"
    yield "Detections", words.detection_words(row)
    yield "Labels", words.label_words(row)
    training = words.training_words(row)
    if training is not None:
        yield "Training frames", training
    if row.split is not None:
        yield (
            "Frames",
            (
                f"{row.frames} in {row.duration_s:.1f} s; {row.split.train} train, "
                f"{row.split.test} test, {row.scored} of them scored"
            ),
        )


def _shares(shares: ErrorShares) -> str:
    parts = (
        ("detection", shares.detection_px, "detection"),
        ("clock", shares.clock_px, "synchronisation"),
        ("baseline", shares.calibration_px, "calibration and labels"),
    )
    bar = ""
    if shares.detection_px >= 0:
        bar = "".join(
            f'<span class="{kind}" style="flex-grow:{value:.3f}" title="{name}: {value:.1f} px">'
            "</span>"
            for kind, value, name in parts
            if value > 0
        )
        key = "".join(
            f'<li class="{kind}">{name} {value:.1f} px</li>' for kind, value, name in parts
        )
        bar = f'<div class="bar" aria-hidden="true">{bar}</div><ul class="key">{key}</ul>'
    return (
        f'<div class="shares"><h3>Where the error comes from</h3>{bar}'
        f"<p>{escape(words.share_words(shares))}</p></div>"
    )


def _audit(
    row: RecordingReport,
    table: FrameTable,
    thumbnails: dict[int, str],
    frame_files: dict[int, str],
) -> str:
    order = by_severity(table)
    strip = "".join(
        f'<li><a href="#{escape(row.name)}-f{table.frames[place]}">{thumbnails[place]}'
        f"<span>frame {table.frames[place]}: {_audited(table, place)}</span></a></li>"
        for place in order[:_STRIP]
        if place in thumbnails
    )
    rows = "".join(
        _audit_row(row, table, place, rank, thumbnails.get(place), frame_files.get(place))
        for rank, place in enumerate(order, start=1)
    )
    key = "White dot: label. Green cross: prediction. Black dot: detection."
    pictured = len(thumbnails)
    note = "" if pictured >= len(order) else f" Pictures for the worst {pictured}."
    head = "".join(
        f'<th scope="col">{cell}</th>'
        for cell in (
            "frame",
            "picture",
            "label",
            "prediction [px]",
            "baseline [px]",
            "detection [px]",
        )
    )
    return f"""<h3>The worst frames</h3>
<p>{key} A picture opens larger.</p>
<ol class="strip">{strip}</ol>
<details><summary>All {len(order)} test frames, worst first</summary>
<div class="wide" role="region" aria-label="Test frames of {escape(row.name)}" tabindex="0">
<table class="audit"><caption>Test frames of {escape(row.name)}, worst first.{note}</caption>
<thead><tr>{head}</tr></thead>
<tbody>{rows}</tbody></table></div></details>"""


def _audited(table: FrameTable, place: int) -> str:
    error = table.prediction_error_px[place]
    return table.states[place] if error != error else f"{error:.1f} px"


def _audit_row(
    row: RecordingReport,
    table: FrameTable,
    place: int,
    rank: int,
    picture: str | None,
    file: str | None,
) -> str:
    frame = int(table.frames[place])
    errors = (table.prediction_error_px, table.baseline_error_px, table.detection_error_px)
    cells = "".join(f"<td>{_finite(float(column[place]))}</td>" for column in errors)
    link = f'<a href="{escape(file)}">{frame}</a>' if file else str(frame)
    shown = (
        f'<button class="picture" aria-label="Enlarge frame {frame}">{picture}</button>'
        if picture
        else ""
    )
    return (
        f'<tr id="{escape(row.name)}-f{frame}"><th scope="row">{link}'
        f"<small>{table.stamps_ns[place]}</small></th><td>{shown}</td>"
        f"<td>{table.states[place].replace('_', ' ')}</td>{cells}</tr>\n"
    )


def _finite(value: float) -> str:
    return "-" if value != value else f"{value:.1f}"


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
        rig = origin["rig"]
        values = (
            row.recording,
            f"{row.sha256[:12]}...",
            labels,
            f"{rig['source']} (offset {1000 * rig['time_offset_s']:g} ms)",
            f"{origin['detections_key'][:12]}...",
            " ".join(keys),
            f"{origin['version']}, {origin['created']}",
        )
        rows.append([escape(row.name), *(f"<code>{escape(value)}</code>" for value in values)])
    options = "".join(
        f"<div><dt>{escape(name)}</dt><dd><code>{escape(value)}</code></dd></div>"
        for name, value in _flat(report.options)
    )
    table = _table(
        "Where every number comes from",
        ("tool", "recording", "SHA-256", "labels", "rig", "detections", "estimates", "version"),
        rows,
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
