"""The part of the page about one recording, and what all parts share."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from urllib.parse import quote

import numpy as np

from tooltip_cli.report import words
from tooltip_cli.report.charts import Drawing, escape
from tooltip_cli.report.model import ErrorShares, EstimateScore, FrameTable, RecordingReport
from tooltip_cli.report.scenes import by_severity

_STRIP = 8  # the worst frames, shown without opening the table
_OPTION = re.compile(r"(?<= )--[a-z][^ ]*")  # is not broken at its dashes
_FILES = {"svg": "SVG", "png": "PNG", "csv": "data"}
_AUDIT_COLUMNS = (
    "frame",
    "picture",
    "label",
    "prediction [px]",
    "baseline [px]",
    "detection [px]",
    "detection to prediction [px]",
)


def anchor(name: str) -> str:
    """Return what a recording's parts are called in links: no character that HTML or URLs mind."""
    return re.sub(r"[^A-Za-z0-9_-]", lambda found: f".{ord(found[0]):x}.", name)


def grid(
    caption: str, head: Sequence[str], body: Iterable[str], note: str = "", kind: str = ""
) -> str:
    """Return a table in a frame that scrolls sideways, for keyboards too.

    Args:
        caption: plain text; also the name of the frame.
        body: rows as HTML.
        note: HTML after the caption.
        kind: CSS class.
    """
    columns = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in head)
    return (
        f'<div class="wide" role="region" aria-label="{escape(caption)}" tabindex="0">'
        f'<table class="{kind}"><caption>{escape(caption)}{note}</caption>'
        f"<thead><tr>{columns}</tr></thead>\n<tbody>{''.join(body)}</tbody></table></div>\n"
    )


def figure_html(figure: Drawing) -> str:
    """Return a figure with its caption and its files."""
    links = " ".join(
        f'<a href="figures/{quote(figure.name)}.{kind}">{word}</a>' for kind, word in _FILES.items()
    )
    return (
        f'<figure id="{anchor(figure.name)}"><h3>{escape(figure.title)}</h3>{figure.inline}'
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
    name, place = escape(row.name), anchor(row.name)
    nearest = None if row.detector is None else row.detector.nearest_px
    shares = "" if row.shares is None else _shares(row.shares, nearest)
    notes = "".join(f"<li>{escape(words.sentence(note))}</li>" for note in row.notes)
    return f"""<section aria-labelledby="tool-{place}" class="tool">
<h2 id="tool-{place}">{name} <span class="chip {judged.level}">{escape(judged.short)}</span></h2>
<p class="lead">{escape(judged.text)}</p>
{shares}
<dl>{"".join(_fact(term, text) for term, text in _facts(row))}</dl>
{f"<ul>{notes}</ul>" if notes else ""}
<div class="figures">{"".join(map(figure_html, figures))}</div>
{_audit(row, table, thumbnails, frame_files)}
</section>
"""


def _fact(term: str, text: str) -> str:
    whole = _OPTION.sub(r'<span class="option">\g<0></span>', escape(text))
    return f"<div><dt>{escape(term)}</dt><dd>{whole}</dd></div>"


def _facts(row: RecordingReport) -> Iterable[tuple[str, str]]:
    detector = row.detector
    if detector is not None and detector.position_m is not None:
        yield "Tip in the hand frame", words.position_words(detector)
        yield "95 % region", words.region_words(detector)
        axis = words.axis_words(detector)
        if axis is not None:
            yield "Tool's axis, out of its end", axis
        yield from _candidates(row, detector)
    if row.baseline is not None:
        yield "Tip from labels", words.position_words(row.baseline)
    if detector is not None:
        yield "Method", f"{detector.method}, from {detector.frames_used} frames"
    if row.detector_px is not None:
        error = row.detector_px
        yield (
            "Prediction error",
            f"mean {error.mean:.1f}, median {error.median:.1f}, 95 % below {error.p95:.1f}, "
            f"largest {error.maximum:.1f} px",
        )
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


def _candidates(row: RecordingReport, detector: EstimateScore) -> Iterable[tuple[str, str]]:
    if detector.ambiguous:
        for which, end in enumerate(detector.candidates, start=1):
            command = words.prefer_command(row, end)
            yield f"End {which}", f"{words.end_words(end)}. To take it: {command}"
    elif len(detector.candidates) > 1:
        first, second = detector.candidates[:2]
        text = (
            f"support {words.percent(first.support)}; the next best has "
            f"{words.percent(second.support)}"
        )
        yield "Candidates", text


def _shares(shares: ErrorShares, nearest_px: float | None) -> str:
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
        f"<p>{escape(words.share_words(shares, nearest_px))}</p></div>"
    )


def _audit(
    row: RecordingReport,
    table: FrameTable,
    thumbnails: dict[int, str],
    frame_files: dict[int, str],
) -> str:
    order = by_severity(table)
    strip = "".join(
        f'<li><a href="#{anchor(row.name)}-f{table.frames[place]}">{thumbnails[place]}'
        f"<span>frame {table.frames[place]}: {_audited(table, place)}</span></a></li>"
        for place in order[:_STRIP]
        if place in thumbnails
    )
    rows = (
        _audit_row(row, table, place, thumbnails.get(place), frame_files.get(place))
        for place in order
    )
    note = "" if len(thumbnails) >= len(order) else f". Pictures for the worst {len(thumbnails)}"
    listed = grid(f"Test frames of {row.name}, worst first", _AUDIT_COLUMNS, rows, note, "audit")
    return (
        "<h3>The worst frames</h3>\n"
        "<p>White dot: label. Green cross: prediction. Black dot: detection.</p>\n"
        f'<ol class="strip">{strip}</ol>\n'
        f"<details><summary>All {len(order)} test frames, worst first</summary>\n"
        f"{listed}</details>"
    )


def _audited(table: FrameTable, place: int) -> str:
    error, apart = table.prediction_error_px[place], table.apart_px[place]
    if np.isfinite(error):
        return f"{error:.1f} px"
    return f"{apart:.1f} px apart" if np.isfinite(apart) else table.states[place].replace("_", " ")


def _audit_row(
    row: RecordingReport,
    table: FrameTable,
    place: int,
    picture: str | None,
    file: str | None,
) -> str:
    frame = int(table.frames[place])
    errors = (
        table.prediction_error_px,
        table.baseline_error_px,
        table.detection_error_px,
        table.apart_px,
    )
    cells = "".join(f"<td>{_finite(float(column[place]))}</td>" for column in errors)
    link = f'<a href="{quote(file)}">{frame}</a>' if file else str(frame)
    shown = (
        f'<button class="picture" aria-label="Enlarge frame {frame}">{picture}</button>'
        if picture
        else ""
    )
    return (
        f'<tr id="{anchor(row.name)}-f{frame}"><th scope="row">{link}'
        f"<small>{table.stamps_ns[place]}</small></th><td>{shown}</td>"
        f"<td>{table.states[place].replace('_', ' ')}</td>{cells}</tr>\n"
    )


def _finite(value: float) -> str:
    return "-" if not np.isfinite(value) else f"{value:.1f}"
