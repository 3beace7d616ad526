"""``tooltip watch``."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from tooltip_cli.cli.options import (
    PATH,
    Prefer,
    StatusLine,
    position_words,
    prefer_option,
    rig_option,
    say,
    tip_sentence,
    topic_options,
)
from tooltip_cli.cli.record_camera import camera_options, camera_source
from tooltip_cli.cli.record_robot import (
    domain_option,
    master_option,
    robot_source,
    zenoh_options,
)
from tooltip_cli.cli.recording import duration_option, patience_option, reconnect_option

if TYPE_CHECKING:
    from tooltip_cli.method.voting.params import VotingSettings
    from tooltip_cli.sources.bus import Bus
    from tooltip_cli.sources.live import LiveSource
    from tooltip_cli.stages.watch import Counts, Update, WatchOptions, WatchStatus

_Command = TypeVar("_Command", bound=Callable[..., object])
_DEFAULT = "recording"


class SourceGroup(click.Group):
    """Commands by the kind of the source; what names none of them is a recording."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Put the default's name before arguments that name no source."""
        return super().parse_args(ctx, self._with_source(ctx, args))

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command of arguments that may name no source."""
        return super().resolve_command(ctx, self._with_source(ctx, args))

    def _with_source(self, ctx: click.Context, args: list[str]) -> list[str]:
        named = not args or args[0] in (*self.commands, *ctx.help_option_names)
        return args if named else [_DEFAULT, *args]


@click.group(cls=SourceGroup, options_metavar="", subcommand_metavar="REC | SOURCE [OPTIONS]")
def watch() -> None:
    """Estimate the tip while images arrive.

    The same estimate as 'tooltip estimate', from at most 200 images that are spread over the
    hand's orientations as they come, made again every second or few: position with its
    uncertainty, the share of the images that agree, the delay, and what motion would help. It
    ends with the recording, at Ctrl-C or with --until-enough, and then gives the last estimate;
    it exits with 3 when that cannot be trusted.

    REC is a recording, which is played; 'tooltip watch recording --help' shows its options.
    SOURCE is a robot, named and described as for 'tooltip record'.

    \b
    Examples:
      tooltip watch pliers.mcap
      tooltip watch pliers.mcap --speed 0 --json
      tooltip watch ros2 --rig rig.yaml
      tooltip watch camera --camera 0 --joints udp://:9870 --rig rig.yaml --until-enough
    """


def _watch_options(command: _Command) -> _Command:
    """Add what all sources have in common."""
    for option in (
        click.option(
            "--json", "as_json", is_flag=True, help="Print each update as a line of JSON."
        ),
        click.option("--force", is_flag=True, help="Replace the file under --out if it exists."),
        click.option(
            "--out",
            type=PATH,
            metavar="DIR",
            help="Write the last estimate here as a tip file, named as the recording or source.",
        ),
        prefer_option,
        click.option(
            "--until-enough",
            is_flag=True,
            help="End once as many images are held as an estimate looks at, and show a tip.",
        ),
        click.option(
            "--every",
            type=click.FloatRange(min=0.1),
            default=1.0,
            show_default=True,
            metavar="SECONDS",
            help="Shortest time from one estimate to the next; a busy machine takes longer.",
        ),
    ):
        command = option(command)
    return command


def _live_options(command: _Command) -> _Command:
    """Add what live sources have in common."""
    for option in (
        _watch_options,
        patience_option,
        reconnect_option,
        duration_option,
        click.option(
            "--robot", type=PATH, metavar="URDF", help="Robot description, in place of any other."
        ),
        click.option(
            "--rig",
            type=PATH,
            required=True,
            metavar="FILE",
            help="Rig file: which frame is the hand, where the camera sits.",
        ),
    ):
        command = option(command)
    return command


@watch.command(_DEFAULT, short_help="Play a recording; may be left out.")
@click.argument("path", type=PATH, metavar="REC")
@click.option(
    "--speed",
    type=click.FloatRange(min=0),
    default=1.0,
    show_default=True,
    help="Times the recording's own speed; 0: as fast as possible.",
)
@rig_option
@topic_options
@_watch_options
@click.pass_context
def recording(
    ctx: click.Context,
    path: Path,
    speed: float,
    rig: Path | None,
    image: str | None,
    joints: str | None,
    info: str | None,
    pose: str | None,
    every: float,
    until_enough: bool,
    prefer: Prefer | None,
    out: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    """Play a recording and estimate the tip meanwhile.

    The word 'recording' may be left out. Images with hand labels (STEM.labels.csv) are left out, as
    'tooltip estimate' does.

    \b
    Examples:
      tooltip watch pliers.mcap
      tooltip watch recording pliers.mcap --rig robot.rig.yaml --speed 0 --json
    """
    from tooltip_cli.log.recording import Topics
    from tooltip_cli.stages.watched import watch_recording

    def run(options: WatchOptions, settings: VotingSettings, **told: Any) -> _Result:
        topics = Topics(image, joints, info, pose)
        return watch_recording(path, options, settings, rig=rig, topics=topics, speed=speed, **told)

    _run(ctx, path.stem, str(path), run, (every, until_enough, None), prefer, out, force, as_json)


@watch.command("camera", short_help="A camera and joints without ROS.")
@camera_options
@_live_options
@click.pass_context
def camera(
    ctx: click.Context,
    camera: str,
    joints: str | None,
    joint_stamps: str,
    rig: Path,
    robot: Path | None,
    duration: float | None,
    reconnect: bool,
    patience: float,
    every: float,
    until_enough: bool,
    prefer: Prefer | None,
    out: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    """Estimate the tip from a camera and a stream of joint angles, without ROS.

    The sources are those of 'tooltip record camera'. Nothing is recorded.

    \b
    Example:
      tooltip watch camera --camera http://head/stream --joints udp://:9870 --rig rig.yaml
    """
    source = camera_source(camera, joints, joint_stamps, rig, robot)
    limits = (every, until_enough, duration)
    _run(
        ctx,
        "camera",
        "camera",
        _live(source, reconnect, patience),
        limits,
        prefer,
        out,
        force,
        as_json,
    )


@watch.command("ros2", short_help="A ROS 2 robot over DDS, without ROS.")
@topic_options
@domain_option
@_live_options
@click.pass_context
def ros2(ctx: click.Context, /, domain: int, **options: Any) -> None:
    """Estimate the tip from the images and joints of a ROS 2 robot, over DDS.

    Topics are chosen as by 'tooltip record ros2'. Nothing is recorded.

    \b
    Example:
      tooltip watch ros2 --domain 7 --rig rig.yaml --until-enough
    """
    from tooltip_cli.sources.dds import DdsBus

    _watch_robot(ctx, "ros2", lambda: DdsBus(domain), **options)


@watch.command("zenoh", short_help="A ROS 2 robot over Zenoh, without ROS.")
@topic_options
@domain_option
@zenoh_options
@_live_options
@click.pass_context
def zenoh(
    ctx: click.Context,
    /,
    domain: int,
    router: str | None,
    zenoh_config: Path | None,
    **options: Any,
) -> None:
    """Estimate the tip from the images and joints of a robot that runs rmw_zenoh.

    Topics are chosen as by 'tooltip record zenoh'. Nothing is recorded.

    \b
    Example:
      tooltip watch zenoh --router tcp/robot:7447 --rig rig.yaml
    """
    from tooltip_cli.sources.zenoh_bus import ZenohBus

    _watch_robot(ctx, "zenoh", lambda: ZenohBus(domain, router, zenoh_config), **options)


@watch.command("ros1", short_help="A ROS 1 robot, without ROS.")
@topic_options
@master_option
@_live_options
@click.pass_context
def ros1(ctx: click.Context, /, master: str, **options: Any) -> None:
    """Estimate the tip from the images and joints of a ROS 1 robot.

    Topics are chosen as by 'tooltip record ros1'. Nothing is recorded.

    \b
    Example:
      tooltip watch ros1 --master http://robot:11311 --rig rig.yaml
    """
    from tooltip_cli.sources.ros1 import Ros1Bus

    _watch_robot(ctx, "ros1", lambda: Ros1Bus(master), **options)


def _watch_robot(
    ctx: click.Context,
    name: str,
    open_bus: Callable[[], Bus],
    *,
    image: str | None,
    joints: str | None,
    info: str | None,
    pose: str | None,
    rig: Path,
    robot: Path | None,
    duration: float | None,
    reconnect: bool,
    patience: float,
    every: float,
    until_enough: bool,
    prefer: Prefer | None,
    out: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    from tooltip_cli.log.recording import Topics

    topics = Topics(image, joints, info, pose)
    source = robot_source(open_bus, name, topics, rig, robot, wait=reconnect)
    limits = (every, until_enough, duration)
    run = _live(source, reconnect, patience)
    _run(ctx, name, name, run, limits, prefer, out, force, as_json)


_Result = tuple["Update", dict[str, Any]]


def _live(source: LiveSource, reconnect: bool, patience_s: float) -> Callable[..., _Result]:
    """Return what watches a live source."""
    from tooltip_cli.stages.watched import watch_live

    def run(options: WatchOptions, settings: VotingSettings, **told: Any) -> _Result:
        return watch_live(
            source, options, settings, reconnect=reconnect, patience_s=patience_s, **told
        )

    return run


def _run(
    ctx: click.Context,
    stem: str,
    name: str,
    run: Callable[..., _Result],
    limits: tuple[float, bool, float | None],
    prefer: Prefer | None,
    out: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    """Watch, say what is found, and exit."""
    from tooltip_cli.log.stopping import stop_on_signals
    from tooltip_cli.method.voting.params import VotingSettings
    from tooltip_cli.stages.watch import WatchOptions
    from tooltip_cli.stages.watched import free_for_tip, watched_document, write_tip

    path = None if out is None else free_for_tip(out, stem, force)
    line = StatusLine(name)

    def show(update: Update) -> None:
        if update.final:
            return
        if as_json:
            click.echo(json.dumps(watched_document(update, None)))
        elif not line.terminal:
            say(f"{name}: {_update_words(update)}")

    try:
        with stop_on_signals() as stop:
            last, origin = run(
                WatchOptions(*limits),
                VotingSettings(prefer=prefer),
                stop=stop,
                on_update=show,
                on_status=lambda status: line.show(_status_words(status)),
                on_note=line.note,
            )
    finally:
        line.clear()
    document = watched_document(last, origin)
    if as_json:
        click.echo(json.dumps(document))
    else:
        say(f"{name}: {_update_words(last)}")
        for reason in last.estimate.reasons:
            say(f"{name}: {last.estimate.status}: {reason.code}: {reason.text}")
        click.echo(tip_sentence(stem, document))
    if path is not None:
        write_tip(path, last, origin)
        say(f"{name}: written {path}")
    if last.estimate.position is None:
        ctx.exit(3)


def _update_words(update: Update) -> str:
    """Return an update on one line."""
    parts = [_tip_words(update), _image_words(update), *_lost_words(update.counts)]
    if update.verdict is not None:
        parts.append(update.verdict.advice)
    return f"{update.time_s:.1f} s: " + "; ".join(parts)


def _tip_words(update: Update) -> str:
    estimate = update.estimate
    if estimate.position is None or estimate.covariance is None:
        return "no tip yet (" + ", ".join(reason.code for reason in estimate.reasons) + ")"
    tip = {"position_m": estimate.position, "covariance_m2": estimate.covariance}
    codes = "".join(f" ({reason.code})" for reason in estimate.reasons)
    return f"tip at {position_words(tip)} mm{codes}"


def _image_words(update: Update) -> str:
    text = f"{update.estimate.frames_used} images"
    agreement = update.estimate.candidates[0].agreement if update.estimate.candidates else None
    if agreement is not None:
        text += f", {agreement:.0%} agree"
    return f"{text}, delay {update.delay_s:.1f} s"


def _status_words(status: WatchStatus) -> str:
    """Return the line on a terminal: advice first, for the person at the robot looks for it."""
    parts = [] if status.verdict is None else [status.verdict.advice.upper()]
    if status.ending:
        parts = ["LAST ESTIMATE"]
    update, counts = status.update, status.counts
    parts.append("no estimate yet" if update is None else _tip_words(update))
    parts += [] if update is None else [_image_words(update)]
    parts += [f"{counts.images} seen", *_lost_words(counts)]
    return " | ".join(parts)


def _lost_words(counts: Counts) -> list[str]:
    """Return how many images could not be used, where there are any."""
    lost = (
        (counts.passed_over, "passed over"),
        (counts.unreadable, "unreadable"),
        (counts.dropped, "dropped"),
    )
    return [f"{count} {what}" for count, what in lost if count]
