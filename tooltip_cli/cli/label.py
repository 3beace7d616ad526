"""``tooltip label``: the labelling page, and labels from and for other tools."""

from __future__ import annotations

import getpass
import os
import sys
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from tooltip_cli.cli.options import (
    PATH,
    json_option,
    print_json,
    rig_option,
    say,
    topic_options,
)
from tooltip_cli.errors import MissingExtraError, TooltipError

_Command = TypeVar("_Command", bound=Callable[..., Any])
_FORMATS = ("cvat", "coco", "labelstudio", "labelme", "deeplabcut")


class _PageByDefault(click.Group):
    """A group that takes whatever is none of its commands for the arguments of ``page``."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the commands, the default first."""
        return list(self.commands)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command that is meant, and its arguments."""
        return super().resolve_command(ctx, args if args[0] in self.commands else ["page", *args])


def _place_options(command: _Command) -> _Command:
    """Add ``--out`` and the topics."""
    return click.option(
        "--out", type=PATH, help="Directory of the labels. Default: beside the recording."
    )(topic_options(command))


def _test_options(command: _Command) -> _Command:
    """Add ``--test``, ``--seed`` and ``--split``, as 'evaluate' has them."""
    for option in (
        click.option(
            "--split",
            type=click.Choice(["random", "blocks"]),
            default="random",
            show_default=True,
            help="Test frames at random as in the paper, or in contiguous blocks.",
        ),
        click.option("--seed", type=int, default=0, show_default=True, help="Of the split."),
        click.option(
            "--test",
            type=click.IntRange(min=1),
            default=100,
            show_default=True,
            help="How many test frames.",
        ),
    ):
        command = option(command)
    return command


@click.group(
    cls=_PageByDefault,
    # an option before REC is page's
    context_settings={"ignore_unknown_options": True},
    options_metavar="",
    subcommand_metavar="REC [OPTIONS] | COMMAND [ARGS]...",
)
def label() -> None:
    """Label the tip in the test frames, on a page in the browser.

    'tooltip label REC' is short for 'tooltip label page REC', whose --help lists the options.

    \b
    Examples:
      tooltip label pliers.mcap
      tooltip label pliers.mcap --labeler ana --blind
      tooltip label import pliers.mcap annotations.xml
      tooltip label export pliers.mcap pliers.json --format coco
    """


@label.command(short_help="Label on a page in the browser (the default).")
@click.argument("recording", type=PATH, metavar="REC")
@click.option("--labeler", metavar="NAME", help="Who labels. Default: the user's name.")
@click.option(
    "--blind",
    is_flag=True,
    help="Make a second, independent set for the same frames, STEM.labels.NAME.csv: nobody else's "
    "labels and no hints are shown.",
)
@_test_options
@click.option(
    "--frames",
    metavar="all|N",
    help="Label all images, or N that are evenly spread, in place of the split's test frames.",
)
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=0,
    show_default=True,
    help="Port on 127.0.0.1; 0 takes a free one.",
)
@click.option("--browser/--no-browser", default=True, help="Whether to open the browser.")
@rig_option
@_place_options
@click.pass_context
def page(
    ctx: click.Context,
    recording: Path,
    labeler: str | None,
    blind: bool,
    test: int,
    seed: int,
    split: str,
    frames: str | None,
    port: int,
    browser: bool,
    rig: Path | None,
    out: Path | None,
    image: str | None,
    joints: str | None,
    info: str | None,
    pose: str | None,
) -> None:
    """Label the tip in the test frames of a recording, on a page in the browser.

    Shows exactly the test frames that 'evaluate' would choose. A click places the point, the arrow
    keys move it, F and D change the frame, and ? lists everything else. Every change is saved at
    once in STEM.labels.csv. Ctrl-C ends it; the next time it goes on where it was.

    The page is served to this machine alone, at an address that nobody can guess.

    \b
    Examples:
      tooltip label page pliers.mcap
      tooltip label page pliers.mcap --test 50 --seed 1
      tooltip label page pliers.mcap --labeler ben --blind
    """
    try:
        from tooltip_cli.labels.server import LabelServer
    except ImportError as error:
        raise MissingExtraError("label", "label", error.name or "starlette") from error
    from tooltip_cli.log.recording import Topics
    from tooltip_cli.stages.label import Labeler, Selection, open_session

    chosen = ("test", "seed", "split", "frames")
    given = any(ctx.get_parameter_source(name) is not _DEFAULT for name in chosen)
    selection = Selection(test, 400, seed, split, _count(frames), given)
    topics = Topics(image=image, joints=joints, info=info, pose=pose)
    name = Labeler(labeler or _user(), blind)
    with open_session(
        recording, name, selection=selection, topics=topics, rig=rig, out=out
    ) as session:
        for note in session.notes:
            say(f"{recording}: {note}")
        server = LabelServer(session, port)
        click.echo(server.url)
        say(f"{len(session.frames)} frames of {recording}, into {session.book.path}; Ctrl-C ends")
        if browser:
            _open(server.url)
        server.run()
        entries = session.book.entries(session.stamps_ns)
        done = sum(entry.label is not None for entry in entries)
        say(f"{session.book.path}: {done} of {len(entries)} frames labelled")


_DEFAULT = click.core.ParameterSource.DEFAULT


def _open(url: str) -> None:
    """Open a page; without a display Python would start a browser in this very terminal."""
    if sys.platform == "darwin" or {"DISPLAY", "WAYLAND_DISPLAY", "BROWSER"} & os.environ.keys():
        webbrowser.open(url)
    else:
        say("no display was found; open the address in a browser on this machine")


def _count(frames: str | None) -> int | None:
    if frames is None:
        return None
    if frames == "all":
        return 0
    if not (frames.isascii() and frames.isdecimal() and int(frames) > 0):
        raise click.BadParameter(f"'{frames}' is neither 'all' nor a number", param_hint="--frames")
    return int(frames)


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError) as error:  # no such user, as in some containers
        raise TooltipError("the user has no name; say who labels with --labeler") from error


@label.command("import", short_help="Take labels that were made with another tool.")
@click.argument("recording", type=PATH, metavar="REC")
@click.argument("labels", type=PATH, metavar="FILE")
@click.option("--point", metavar="NAME", help="Which point is the tip, where there are several.")
@click.option("--annotator", metavar="NAME", help="Whose labels, where several people made them.")
@click.option(
    "--labeler", metavar="NAME", help="Who labelled. Default: whom the file names, or its tool."
)
@click.option("--blind", is_flag=True, help="A second set: STEM.labels.NAME.csv, with --labeler.")
@click.option(
    "--origin",
    type=click.Choice(["corner", "centre"]),
    help="Where in the first pixel (0, 0) lies. Default: as the tool has it.",
)
@click.option(
    "--numbers",
    type=click.Choice(["recording", "test"]),
    default="recording",
    show_default=True,
    help="What frame numbers count: all images, or the test frames.",
)
@click.option("--first", type=int, default=0, show_default=True, help="Number of the first frame.")
@_test_options
@_place_options
@click.option("--force", is_flag=True, help="Replace the labels that are there.")
@json_option
def import_(
    recording: Path,
    labels: Path,
    point: str | None,
    annotator: str | None,
    labeler: str | None,
    blind: bool,
    origin: str | None,
    numbers: str,
    first: int,
    test: int,
    seed: int,
    split: str,
    out: Path | None,
    image: str | None,
    joints: str | None,
    info: str | None,
    pose: str | None,
    force: bool,
    as_json: bool,
) -> None:
    """Take labels that were made with another tool.

    FILE is CVAT 1.1 XML (for video or for images), COCO keypoints JSON, Label Studio JSON, a
    labelme JSON file or a folder of them, or DeepLabCut's CollectedData CSV. Images are found by
    their stamp in nanoseconds in the file's name, else by the number at its end. What nobody
    placed by hand (interpolated frames, visibility 0, empty cells) is left out, and counted.

    A recording that is called 'import' is labelled with 'tooltip label ./import'.

    \b
    Examples:
      tooltip label import pliers.mcap annotations.xml
      tooltip label import pliers.mcap person_keypoints.json --point tip --origin corner
      tooltip label import pliers.mcap labelme_folder --labeler ben --blind
    """
    from tooltip_cli.labels.exchange import Choice
    from tooltip_cli.log.recording import Topics
    from tooltip_cli.stages.exchange import import_labels
    from tooltip_cli.stages.label import Selection

    if blind and labeler is None:
        raise click.UsageError("--blind needs --labeler, which names the file")
    corner = None if origin is None else origin == "corner"
    done = import_labels(
        recording,
        labels,
        choice=Choice(point, annotator, corner, labeler),
        blind=blind,
        numbered=Selection(test, 400, seed, split) if numbers == "test" else None,
        first=first,
        topics=Topics(image=image, joints=joints, info=info, pose=pose),
        out=out,
        force=force,
    )
    counts = ", ".join(f"{count} {state}" for state, count in sorted(done.states.items()))
    say(f"{labels}: {counts}, from {done.tool}")
    for note in done.notes:
        say(f"{labels}: {note}")
    if as_json:
        print_json(
            {
                "labels": str(done.path),
                "tool": done.tool,
                "states": done.states,
                "notes": done.notes,
            }
        )
    else:
        click.echo(done.path)


@label.command(short_help="Write labels for another tool.")
@click.argument("recording", type=PATH, metavar="REC")
@click.argument("target", type=PATH, metavar="OUT")
@click.option("--format", "tool", type=click.Choice(_FORMATS), required=True, help="Whose file.")
@click.option("--labels", type=PATH, metavar="CSV", help="Default: STEM.labels.csv.")
@click.option("--images", type=PATH, metavar="DIR", help="Write the labelled images there, too.")
@_place_options
@click.option("--force", is_flag=True, help="Replace files that are there.")
def export(
    recording: Path,
    target: Path,
    tool: str,
    labels: Path | None,
    images: Path | None,
    out: Path | None,
    image: str | None,
    joints: str | None,
    info: str | None,
    pose: str | None,
    force: bool,
) -> None:
    """Write labels for another tool, or its task to label the test frames where there are none.

    OUT is a file, with labelme a folder. Images are called by their stamps, by which 'import'
    finds them again. CVAT's frame numbers are those of the recording. A tip that is not visible
    has no place, which CVAT, COCO and DeepLabCut cannot say; see docs/file-formats.md.

    \b
    Examples:
      tooltip label export pliers.mcap pliers.xml --format cvat
      tooltip label export pliers.mcap tasks.json --format labelstudio --images images
    """
    from tooltip_cli.log.recording import Topics
    from tooltip_cli.stages.exchange import export_labels

    files = export_labels(
        recording,
        target,
        tool,
        labels=labels,
        images=images,
        topics=Topics(image=image, joints=joints, info=info, pose=pose),
        out=out,
        force=force,
    )
    say(f"{target}: {len(files)} files written")
    click.echo(target)
