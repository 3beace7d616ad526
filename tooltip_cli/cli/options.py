"""Options and output that several commands share."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from tooltip_cli.errors import TooltipError

if TYPE_CHECKING:
    from tooltip_cli.stages.clock import Stopwatch

_Command = TypeVar("_Command", bound=Callable[..., Any])

PATH = click.Path(path_type=Path)
METHODS = ("voting", "kmeans", "map")
_PATIENCE_S = 1.0
_RESULTS = (".detections.mcap", ".edges.mcap")


def recordings_argument(command: _Command) -> _Command:
    """Add ``REC...``."""
    return click.argument(
        "recordings",
        nargs=-1,
        required=True,
        type=PATH,
        metavar="REC...",
        callback=lambda ctx, parameter, paths: _without_results(paths),
    )(command)


def _without_results(paths: tuple[Path, ...]) -> tuple[Path, ...]:
    """Leave out our own results, so that ``*.mcap`` still means the recordings beside them."""
    kept = tuple(path for path in paths if not path.name.endswith(_RESULTS))
    return kept or paths


def check_names(recordings: Sequence[Path], out: Path | None) -> None:
    """Refuse recordings whose results would overwrite one another under ``--out``.

    Raises:
        TooltipError: two different recordings have the same name.
    """
    if out is None:
        return
    seen: dict[str, Path] = {}
    for path in recordings:
        other = seen.setdefault(path.stem, path)
        if other != path:
            raise TooltipError(
                f"{other} and {path} have the same name, so their results under {out} would be "
                "one; run them with an --out each"
            )


def rig_option(command: _Command) -> _Command:
    """Add ``--rig``."""
    return click.option(
        "--rig",
        type=PATH,
        help="Rig file: which frame is the hand, where the camera sits. Default: the one stored "
        "in the recording.",
    )(command)


def out_option(command: _Command) -> _Command:
    """Add ``--out``."""
    return click.option(
        "--out", type=PATH, help="Directory for the results. Default: beside each recording."
    )(command)


def force_option(command: _Command) -> _Command:
    """Add ``--force``."""
    return click.option("--force", is_flag=True, help="Compute again even where nothing changed.")(
        command
    )


def json_option(command: _Command) -> _Command:
    """Add ``--json``."""
    return click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")(
        command
    )


def profile_option(command: _Command) -> _Command:
    """Add ``--profile``."""
    return click.option(
        "--profile", is_flag=True, help="Say where the processor time went, on stderr."
    )(command)


def say_profile(name: str, stopwatch: Stopwatch | None) -> None:
    """Write where a stopwatch's time went; nothing where there is none."""
    if stopwatch is None:
        return
    total = max(stopwatch.total(), 1e-9)
    rest = total - sum(stopwatch.seconds.values())
    say(f"{name}: {total:.2f} s of processor time")
    for step, seconds in [*stopwatch.seconds.items(), ("rest", rest)]:
        say(f"  {step:13s}{seconds:8.2f} s {seconds / total:5.0%}")


def jobs_option(command: _Command) -> _Command:
    """Add ``--jobs``."""
    return click.option(
        "--jobs",
        type=click.IntRange(min=1),
        default=1,
        show_default=True,
        help="Threads; the result does not depend on their number.",
    )(command)


def topic_options(command: _Command) -> _Command:
    """Add ``--image``, ``--joints``, ``--info`` and ``--pose``."""
    for name, what in (
        ("pose", "hand poses"),
        ("info", "camera intrinsics"),
        ("joints", "joint states"),
        ("image", "images"),
    ):
        command = click.option(
            f"--{name}", metavar="TOPIC", help=f"Topic of the {what}, where there are several."
        )(command)
    return command


def say(message: str) -> None:
    """Write a message for the person at the terminal."""
    click.echo(message, err=True)


def print_json(document: Any) -> None:
    """Write a result for a machine."""
    click.echo(json.dumps(document, indent=1))


@contextmanager
def progress(total: int | None, label: str) -> Iterator[Callable[[], None]]:
    """Yield a callable to call after each unit of work.

    A line on stderr appears where that is a terminal and the work takes more than a second.
    """
    if not sys.stderr.isatty():
        yield lambda: None
        return
    start = shown = time.monotonic()
    done = 0

    def advance() -> None:
        nonlocal done, shown
        done += 1
        now = time.monotonic()
        if now - start < _PATIENCE_S or now - shown < 0.1:
            return
        shown = now
        text = f"{label}: {done}"
        if total:
            left = (now - start) / done * max(total - done, 0)
            text = f"{label}: {done}/{total} ({done / total:.0%}), {left:.0f} s left"
        sys.stderr.write(f"\r\x1b[K{text}")
        sys.stderr.flush()

    try:
        yield advance
    finally:
        if shown > start:
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()
