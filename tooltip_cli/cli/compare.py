"""``tooltip compare``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from tooltip_cli.cli.options import PATH, json_option, print_json, printable, say, table

if TYPE_CHECKING:
    from tooltip_cli.stages.compare import Comparison, Difference

_COLORS = {"better": "green", "worse": "red"}


@click.command()
@click.argument("reports", nargs=-1, required=True, type=PATH, metavar="REPORT REPORT...")
@json_option
def compare(reports: tuple[Path, ...], as_json: bool) -> None:
    """Compare reports of 'tooltip evaluate' with the first of them.

    Errors are paired frame by frame, so that a small change shows; the 95 % interval of the mean
    change decides between 'better', 'worse' and 'no difference shown'. Give folders of reports, or
    their report.json.

    \b
    Examples:
      tooltip compare report-before report-after
      tooltip compare paper/ tau80/ tau120/ --json
    """
    from tooltip_cli.stages.artifacts import plain
    from tooltip_cli.stages.compare import compare as run

    found = run(reports)
    if as_json:
        print_json(plain(found))
        return
    for comparison in found:
        _print(comparison)


def _print(comparison: Comparison) -> None:
    click.echo(f"{comparison.before} -> {comparison.after}")
    header = ("tool", "before [px]", "after [px]", "change [px]", "tip [mm]", "verdict")
    found = [*comparison.tools, *([comparison.overall] if comparison.overall else [])]
    rows = [_cells(item) for item in found]
    head, *lines = table(header, rows, left=1, words=1)
    click.secho(head, bold=True)
    for item, line in zip(found, lines, strict=True):
        click.secho(line, fg=_COLORS.get(item.verdict))
    for item in found:
        if item.remark:
            say(f"{printable(item.name)}: {item.remark}")
    for names, which in ((comparison.only_before, "before"), (comparison.only_after, "after")):
        if names:
            say(f"only {which}: {printable(', '.join(names))}")


def _cells(item: Difference) -> tuple[str, ...]:
    change = "-" if item.change_px is None else f"{item.change_px:+.2f}"
    if item.low_px is not None and item.high_px is not None:
        change += f" [{item.low_px:+.2f}, {item.high_px:+.2f}]"
    tip = "-"
    if item.before_mm is not None and item.after_mm is not None:
        tip = f"{item.before_mm:.1f} -> {item.after_mm:.1f}"
    return (
        item.name,
        "-" if item.before_px is None else f"{item.before_px:.2f}",
        "-" if item.after_px is None else f"{item.after_px:.2f}",
        change,
        tip,
        item.verdict,
    )
