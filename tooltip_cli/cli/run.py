"""``tooltip run``."""

from __future__ import annotations

import os
import re
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

import click

from tooltip_cli.cli.options import (
    METHODS,
    force_option,
    json_option,
    print_json,
    progress,
    say,
    topic_options,
)
from tooltip_cli.errors import MissingExtraError

if TYPE_CHECKING:
    from tooltip_cli.stages.shelf.run import Engine, Plan
    from tooltip_cli.stages.shelf.store import Place
    from tooltip_cli.stages.shelf.table import Row

_PART = re.compile(r"(\d+)/(\d+)")
_SHOWN = 20


def _part(
    context: click.Context, parameter: click.Parameter, text: str | None
) -> tuple[int, int] | None:
    if text is None:
        return None
    match = _PART.fullmatch(text)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise click.BadParameter(f"{text!r} is no part; write 3/16 for the third of sixteen")
    return int(match[1]), int(match[2])


@click.command()
@click.argument("shelf", metavar="SHELF")
@click.option(
    "--rig",
    metavar="PLACE",
    help="Rig file: which frame is the hand, where the camera sits. Default: the one stored in "
    "each recording.",
)
@click.option(
    "--method",
    type=click.Choice(METHODS),
    default="voting",
    show_default=True,
    help="As in 'tooltip estimate'.",
)
@click.option(
    "--jobs",
    type=click.IntRange(min=1),
    default=lambda: os.cpu_count() or 1,
    show_default="number of cores",
    help="Processes, one thread each; the result does not depend on their number.",
)
@click.option(
    "--memory",
    type=click.FloatRange(min=0, min_open=True),
    metavar="GIB",
    help="What each process may use; a recording that needs more fails alone. Default: an equal "
    "share of the machine's memory.",
)
@click.option(
    "--dask",
    metavar="ADDRESS",
    help="Scheduler of a Dask cluster, such as tcp://host:8786, whose workers do the work; or "
    "'local' for one of --jobs workers on this machine.",
)
@click.option(
    "--part",
    callback=_part,
    metavar="K/N",
    help="Only the K-th of N equal parts, for the tasks of a job array.",
)
@click.option(
    "--verify",
    is_flag=True,
    help="Read finished recordings too and compare their content, where otherwise size and time of "
    "change are believed.",
)
@click.option(
    "--out",
    metavar="PLACE",
    help="Folder of the results. Default: 'run' in SHELF, or NAME.run beside a manifest.",
)
@click.option(
    "--report/--no-report",
    default=True,
    show_default=True,
    help="Whether to write the report over all recordings; never with --part.",
)
@topic_options
@force_option
@json_option
@click.pass_context
def run(
    ctx: click.Context,
    shelf: str,
    rig: str | None,
    method: str,
    jobs: int,
    memory: float | None,
    dask: str | None,
    part: tuple[int, int] | None,
    verify: bool,
    out: str | None,
    report: bool,
    image: str | None,
    joints: str | None,
    info: str | None,
    pose: str | None,
    force: bool,
    as_json: bool,
) -> None:
    """Take many recordings through every stage.

    SHELF is a folder, a pattern in quotes, or a manifest: a CSV or Parquet table with the column
    'recording' and, where wanted, 'rig', 'labels', 'tool' and any others. Each recording is
    estimated and, where it has labels, evaluated. Whatever goes wrong with one is its row in
    the results table and does not stop the others. The same command again goes on where it was
    stopped, and tries what failed once more. Exits with 1 when a recording failed.

    Writes results.csv, results.parquet and a report over all of them to --out. Every place may also
    be an address such as s3://bucket/folder, gs://... or az://...; credentials are found as the
    provider's own tools do.

    \b
    Examples:
      tooltip run shelf --jobs 8
      tooltip run 'logs/*/*.mcap' --rig rig.yaml --out results
      tooltip run manifest.csv --part 3/16
      tooltip run /data/shelf --dask tcp://10.0.0.1:8786
      tooltip run s3://lab/shelf --out s3://lab/results
    """
    from tooltip_cli.log.recording import Topics
    from tooltip_cli.method.estimators import EstimatorParams
    from tooltip_cli.stages.shelf.plan import part_of, read_shelf
    from tooltip_cli.stages.shelf.run import plan_run, prepare
    from tooltip_cli.stages.shelf.store import place

    if dask not in (None, "local") and memory is not None:
        raise click.UsageError("--memory is for processes started here; Dask's workers have theirs")
    found = read_shelf(shelf)
    items, name = found.items, "results"
    if part is not None:
        items, name = part_of(items, *part), f"results.part-{part[0]}-of-{part[1]}"
    results = found.out if out is None else place(out)
    with progress(len(items), "plan, rows") as advance:
        plan = plan_run(
            items,
            results,
            rig=None if rig is None else place(rig),
            topics=Topics(image=image, joints=joints, info=info, pose=pose),
            params=EstimatorParams(method=method),
            force=force,
            verify=verify,
            listing=found.listing,
            on_row=advance,
        )
    prepare(plan, results / name)  # before any work
    engine = _engine(dask, jobs, _memory(memory, jobs))
    tell = say if as_json else click.echo
    rows, summary = _carry_out(plan, engine, jobs, results / name, tell)
    if report and part is None:
        summary["report"] = _report(rows, results, tell)
    if as_json:
        print_json(summary)
    if summary["failed"]:
        ctx.exit(1)


