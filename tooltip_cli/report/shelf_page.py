"""The page over a shelf, and its tables."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from tooltip_cli.report.charts import Drawing, escape
from tooltip_cli.report.document import head, table_rows
from tooltip_cli.report.section import figure_html, grid
from tooltip_cli.report.shelf_figures import length_words
from tooltip_cli.report.shelf_model import (
    Case,
    Cause,
    Counts,
    Drift,
    Group,
    Period,
    ShelfReport,
    Spread,
)
from tooltip_cli.report.tables import csv_text, number

_MOST_ROWS = 100  # of a table on the page; the CSV file has all
_SPREAD = ("count", "mean", "low", "high", "median", "p95", "maximum")
_NUMBERS = ("error_px", "baseline_px", "tip_error_mm")
GROUP_COLUMNS = (
    "recordings",
    "ok",
    "refused",
    "failed",
    *(f"{name}_{what}" for name in _NUMBERS for what in _SPREAD),
    "scatter_mm",
    *(
        f"{name}_{what}"
        for name in ("drift_percent_30_days", "baseline_drift_percent_30_days")
        for what in ("value", "low", "high")
    ),
)
_GROUP_HEAD = (
    "recordings",
    "with an estimate",
    "error [px]",
    "median",
    "95 % below",
    "from labels [px]",
    "to the true tip [mm]",
    "tips scatter [mm]",
    "error in 30 days",
    "from labels in 30 days",
)


def shelf_page(report: ShelfReport, figures: Sequence[Drawing]) -> Iterator[str]:
    """Yield ``index.html`` piece by piece."""
    yield head(f"Tool tips of {report.overall.counts.all} recordings", headline(report))
    yield f'<section aria-labelledby="summary"><h2 id="summary">Summary</h2>{_summary(report)}\n'
    if figures:
        yield f'<div class="figures">{"".join(map(figure_html, figures))}</div>'
    yield "</section>\n"
    yield _groups(report, "tools", "Tools", "tool", report.tools)
    yield _groups(report, "rigs", "Rigs", "rig", report.rigs)
    if report.worst:
        yield _worst(report.worst)
    if report.causes:
        yield _causes(report.causes)
    if report.periods:
        yield _periods(report.periods)
    yield _files(report)
    yield f"""</main>
