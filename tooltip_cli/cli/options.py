"""Options and output that several commands share."""

from __future__ import annotations

import datetime
import json
import math
import re
import shutil
import sys
import time
import unicodedata
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from tooltip_cli.errors import TooltipError

if TYPE_CHECKING:
    from tooltip_cli.method.estimators import EstimatorParams
    from tooltip_cli.stages.clock import Stopwatch

_Command = TypeVar("_Command", bound=Callable[..., Any])

PATH = click.Path(path_type=Path)
METHODS = ("voting", "kmeans", "map")
Prefer = tuple[float, float, float]
_PATIENCE_S = 1.0
_RESULTS = (".detections.mcap", ".edges.mcap")


def size_in_bytes(text: str) -> int:
    """Return the bytes of a size such as 500MB, 1GB (powers of 1000) or 1GiB (of 1024)."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([kmgt]?)(i?)b?", text.strip().lower())
    if match is None:
        raise click.BadParameter(f"'{text}' is no size; give one such as 500MB or 1GB")
    number, prefix, binary = match.groups()
    power = " kmgt".index(prefix or " ")
    return int(float(number) * (1024 if binary else 1000) ** power)


def recordings_argument(command: _Command) -> _Command:
    """Add ``REC...``."""
    return click.argument(
        "recordings",
        nargs=-1,
        required=True,
        type=PATH,
        metavar="REC...",
        callback=lambda ctx, parameter, paths: without_results(paths),
    )(command)


def without_results(paths: tuple[Path, ...]) -> tuple[Path, ...]:
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


def preset_option(text: str) -> Callable[[_Command], _Command]:
    """Add ``--preset``, with what the choice means for this command."""
    return click.option(
        "--preset",
        type=click.Choice(["voting", "paper"]),
        default="voting",
        show_default=True,
        help=text,
    )


PRESET_OF_DETECTIONS = (
    "Which detections to take, where any are: voting: looked for near the hand. paper: among all "
    "edges, as in the paper."
)


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


def plural(count: int, noun: str) -> str:
    """Return "1 image", "2 images"."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def utc(stamp_ns: int) -> str:
    """Return a time as people read it, to the millisecond."""
    time = datetime.datetime.fromtimestamp(stamp_ns // 10**9, datetime.timezone.utc)
    return f"{time:%Y-%m-%dT%H:%M:%S}.{stamp_ns // 10**6 % 1000:03}Z"


def printable(text: str) -> str:
    """Return text on one line; names out of a log may hold line breaks and terminal codes."""
    return "".join(char if char.isprintable() else " " for char in text)


def table(
    heads: Sequence[str], rows: Sequence[Sequence[str]], left: int, words: int = 0
) -> list[str]:
    """Return the lines of a table; the first ``left`` and the last ``words`` columns hold words,
    which begin at the left."""
    cells = [[printable(cell) for cell in row] for row in (heads, *rows)]
    widths = [max(map(columns, column)) for column in zip(*cells, strict=True)]

    def padded(at: int, cell: str) -> str:
        space = " " * (widths[at] - columns(cell))
        return cell + space if at < left or at >= len(heads) - words else space + cell

    return ["  ".join(padded(at, cell) for at, cell in enumerate(row)).rstrip() for row in cells]


def columns(text: str) -> int:
    """Return how many columns of a terminal a text takes: a Chinese character takes two."""
    return sum(
        0 if unicodedata.combining(char) else 1 + (unicodedata.east_asian_width(char) in "WF")
        for char in text
    )


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


class StatusLine:
    """One line on stderr that is written over, where that is a terminal; notes stay.

    Args:
        name: what notes are about.
    """

    def __init__(self, name: str) -> None:
        self._name, self.terminal = name, sys.stderr.isatty()

    def show(self, text: str) -> None:
        """Show how things stand."""
        if self.terminal:
            # a line that wraps could not be written over
            text = text[: shutil.get_terminal_size().columns - 1]
            sys.stderr.write(f"\r\x1b[K{text}")
            sys.stderr.flush()

    def note(self, text: str) -> None:
        """Say something that stays."""
        self.clear()
        say(f"{self._name}: {printable(text)}")

    def clear(self) -> None:
        """Remove the line."""
        if self.terminal:
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()


class Direction(click.ParamType):  # type: ignore[type-arg]  # generic in newer click only
    """A direction as three numbers, ``X,Y,Z``."""

    name = "direction"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> Prefer:
        """Return the three numbers."""
        try:
            x, y, z = (float(part) for part in value.split(","))
        except ValueError:
            self.fail(f"'{value}' is not three numbers like 0.1,0,0.2", param, ctx)
        if not all(math.isfinite(part) for part in (x, y, z)) or not any((x, y, z)):
            self.fail(f"'{value}' points nowhere", param, ctx)
        return x, y, z


prefer_option = click.option(
    "--prefer",
    type=Direction(),
    metavar="X,Y,Z",
    help="Of several ends, named (ambiguous_end) or not, take the one farthest in this direction, "
    "hand frame; its position in tip.json will do. For --method voting.",
)


refine_option = click.option(
    "--refine",
    type=click.Choice(("auto", "none", "time", "all")),
    default="auto",
    show_default=True,
    help="Find the offset of the image clock (time), and where the camera really is (all), from "
    "the same images, and use what clearly helps; auto: all, where the images disagree about the "
    "end. 'tooltip calibrate' writes it as a rig file. For --method voting.",
)


def estimator_params(
    method: str, prefer: Prefer | None, refine: str, from_labels: Path | None = None
) -> EstimatorParams:
    """Return the parameters that --method, --prefer and --refine choose.

    Raises:
        click.UsageError: --refine where it has no use.
    """
    from tooltip_cli.method.estimators import EstimatorParams
    from tooltip_cli.method.voting.params import VotingSettings

    if refine in ("time", "all") and (method != "voting" or from_labels is not None):
        raise click.UsageError("--refine works from images with --method voting alone")
    return EstimatorParams(method=method, voting=VotingSettings(prefer=prefer, put_right=refine))


def tip_sentence(name: str, document: dict[str, Any]) -> str:
    """Say in words what ``tip.json`` holds."""
    if document["status"] == "refused":
        codes = ", ".join(reason["code"] for reason in document["reasons"])
        return f"{name}: refused ({codes})"
    return (
        f"{name}: tip at {position_words(document['tip'])} mm in the hand frame "
        f"({document['method']}, {document['frames_used']} frames)"
    )


def position_words(tip: dict[str, Any]) -> str:
    """Return a tip's coordinates with their standard deviations, millimetres."""
    variances = [tip["covariance_m2"][axis][axis] for axis in range(3)]
    return ", ".join(
        f"{name} {1000 * value:.1f} +-{1000 * variance**0.5:.1f}"
        for name, value, variance in zip("xyz", tip["position_m"], variances, strict=True)
    )