def _report(rows: Sequence[Row], results: Place, tell: Callable[[str], None]) -> str | None:
    """Write the report over all rows and return where it is."""
    from tooltip_cli.report.shelf_page import headline
    from tooltip_cli.stages.shelf.summary import REPORT, cells_of, shelf_report, write_report

    gathered = shelf_report(map(cells_of, rows), str(results))
    try:
        page = write_report(gathered, results / REPORT)
    except MissingExtraError as error:
        say(str(error))
        return None
    tell(headline(gathered))
    tell(str(page))
    return str(page)


def evaluate_shelf(ctx: click.Context, shelf: str, as_json: bool, **options: Any) -> None:
    """Write the report over a shelf: from its table of results, else after what is left to do."""
    from tooltip_cli.stages.artifacts import plain
    from tooltip_cli.stages.shelf import summary
    from tooltip_cli.stages.shelf.store import place

    path = place(shelf)
    if path.suffix.lower() not in (".csv", ".parquet") or not summary.is_results(path):
        ctx.invoke(run, shelf=shelf, as_json=as_json, **options)
        return
    out = options["out"]
    folder = path.parent / summary.REPORT if out is None else place(out)
    with progress(None, "rows") as advance:
        gathered = summary.shelf_report(summary.stored_rows(path), str(path), advance)
    page = summary.write_report(gathered, folder)
    if as_json:
        print_json(plain(gathered))
    else:
        from tooltip_cli.report.shelf_page import headline

        click.echo(headline(gathered))
        click.echo(str(page))


def _engine(dask: str | None, jobs: int, memory_bytes: int) -> Engine:
    from tooltip_cli.stages.shelf.cluster import on_dask
    from tooltip_cli.stages.shelf.pool import on_processes
    from tooltip_cli.stages.shelf.work import key_of, work_on

    if dask is None:
        return partial(on_processes, work_on, jobs=jobs, memory_bytes=memory_bytes)
    return partial(
        on_dask, work_on, address=dask, workers=jobs, memory_bytes=memory_bytes, key_of=key_of
    )


def _memory(gib: float | None, jobs: int) -> int:
    if gib is not None:
        return int(gib * 2**30)
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // jobs