<footer><p>Made by tooltip {escape(report.version)} on {escape(report.created)}. This page holds
everything it shows; links to figures and tables need the folder it was written to.</p></footer>
</body>
</html>
"""


def headline(report: ShelfReport) -> str:
    """Say in a sentence or two how the shelf fares."""
    counts, error = report.overall.counts, report.overall.error_px
    text = f"{counts.ok} of {counts.all} recordings have an estimate"
    rest = [
        f"{value} {word}"
        for value, word in ((counts.refused, "refused"), (counts.failed, "failed"))
        if value
    ]
    text += f"; {', '.join(rest)}. " if rest else ". "
    if error is None:
        return text + "None of them has labels, so no error is known."
    text += (
        f"The prediction error of the {error.count} with labels is {error.mean:.1f} px in the mean "
        f"and {error.median:.1f} px in the median; 95 % are below {error.p95:.1f} px."
    )
    for drift, what in (
        (report.overall.drift, "the error"),
        (report.overall.baseline_drift, "the error from labels"),
    ):
        if drift is not None and drift.clear:
            text += f" At equal tool and rig {what} changes by {drift.percent:+.0f} % in 30 days."
    return text


def _summary(report: ShelfReport) -> str:
    counts, overall = report.overall.counts, report.overall
    facts = [
        ("Recordings", _words(counts)),
        ("Prediction error", _spread_words(overall.error_px, "px")),
        ("From labels (baseline)", _spread_words(overall.baseline_px, "px")),
        ("To the true tip", _spread_words(overall.tip_error_mm, "mm")),
        ("Error over time", _drift_words(overall.drift)),
        ("Baseline over time", _drift_words(overall.baseline_drift)),
        ("Work", f"{report.seconds / 3600:.1f} hours of one process"),
    ]
    return "<dl>{}</dl>".format(
        "".join(
            f"<div><dt>{escape(name)}</dt><dd>{escape(text)}</dd></div>"
            for name, text in facts
            if text
        )
    )


def _words(counts: Counts) -> str:
    return f"{counts.all}: {counts.ok} ok, {counts.refused} refused, {counts.failed} failed"


def _spread_words(spread: Spread | None, unit: str) -> str:
    if spread is None:
        return ""
    return (
        f"mean {spread.mean:.1f}, median {spread.median:.1f}, 95 % below {spread.p95:.1f}, largest "
        f"{spread.maximum:.1f} {unit}, of {spread.count} recordings"
    )


def _drift_words(drift: Drift | None) -> str:
    if drift is None:
        return ""
    said = "" if drift.clear else ", which may be none"
    return (
        f"{drift.percent:+.1f} % in 30 days at equal tool and rig, 95 % interval {drift.low:+.1f} "
        f"to {drift.high:+.1f} %, of {drift.recordings} recordings{said}"
    )


def _groups(report: ShelfReport, kind: str, title: str, one: str, groups: Sequence[Group]) -> str:
    rows = (
        [
            escape(group.name),
            str(group.counts.all),
            _share(group.counts),
            _mean(group.error_px),
            _cell(None if group.error_px is None else group.error_px.median),
            _cell(None if group.error_px is None else group.error_px.p95),
            _mean(group.baseline_px),
            _mean(group.tip_error_mm),
            _cell(group.scatter_mm),
            _drift(group.drift),
            _drift(group.baseline_drift),
        ]
        for group in groups[:_MOST_ROWS]
    )
    notes = []
    if len(groups) > _MOST_ROWS:
        notes.append(f"The {_MOST_ROWS} with the largest errors; {kind}.csv has all.")
    if report.left_out.get(kind):
        notes.append(
            f"{report.left_out[kind]} recordings of further {kind} are gathered as (others)."
        )
    table = grid(f"{title}, largest mean error first", (one, *_GROUP_HEAD), table_rows(rows))
    note = "".join(f"<p>{escape(text)}</p>" for text in notes)
    return (
        f'<section aria-labelledby="{kind}"><h2 id="{kind}">{title}</h2>{table}{note}</section>\n'
    )


def _share(counts: Counts) -> str:
    share = counts.ok / counts.all
    level = "good" if share > 0.95 else "fair" if share > 0.7 else "poor"
    return f'<span class="chip {level}">{counts.ok} ({share:.0%})</span>'


def _mean(spread: Spread | None) -> str:
    if spread is None:
        return "-"
    if spread.low is None or spread.high is None:
        return f"{spread.mean:.1f}"
    return f"{spread.mean:.1f} <small>[{spread.low:.1f}, {spread.high:.1f}]</small>"


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _drift(drift: Drift | None) -> str:
    if drift is None:
        return "-"
    text = f"{drift.percent:+.0f} %"
    if drift.clear:
        text = f'<span class="chip {"poor" if drift.percent > 0 else "good"}">{text}</span>'
    return f"{text} <small>[{drift.low:+.0f}, {drift.high:+.0f}]</small>"


def _worst(cases: Sequence[Case]) -> str:
    rows = (
        [
            escape(case.name),
            escape(case.tool or "-"),
            escape(case.rig or "-"),
            f"{case.error_px:.1f}",
            _cell(case.baseline_px),
            escape((case.code or "-").replace("_", " ")),
            f"<code>{escape(case.recording)}</code>",
        ]
        for case in cases
    )
    table = grid(
        "Recordings with the largest errors",
        ("recording", "tool", "rig", "error [px]", "from labels [px]", "remark", "where"),
        table_rows(rows),
    )
    return (
        f'<section aria-labelledby="worst"><h2 id="worst">Worst cases</h2>{table}<p>For the frames '
        "of one of them: <code>tooltip evaluate RECORDING --out REPORT</code></p></section>\n"
    )


def _causes(causes: Sequence[Cause]) -> str:
    rows = (
        [
            escape(cause.code.replace("_", " ")),
            escape(cause.status),
            str(cause.recordings),
            escape(", ".join(cause.examples)),
            f"<code>{escape(cause.reason[:300])}</code>",
        ]
        for cause in causes
    )
    table = grid(
        "Recordings without an estimate, by reason",
        ("reason", "status", "recordings", "such as", "the first one's reason"),
        table_rows(rows),
    )
    return (
        '<section aria-labelledby="causes"><h2 id="causes">Without an estimate</h2>'
        f"{table}</section>\n"
    )


def _periods(periods: Sequence[Period]) -> str:
    rows = (
        [
            escape(period.start.removesuffix("+00:00").replace("T", " ")),
            str(period.counts.all),
            str(period.counts.ok),
            str(period.counts.refused),
            str(period.counts.failed),
            _cell(period.error_px),
            _cell(period.baseline_px),
            _cell(period.tip_error_mm),
        ]
        for period in periods
    )
    table = grid(
        f"Periods of {length_words(periods[0].seconds)}, UTC",
        (
            "from",
            "recordings",
            "ok",
            "refused",
            "failed",
            "error [px]",
            "from labels [px]",
            "to the true tip [mm]",
        ),
        table_rows(rows),
    )
    return (
        '<section aria-labelledby="time"><h2 id="time">Over time</h2><details><summary>All '
        f"{len(periods)} periods</summary>{table}</details></section>\n"
    )


def _files(report: ShelfReport) -> str:
    links = " ".join(f'<a href="{name}">{name}</a>' for name in ("shelf.json", *TABLES))
    return (
        '<section aria-labelledby="how"><h2 id="how">How it was measured</h2><ul>'
        "<li>Every number is over recordings, each counted once with its mean over the labelled "
        "test frames; medians and 95 % limits are exact to 1 %.</li>"
        "<li>Intervals are those of the mean at 95 %, as if recordings were independent.</li>"
        "<li>A change over time is fitted to the logarithm of the error, with a level of its own "
        "for each tool on each rig, where at least twelve recordings say something. It is shown "
        "as a mark where its interval leaves no doubt about its direction.</li>"
        f"</ul><p>From {escape(report.source)}. All numbers: {links}</p></section>\n"
    )


def group_rows(groups: Iterable[Group]) -> Iterator[list[str]]:
    """Yield the rows of ``tools.csv`` and ``rigs.csv``."""
    for group in groups:
        counts = group.counts
        yield [
            group.name,
            *(str(value) for value in (counts.all, counts.ok, counts.refused, counts.failed)),
            *(cell for name in _NUMBERS for cell in _spread_cells(getattr(group, name))),
            number(group.scatter_mm),
            *_drift_cells(group.drift),
            *_drift_cells(group.baseline_drift),
        ]


def _spread_cells(spread: Spread | None) -> list[str]:
    if spread is None:
        return [""] * len(_SPREAD)
    return [str(spread.count), *(number(getattr(spread, name)) for name in _SPREAD[1:])]


def _drift_cells(drift: Drift | None) -> list[str]:
    if drift is None:
        return ["", "", ""]
    return [number(drift.percent), number(drift.low), number(drift.high)]


TABLES = ("tools.csv", "rigs.csv", "periods.csv", "worst.csv", "causes.csv")


def shelf_tables(report: ShelfReport) -> Iterator[tuple[str, str]]:
    """Yield name and text of every table."""
    yield "tools.csv", csv_text(("tool", *GROUP_COLUMNS), group_rows(report.tools))
    yield "rigs.csv", csv_text(("rig", *GROUP_COLUMNS), group_rows(report.rigs))
    yield (
        "periods.csv",
        csv_text(
            ("start", "seconds", "ok", "refused", "failed", *_NUMBERS),
            (
                [
                    period.start,
                    f"{period.seconds:g}",
                    *(str(getattr(period.counts, name)) for name in ("ok", "refused", "failed")),
                    *(number(getattr(period, name)) for name in _NUMBERS),
                ]
                for period in report.periods
            ),
        ),
    )
    yield (
        "worst.csv",
        csv_text(
            ("name", "recording", "tool", "rig", "error_px", "baseline_px", "code"),
            (
                [
                    case.name,
                    case.recording,
                    case.tool,
                    case.rig,
                    number(case.error_px),
                    number(case.baseline_px),
                    case.code,
                ]
                for case in report.worst
            ),
        ),
    )
    yield (
        "causes.csv",
        csv_text(
            ("status", "code", "recordings", "examples", "reason"),
            (
                [cause.status, cause.code, cause.recordings, " ".join(cause.examples), cause.reason]
                for cause in report.causes
            ),
        ),
    )
