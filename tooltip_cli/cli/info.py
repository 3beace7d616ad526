"""``tooltip info``: what a recording holds, and what is wrong with it."""

from __future__ import annotations

import shutil
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tooltip_cli.cli.options import (
    PATH,
    json_option,
    print_json,
    printable,
    rig_option,
    table,
    topic_options,
    utc,
)

if TYPE_CHECKING:
    from tooltip_cli.log.streams import Stream
    from tooltip_cli.stages.info import Finding, Info


@click.command(short_help="Say what a recording holds, and what is wrong with it.")
@click.argument("recording", type=PATH, metavar="REC")
@rig_option
@topic_options
@json_option
@click.pass_context
def info(
    ctx: click.Context,
    recording: Path,
    rig: Path | None,
    image: str | None,
    joints: str | None,
    info: str | None,
    pose: str | None,
    as_json: bool,
) -> None:
    """Say what a recording holds, and what is wrong with it.

    Streams with their rates, jitter, gaps, duplicates and reversals in the order of the file; how
    images and joints stand to one another in time; the calibration, the joints against the robot,
    the hand's motion, and whether an estimate would be given. Each line has a verdict and, where
    it is not ok, a remedy. Damaged files are read as far as they are intact.

    Exits with 1 when a line is an error.

    \b
    Examples:
      tooltip info pliers.mcap
      tooltip info drive.mcap --rig rig.yaml --image /head/image_raw/compressed
      tooltip info pliers.mcap.unfinished --json
    """
    from tooltip_cli.log.recording import Topics
    from tooltip_cli.stages.artifacts import plain
    from tooltip_cli.stages.info import inspect

    topics = Topics(image=image, joints=joints, info=info, pose=pose)
    found = inspect(recording, rig=rig, topics=topics)
    if as_json:
        print_json({"verdict": found.verdict, **plain(found)})
    else:
        _print(found)
    if found.verdict == "error":
        ctx.exit(1)


def _print(found: Info) -> None:
    click.echo(
        printable(
            f"{found.path}: {found.state}, {found.size_bytes / 1e6:.1f} MB, profile "
            f"'{found.profile}', written by {found.library or 'an unnamed program'}"
        )
    )
    levels = {finding.subject: finding.level for finding in found.findings}
    if found.streams:
        first = min(stream.timing.first_ns for stream in found.streams)
        last = max(stream.timing.last_ns for stream in found.streams)
        click.echo(f"{utc(first)} to {utc(last)}\n")
        rows = [[levels[stream.topic], *_row(stream)] for stream in found.streams]
        for line in table(_HEADS, rows, left=3):
            click.echo(line)
        click.echo()
    # a stream that is well has said so in the table
    topics = {stream.topic for stream in found.streams}
    shown = [item for item in found.findings if item.level != "ok" or item.subject not in topics]
    width = max((len(finding.subject) for finding in shown), default=0)
    for finding in shown:
        for line in _lines(finding, width):
            click.echo(line)


_HEADS = (
    "",
    "topic",
    "type",
    "count",
    "Hz",
    "jitter ms",
    "gaps",
    "longest s",
    "twice",
    "back",
    "late ms",
)


def _row(stream: Stream) -> list[str]:
    times = stream.timing
    return [
        stream.topic,
        stream.datatype.rpartition("/")[2] or stream.encoding,
        str(times.count),
        f"{times.rate_hz:.1f}" if times.rate_hz else "-",
        f"{1000 * times.jitter_s:.1f}",
        str(times.gaps),
        f"{times.longest_gap_s:.2f}",
        str(times.duplicates),
        str(times.reversals),
        "-" if stream.latency_s is None else f"{1000 * stream.latency_s:.1f}",
    ]


def _lines(finding: Finding, width: int) -> list[str]:
    """Return a finding, wrapped to the terminal, with its remedy on lines of its own."""
    head = printable(f"{finding.level:<9}{finding.subject:<{width + 2}}")
    room = max(shutil.get_terminal_size().columns, len(head) + 40)
    indent = " " * len(head)
    lines = _wrapped(finding.text, room, head, indent)
    if finding.remedy:
        lines += _wrapped(finding.remedy, room, f"{indent}-> ", f"{indent}   ")
    return lines


def _wrapped(text: str, room: int, first: str, others: str) -> list[str]:
    return textwrap.wrap(
        printable(text),
        room,
        initial_indent=first,
        subsequent_indent=others,
        break_long_words=False,
        break_on_hyphens=False,
    )