def _carry_out(
    plan: Plan, engine: Engine, jobs: int, table: Place, tell: Callable[[str], None]
) -> tuple[Sequence[Row], dict[str, Any]]:
    """Do what is left, tell of each recording as it ends; return all rows and the summary."""
    from tooltip_cli.stages.shelf.run import carry_out, in_order, write_results

    if plan.finished:
        say(f"{len(plan.finished)} of {len(plan.order)} recordings are finished already")
    rows: list[Row] = []
    reused = len(plan.finished)
    try:
        with closing(carry_out(plan, engine)) as outcomes, _bar(plan, jobs) as advance:
            for outcome in outcomes:
                rows.append(outcome.row)
                reused += outcome.reused
                advance(outcome.row.name, partial(tell, _line(outcome.row, outcome.reused)))
    finally:
        everything = in_order(plan, rows)
        written = write_results(everything, table)
    summary = _summary(everything, reused, written)
    _tell_summary(summary, everything, tell)
    return everything, summary


def _line(row: Row, reused: bool) -> str:
    how = ", reused" if reused else ""
    if row.status != "ok":
        code = "" if row.code == row.status else f" ({row.code})"
        text = f"{row.status}{code}: {row.reason}"
    else:
        tip = (row.tip_x_m, row.tip_y_m, row.tip_z_m)
        axes = zip("xyz", tip, strict=True)
        text = "tip at " + ", ".join(f"{axis} {1000 * (value or 0):.1f}" for axis, value in axes)
        text += " mm" + ("" if row.error_px is None else f", error {row.error_px:.2f} px")
    return f"{row.name}: {text} ({row.seconds or 0:.1f} s{how})"


def _summary(rows: Sequence[Row], reused: int, written: Sequence[Place]) -> dict[str, Any]:
    status = Counter(row.status for row in rows)
    return {
        "recordings": len(rows),
        "ok": status["ok"],
        "refused": status["refused"],
        "failed": status["failed"],
        "reused": reused,
        "computed": len(rows) - reused,
        "reasons": dict(Counter(row.code for row in rows if row.status != "ok").most_common()),
        "results": [str(path) for path in written],
    }


def _tell_summary(
    summary: dict[str, Any], rows: Sequence[Row], tell: Callable[[str], None]
) -> None:
    failed = [row for row in rows if row.status == "failed"]
    for row in failed[:_SHOWN]:
        say(f"failed: {row.name}: {row.reason}")
    if len(failed) > _SHOWN:
        say(f"failed: {len(failed) - _SHOWN} more, with their reasons in the table")
    counts = ", ".join(f"{summary[key]} {key}" for key in ("ok", "refused", "failed"))
    tell(f"{summary['recordings']} recordings: {counts}; {summary['reused']} reused")
    for path in summary["results"]:
        tell(path)


@contextmanager
def _bar(plan: Plan, jobs: int) -> Iterator[Callable[[str, Callable[[], None]], None]]:
    """Yield a function that takes a recording that has ended and what to tell of it.

    On a terminal a line below what is told says how far the whole is.
    """
    from tooltip_cli.stages.shelf.run import TimeLeft

    if not sys.stderr.isatty():
        yield lambda name, tell: tell()
        return
    start, left = time.monotonic(), TimeLeft(sum(plan.sizes.values()))
    total = len(plan.order)

    def show() -> None:
        seconds = left.seconds(time.monotonic() - start, jobs)
        done = len(plan.finished) + left.done
        text = f"{done}/{total} ({done / total:.0%})"
        sys.stderr.write(f"\r\x1b[K{text}{'' if seconds is None else f', {_span(seconds)} left'}")
        sys.stderr.flush()

    def advance(name: str, tell: Callable[[], None]) -> None:
        nonlocal left
        left = left.after(plan.sizes[name])
        sys.stderr.write("\r\x1b[K")
        sys.stderr.flush()
        tell()
        show()

    show()
    try:
        yield advance
    finally:
        sys.stderr.write("\r\x1b[K")
        sys.stderr.flush()


def _span(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"
