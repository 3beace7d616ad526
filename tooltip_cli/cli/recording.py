"""Options and output that the sub-commands of ``tooltip record`` share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from tooltip_cli.cli.options import PATH, print_json, say, size_in_bytes

if TYPE_CHECKING:
    from tooltip_cli.rig.rigfile import Rig
    from tooltip_cli.sources.base import SourceReport

_Command = TypeVar("_Command", bound=Callable[..., Any])


def out_argument(command: _Command) -> _Command:
    """Add ``OUT.mcap``."""
    return click.argument("out", type=PATH, metavar="OUT.mcap")(command)


def result_options(command: _Command) -> _Command:
    """Add ``--force``, ``--min-free`` and ``--json``."""
    command = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")(
        command
    )
    command = click.option(
        "--min-free",
        type=size_in_bytes,
        default="100MB",
        show_default=True,
        metavar="SIZE",
        help="Stop before the disk has less than this left.",
    )(command)
    return click.option("--force", is_flag=True, help="Replace OUT.mcap if it exists.")(command)


def rig_options(command: _Command) -> _Command:
    """Add ``--rig`` and ``--robot``."""
    command = click.option(
        "--robot",
        type=PATH,
        metavar="URDF",
        help="Robot description to store in the log, in place of any other.",
    )(command)
    return click.option(
        "--rig",
        type=PATH,
        metavar="FILE",
        help="Rig file to store in the log; later commands then need none.",
    )(command)


def load_rig_file(path: Path | None) -> Rig | None:
    """Return the rig of ``--rig``."""
    from tooltip_cli.rig.rigfile import load_rig

    return load_rig(path) if path is not None else None


def load_urdf(path: Path | None) -> str | None:
    """Return the URDF of ``--robot``."""
    from tooltip_cli.sources.streams import read_urdf

    return read_urdf(path) if path is not None else None


def tell(out: Path, report: SourceReport, *, told: int = 0) -> dict[str, Any]:
    """Say what was read and left out, and return the result.

    Args:
        told: notes that were said before.
    """
    read = ", ".join(f"{count} {topic}" for topic, count in sorted(report.read.items()))
    say(f"{out}: {read}")
    for reason, count in sorted(report.dropped.items()):
        say(f"{out}: left out {count} {reason}")
    for note in report.notes[told:]:
        say(f"{out}: {note}")
    return {
        "recording": str(out),
        "read": report.read,
        "dropped": report.dropped,
        "notes": report.notes,
    }


def finish(document: dict[str, Any], as_json: bool) -> None:
    """Print the result: the recording's name, or everything as JSON."""
    if as_json:
        print_json(document)
    else:
        click.echo(document["recording"])
