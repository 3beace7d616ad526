"""``tooltip record`` from robots and cameras that send by themselves."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import click

from tooltip_cli.cli.options import (
    StatusLine,
    json_option,
    print_json,
    say,
    size_in_bytes,
    table,
    topic_options,
)
from tooltip_cli.cli.recording import (
    finish,
    load_rig_file,
    load_urdf,
    out_argument,
    result_options,
    rig_options,
    tell,
)

if TYPE_CHECKING:
    from tooltip_cli.sources.live import LiveSource
    from tooltip_cli.stages.live import LiveOptions, Status

_Command = TypeVar("_Command", bound=Callable[..., object])


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


def camera_options(command: _Command) -> _Command:
    """Add ``--camera``, ``--joints`` and ``--joint-stamps``."""
    for option in (
        click.option(
            "--joint-stamps",
            type=click.Choice(["sender", "arrival"]),
            default="sender",
            show_default=True,
            help="Whose clock the joints' stamps are, where the sender gives any.",
        ),
        click.option(
            "--joints",
            metavar="SOURCE",
            help="udp://HOST:PORT or tcp://HOST:PORT with JSON lines, a CSV file that grows, or a "
            "Python object module:factory.",
        ),
        click.option(
            "--camera",
            required=True,
            metavar="SOURCE",
            help="Number of a USB camera, http:// (MJPEG), rtsp:// or udp:// address, or a video "
            "file.",
        ),
    ):
        command = option(command)
    return command


def camera_source(
    camera: str, joints: str | None, joint_stamps: str, rig: Path | None, robot: Path | None
) -> LiveSource:
    """Return the source that ``camera_options`` and ``rig_options`` name."""
    from tooltip_cli.sources.camera import CameraSource

    return CameraSource(
        camera,
        joints,
        joints_by_arrival=joint_stamps == "arrival",
        rig=load_rig_file(rig),
        urdf=load_urdf(robot),
    )


domain_option = click.option(
    "--domain",
    type=click.IntRange(0, 232),
    default=0,
    show_default=True,
    envvar="ROS_DOMAIN_ID",
    show_envvar=True,
    metavar="N",
    help="DDS domain of the robot.",
)


def ros2_source(
    image: str | None,
    joints: str | None,
    info: str | None,
    pose: str | None,
    domain: int,
    rig: Path | None,
    robot: Path | None,
) -> LiveSource:
    """Return the source that ``topic_options``, ``domain_option`` and ``rig_options`` name."""
    from tooltip_cli.log.recording import Topics
    from tooltip_cli.sources.ros2 import Ros2Source

    topics = Topics(image, joints, info, pose)
    return Ros2Source(domain, topics, load_rig_file(rig), load_urdf(robot))


@click.command("camera", short_help="Record a camera and joints without ROS.")
@out_argument
@camera_options
@live_options
@rig_options
@result_options
def camera(
    out: Path,
    camera: str,
    joints: str | None,
    joint_stamps: str,
    duration: float | None,
    until_enough: bool,
    reconnect: bool,
    patience: float,
    queue: int,
    rig: Path | None,
    robot: Path | None,
    min_free: int,
    force: bool,
    as_json: bool,
) -> None:
    """Record a camera and a stream of joint angles, without ROS.

    Images are stamped when they arrive. JPEG from HTTP-MJPEG is stored as received, anything else
    is encoded once. A line of JSON is {"stamp": 1700000000.25, "positions": {"wrist": 0.1}}, in
    seconds since 1970 and rad or m; without 'stamp' the arrival counts.

    While it records, a line shows rates, drops and, with --rig, whether the motion is enough.
    Ctrl-C ends it and keeps everything.

    \b
    Examples:
      tooltip record camera pliers.mcap --camera 0 --joints udp://:9870 --rig rig.yaml
      tooltip record camera pliers.mcap --camera http://head/stream --joints tcp://robot:9870
      tooltip record camera pliers.mcap --camera rtsp://head/live --joints arm:joints --duration 15
    """
    from tooltip_cli.stages.live import LiveOptions

    source = camera_source(camera, joints, joint_stamps, rig, robot)
    options = LiveOptions(duration, until_enough, reconnect, patience, queue, min_free)
    _record(source, out, options, force, as_json)


@click.command("ros2", short_help="Record a ROS 2 robot, without ROS.")
@out_argument
@topic_options
@domain_option
@live_options
@rig_options
@result_options
def ros2(
    out: Path,
    image: str | None,
    joints: str | None,
    info: str | None,
    pose: str | None,
    domain: int,
    duration: float | None,
    until_enough: bool,
    reconnect: bool,
    patience: float,
    queue: int,
    rig: Path | None,
    robot: Path | None,
    min_free: int,
    force: bool,
    as_json: bool,
) -> None:
    """Record images, intrinsics, joints and robot description of a ROS 2 robot over DDS.

    No ROS is needed on this machine. Messages are stored byte for byte, with the time of their
    arrival and that of their publication. A topic that is named may begin later; of the others,
    the only one of its type that is heard within three seconds is taken.

    \b
    Examples:
      tooltip record ros2 pliers.mcap --duration 15 --rig rig.yaml
      tooltip record ros2 pliers.mcap --image /head/image_raw/compressed --domain 7
    """
    from tooltip_cli.stages.live import LiveOptions

    source = ros2_source(image, joints, info, pose, domain, rig, robot)
    options = LiveOptions(duration, until_enough, reconnect, patience, queue, min_free)
    _record(source, out, options, force, as_json)


@click.command("list", short_help="Show what can be heard.")
@domain_option
@json_option
def list_(domain: int, as_json: bool) -> None:
    """Show the topics of a ROS 2 robot: names, types, rates.

    Rates are measured over two seconds, for the types that a recording can hold.

    \b
    Examples:
      tooltip record list
      tooltip record list --domain 7 --json
    """
    from tooltip_cli.sources.dds import topic_rates

    found = topic_rates(domain, 2.0)
    if as_json:
        print_json(
            [{"topic": item.name, "type": item.datatype, "hz": rate} for item, rate in found]
        )
        return
    if not found:
        say(f"DDS domain {domain}: nothing is heard; is ROS_DOMAIN_ID the robot's?")
    rows = [
        (item.name, item.datatype, "-" if rate is None else f"{rate:.1f}") for item, rate in found
    ]
    for line in table(("topic", "type", "Hz"), rows, 2) if rows else ():
        click.echo(line)


def _record(
    source: LiveSource, out: Path, options: LiveOptions, force: bool, as_json: bool
) -> None:
    from tooltip_cli.log.stopping import stop_on_signals
    from tooltip_cli.stages.live import record_live
    from tooltip_cli.stages.watching import MotionObserver

    if source.rig is None and options.until_enough:
        raise click.UsageError("--until-enough needs --rig: without one no motion is judged")
    observer = MotionObserver(source.rig) if source.rig is not None else None
    line = StatusLine(str(out))
    try:
        with stop_on_signals() as stop:
            report = record_live(
                source,
                out,
                options,
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
