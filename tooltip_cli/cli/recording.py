"""Options and output that the sub-commands of ``tooltip record`` share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from tooltip_cli.cli.options import PATH, StatusLine, print_json, say, size_in_bytes

if TYPE_CHECKING:
    from tooltip_cli.rig.rigfile import Rig
    from tooltip_cli.sources.base import SourceReport
    from tooltip_cli.sources.live import LiveSource
    from tooltip_cli.stages.live import Status

_Command = TypeVar("_Command", bound=Callable[..., Any])


def out_argument(command: _Command) -> _Command:
    """Add ``OUT.mcap``."""
    return click.argument("out", type=PATH, metavar="OUT.mcap")(command)


patience_option = click.option(
    "--patience",
    type=click.FloatRange(min=0.1),
    default=10.0,
    show_default=True,
    metavar="SECONDS",
    help="End after so long without an image.",
)
reconnect_option = click.option(
    "--reconnect",
    is_flag=True,
    help="Wait for a source that is not there or disappears, instead of ending.",
)
duration_option = click.option(
    "--duration",
    type=click.FloatRange(min=0, min_open=True),
    metavar="SECONDS",
    help="End so long after the first image. Default: at Ctrl-C.",
)


def live_options(command: _Command) -> _Command:
    """Add what all live recordings have in common."""
    for option in (
        click.option(
            "--queue",
            type=size_in_bytes,
            default="256MB",
            show_default=True,
            metavar="SIZE",
            help="Memory for what is received and not yet written; what does not fit is dropped "
            "and counted.",
        ),
        patience_option,
        reconnect_option,
        click.option(
            "--until-enough",
            is_flag=True,
            help="End once the motion has shown all that an estimate looks at; needs --rig.",
        ),
        duration_option,
    ):
        command = option(command)
    return command


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


def record_until_end(
    source: LiveSource,
    out: Path,
    *,
    duration: float | None,
    until_enough: bool,
    reconnect: bool,
    patience: float,
    queue: int,
    min_free: int,
    force: bool,
    as_json: bool,
) -> None:
    """Record by :func:`live_options`, with a line that says how it stands; print the result."""
    from tooltip_cli.log.stopping import stop_on_signals
    from tooltip_cli.stages.live import LiveOptions, record_live
    from tooltip_cli.stages.watching import MotionObserver

    if source.rig is None and until_enough:
        raise click.UsageError("--until-enough needs --rig: without one no motion is judged")
    observer = MotionObserver(source.rig) if source.rig is not None else None
    line = StatusLine(str(out))
    try:
        with stop_on_signals() as stop:
            report = record_live(
                source,
                out,
                LiveOptions(duration, until_enough, reconnect, patience, queue, min_free),
                stop=stop,
                overwrite=force,
                observer=observer,
                on_status=lambda status: line.show(status_text(status)),
                on_note=line.note,
            ).report
    finally:
        line.clear()
    document = tell(out, report, told=len(report.notes))
    verdict = observer.verdict(now=True) if observer is not None else None
    if verdict is not None:
        say(
            f"{out}: motion: {verdict.advice} ({verdict.frames} usable images, seen from "
            f"directions {verdict.view_deg:.0f} degrees apart)"
        )
        document["motion"] = {
            "verdict": verdict.code,
            "frames": verdict.frames,
            "view_deg": verdict.view_deg,
            "turn_deg": verdict.turn_deg,
        }
    finish(document, as_json)


def status_text(status: Status) -> str:
    """Return the line: the verdict first, for it is what the person at the robot looks for."""
    parts = []
    verdict = status.verdict
    if verdict is not None:
        parts.append(verdict.advice.upper())
        if verdict.frames or verdict.motion_px:
            parts.append(
                f"{verdict.frames}/{verdict.wanted_frames} images, {verdict.view_deg:.0f} deg, "
                f"{verdict.motion_px:.1f} px/image"
            )
    parts.append(f"{status.elapsed_s:.0f} s")
    for stream in status.streams:
        if stream.expected or stream.dropped:
            rate = "SILENT" if stream.silent else f"{stream.rate_hz:.0f} Hz"
            lost = f" ({stream.dropped} dropped)" if stream.dropped else ""
            parts.append(f"{stream.topic} {rate}{lost}")
    parts.append(f"{status.size_bytes / 1e6:.0f} MB, {status.free_bytes / 1e9:.0f} GB free")
    if status.queued_bytes > 10_000_000:
        parts.append(f"queue {status.queued_bytes / 1e6:.0f} MB")
    return " | ".join(parts)
