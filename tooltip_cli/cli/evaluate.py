"""``tooltip evaluate``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tooltip_cli.cli.options import (
    METHODS,
    PATH,
    PRESET_OF_DETECTIONS,
    Prefer,
    estimator_params,
    force_option,
    jobs_option,
    json_option,
    prefer_option,
    preset_option,
    print_json,
    printable,
    progress,
    refine_option,
    say,
    table,
    topic_options,
    without_results,
)

if TYPE_CHECKING:
    from tooltip_cli.method.evaluation import ErrorSummary
    from tooltip_cli.report.model import EvaluationReport, RecordingReport

EXIT_CODES = {"ok": 0, "refused": 3, "failed": 1}


@click.command()
@click.argument("recordings", nargs=-1, required=True, metavar="REC... | SHELF")
@click.option(
    "--labels",
    type=PATH,
    metavar="CSV",
    help="Labels, or a folder with STEM.labels.csv for each recording. Default: STEM.labels.csv "
    "under --out, then beside the recording.",
)
@click.option(
    "--second-labels",
    type=PATH,
    metavar="CSV",
    help="A second annotator's labels of the same frames. Default: STEM.labels.*.csv.",
)
@click.option(
    "--rig",
    type=PATH,
    help="Rig file, or a folder with STEM.rig.yaml for each recording. Default: the one stored in "
    "the recording.",
)
@click.option(
    "--method",
    type=click.Choice(METHODS),
    default="voting",
    show_default=True,
    help="Estimator, as in 'tooltip estimate'.",
)
@preset_option(PRESET_OF_DETECTIONS)
@prefer_option
@refine_option
@click.option(
    "--train", type=click.IntRange(min=1), default=400, show_default=True, help="Training frames."
)
@click.option(
    "--test",
    type=click.IntRange(min=1),
    default=100,
    show_default=True,
    help="Test frames, where no labels decide them.",
)
@click.option("--seed", type=int, default=0, show_default=True, help="Of the split.")
@click.option(
    "--split",
    type=click.Choice(["random", "blocks"]),
    default="random",
    show_default=True,
    help="random as in the paper, or contiguous test blocks, where no labels decide.",
)
@click.option(
    "--curve/--no-curve",
    default=None,
    help="Whether to estimate from ever fewer training frames too. Default: as far as that is "
    "quick; with voting from 50 and 100 once, where --curve draws 30, 50 and 100 several times.",
)
@click.option(
    "--frame",
    type=click.IntRange(min=0),
    metavar="N",
    help="Show the test frame nearest to this image in the figures. Default: one with a typical "
    "error.",
)
@click.option(
    "--out",
    type=PATH,
    help="Directory of the report and of whatever has to be computed. Default: report/ beside the "
    "first recording.",
)
@jobs_option
@topic_options
@force_option
@json_option
@click.pass_context
def evaluate(
    ctx: click.Context,
    recordings: tuple[str, ...],
    labels: Path | None,
    second_labels: Path | None,
    rig: Path | None,
    method: str,
    preset: str,
    prefer: Prefer | None,
    refine: str,
    train: int,
    test: int,
    seed: int,
    split: str,
    curve: bool | None,
    frame: int | None,
    out: Path | None,
    jobs: int,
    image: str | None,
    joints: str | None,
    info: str | None,
    pose: str | None,
    force: bool,
    as_json: bool,
) -> None:
    """Measure the estimate against hand labels and write a report.

    The tip is estimated from detections in the training frames and, as a baseline, from the
    labels; both are projected into the labelled test frames (paper, section 4). Writes index.html,
    report.json, tools.csv, frames.csv, tools.tex and every figure as SVG, PNG and CSV. Without
    labels the report says what can be told all the same.

    A SHELF (a folder, a pattern, a manifest, or an address in a store) is taken through 'tooltip
    run' first, with what is finished left alone, and gets the report over many recordings: tables
    by tool and rig, worst cases, changes over time. The table that 'tooltip run' wrote gets that
    report from its rows alone. --method, --rig, --out, --jobs, --force and topics apply.

    Exits with 0 when at least one recording has an estimate, 3 when every estimate was refused,
    and 1 when none could be evaluated.

    \b
    Examples:
      tooltip evaluate pliers.mcap
      tooltip evaluate *.mcap --out results --jobs 2
      tooltip evaluate pen.mcap --rig pen.rig.yaml --labels pen.labels.csv
      tooltip evaluate shelf --jobs 8
      tooltip evaluate shelf/run/results.parquet
    """
    if is_shelf(recordings):
        from tooltip_cli.cli.run import evaluate_shelf

        _refuse_for_shelf(ctx)
        evaluate_shelf(
            ctx,
            recordings[0],
            as_json,
            rig=None if rig is None else str(rig),
            method=method,
            jobs=jobs,
            out=None if out is None else str(out),
            image=image,
            joints=joints,
            info=info,
            pose=pose,
            force=force,
        )
        return
    from tooltip_cli.log.recording import Topics
    from tooltip_cli.stages.artifacts import plain
    from tooltip_cli.stages.evaluate import evaluate as run

    with progress(None, "detect, pairs") as advance:
        report = run(
            without_results(tuple(map(Path, recordings))),
            labels=labels,
            second_labels=second_labels,
            rig=rig,
            topics=Topics(image=image, joints=joints, info=info, pose=pose),
            train=train,
            test=test,
            seed=seed,
            split=split,
            params=estimator_params(method, prefer, refine),
            preset=preset,
            curve=curve,
            frame=frame,
            out=out,
            force=force,
            jobs=jobs,
            on_pair=advance,
            on_step=lambda path, text: say(f"{path}: {text}"),
        )
    if as_json:
        print_json(plain(report))
    else:
        print_summary(report)
    ctx.exit(EXIT_CODES[report.status])


_TABLES = (".csv", ".parquet")
_OF_A_SHELF = ("recordings", "rig", "method", "out", "jobs", "force", "as_json")
_TOPICS = ("image", "joints", "info", "pose")


def is_shelf(recordings: Sequence[str]) -> bool:
    """Tell a shelf, which stands alone, from recordings."""
    if len(recordings) != 1:
        return False
    (text,) = recordings
    path = Path(text)
    return (
        "://" in text
        or (path.is_dir() and path.suffix != ".mcap")
        or path.suffix.lower() in _TABLES
        or (any(character in text for character in "*?[") and not path.exists())
    )


def _refuse_for_shelf(ctx: click.Context) -> None:
    """Refuse options that a shelf would pass over."""
    for parameter in ctx.command.params:
        name = parameter.name or ""
        given = ctx.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE
        if given and name not in (*_OF_A_SHELF, *_TOPICS):
            raise click.UsageError(
                f"{parameter.opts[0]} is for recordings that are named one by one, not for a shelf"
            )


def print_summary(report: EvaluationReport) -> None:
    """Print the errors of every tool, aligned, and where the report is."""
    from tooltip_cli.report.model import mean_of

    header = ("tool", "detector [px]", "baseline [px]", "tip [mm]", "")
    rows = [_cells(row) for row in report.recordings]
    overall = report.overall
    if overall.compared > 1:
        mean = (
            f"mean of {overall.compared}",
            _error(overall.detector_px),
            _error(overall.baseline_px),
            _number(mean_of(overall.tip_error_mm)),
            "",
        )
        rows.append(mean)
    head, *lines = table(header, rows, left=1, words=1)
    click.secho(head, bold=True)
    for row, line in zip(rows, lines, strict=True):
        click.secho(line, fg="yellow" if row[4] else None)
    said: dict[str, list[str]] = {}
    for found in report.recordings:
        for text in (*(reason.text for reason in found.reasons), *found.notes):
            said.setdefault(text, []).append(printable(found.name))
    for text, names in said.items():
        everywhere = len(names) == len(report.recordings) > 1
        say(f"{f'all {len(names)} recordings' if everywhere else ', '.join(names)}: {text}")
    click.echo(report.page)


def _cells(row: RecordingReport) -> tuple[str, str, str, str, str]:
    codes = ", ".join(reason.code for reason in row.reasons)
    remark = codes if row.status == "ok" else f"{row.status} ({codes})"
    if row.detector is not None and row.detector.nearest_px is not None:
        remark += f", nearest candidate {row.detector.nearest_px:.2f} px"
    if row.labels is None and row.status == "ok":
        remark = "no labels"
    return (
        row.name,
        _error(row.detector_px),
        _error(row.baseline_px),
        _number(row.tip_error_mm),
        "failed" if row.status == "failed" else remark,
    )


def _error(error: ErrorSummary | None) -> str:
    if error is None:
        return "-"
    if error.low is None or error.high is None:
        return f"{error.mean:.2f}"
    return f"{error.mean:.2f} [{error.low:.2f}, {error.high:.2f}]"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"
