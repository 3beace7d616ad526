"""``tooltip record`` from robots and cameras that send by themselves."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from tooltip_cli.cli.options import (
    PATH,
    json_option,
    print_json,
    printable,
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
from tooltip_cli.errors import TooltipError

if TYPE_CHECKING:
    from tooltip_cli.sources.bus import Bus
    from tooltip_cli.sources.live import LiveSource
    from tooltip_cli.stages.live import LiveOptions, Status

_Command = TypeVar("_Command", bound=Callable[..., object])
TRANSPORTS = ("ros2", "zenoh", "ros1")


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
        click.option(
            "--patience",
            type=click.FloatRange(min=0.1),
            default=10.0,
            show_default=True,
            metavar="SECONDS",
            help="End after so long without an image.",
        ),
        click.option(
            "--reconnect",
            is_flag=True,
            help="Wait for a source that is not there or disappears, instead of ending.",
        ),
        click.option(
            "--until-enough",
            is_flag=True,
            help="End once the motion has shown all that an estimate looks at; needs --rig.",
        ),
        click.option(
            "--duration",
            type=click.FloatRange(min=0, min_open=True),
            metavar="SECONDS",
            help="End so long after the first image. Default: at Ctrl-C.",
        ),
    ):
        command = option(command)
    return command


@click.command("camera", short_help="Record a camera and joints without ROS.")
@out_argument
@click.option(
    "--camera",
    required=True,
    metavar="SOURCE",
    help="Number of a USB camera, http:// (MJPEG), rtsp:// or udp:// address, or a video file.",
)
@click.option(
    "--joints",
    metavar="SOURCE",
    help="udp://HOST:PORT or tcp://HOST:PORT with JSON lines, rtde://HOST of a UR robot, a CSV "
    "file that grows, or a Python object module:factory.",
)
@click.option(
    "--joint-stamps",
    type=click.Choice(["sender", "arrival"]),
    default="sender",
    show_default=True,
    help="Whose clock the joints' stamps are, where the sender gives any.",
)
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
      tooltip record camera pliers.mcap --camera /dev/video2 --joints rtde://192.168.0.10
      tooltip record camera pliers.mcap --camera rtsp://head/live --joints arm:joints --duration 15
    """
    from tooltip_cli.sources.camera import CameraSource
    from tooltip_cli.stages.live import LiveOptions

    by_arrival = joint_stamps == "arrival"
    source = CameraSource(
        camera,
        joints,
        joints_by_arrival=by_arrival,
        rig=load_rig_file(rig),
        urdf=load_urdf(robot),
    )
    options = LiveOptions(duration, until_enough, reconnect, patience, queue, min_free)
    _record(source, out, options, force, as_json)


def robot_options(command: _Command) -> _Command:
    """Add what recordings of a robot on a network have in common."""
    for group in (topic_options, live_options, rig_options, result_options):
        command = group(command)
    return command


def domain_option(command: _Command) -> _Command:
    """Add ``--domain``."""
    return click.option(
        "--domain",
        type=click.IntRange(0, 232),
        default=0,
        show_default=True,
        envvar="ROS_DOMAIN_ID",
        show_envvar=True,
        metavar="N",
        help="Domain of a ROS 2 robot.",
    )(command)


def zenoh_options(command: _Command) -> _Command:
    """Add ``--router`` and ``--zenoh-config``."""
    command = click.option(
        "--zenoh-config",
        type=PATH,
        envvar="ZENOH_SESSION_CONFIG_URI",
        show_envvar=True,
        metavar="FILE",
        help="Configuration of the Zenoh session, as rmw_zenoh takes it.",
    )(command)
    return click.option(
        "--router",
        metavar="ENDPOINT",
        help="Zenoh router of the robot.  [default: tcp/localhost:7447]",
    )(command)


def master_option(command: _Command) -> _Command:
    """Add ``--master``."""
    return click.option(
        "--master",
        envvar="ROS_MASTER_URI",
        show_envvar=True,
        default="http://localhost:11311",
        show_default=True,
        metavar="URI",
        help="ROS 1 master.",
    )(command)


@click.command("ros2", short_help="Record a ROS 2 robot over DDS, without ROS.")
@out_argument
@domain_option
@robot_options
def ros2(out: Path, domain: int, **options: Any) -> None:
    """Record images, intrinsics, joints and robot description of a ROS 2 robot over DDS.

    No ROS is needed on this machine. Messages are stored byte for byte, with the time of their
    arrival and that of their publication. A topic that is named may begin later; of the others,
    the only one of its type that is heard within three seconds is taken.

    \b
    Examples:
      tooltip record ros2 pliers.mcap --duration 15 --rig rig.yaml
      tooltip record ros2 pliers.mcap --image /head/image_raw/compressed --domain 7
    """
    from tooltip_cli.sources.dds import DdsBus

    _record_robot(lambda: DdsBus(domain), out, **options)


@click.command("zenoh", short_help="Record a ROS 2 robot over Zenoh, without ROS.")
@out_argument
@domain_option
@zenoh_options
@robot_options
def zenoh(
    out: Path, domain: int, router: str | None, zenoh_config: Path | None, **options: Any
) -> None:
    """Record images, intrinsics, joints and robot description of a robot that runs rmw_zenoh.

    No ROS is needed on this machine, only the network to the robot's Zenoh router. Messages are
    stored byte for byte, with the time of their arrival and that of their publication. A topic that
    is named may begin later; of the others, the only one of its type that is heard within three
    seconds is taken.

    \b
    Examples:
      tooltip record zenoh pliers.mcap --router tcp/robot:7447 --rig rig.yaml
      tooltip record zenoh pliers.mcap --image /head/image_raw/compressed --duration 15
    """
    from tooltip_cli.sources.zenoh_bus import ZenohBus

    _record_robot(lambda: ZenohBus(domain, router, zenoh_config), out, **options)


@click.command("ros1", short_help="Record a ROS 1 robot, without ROS.")
@out_argument
@master_option
@robot_options
def ros1(out: Path, master: str, **options: Any) -> None:
    """Record images, intrinsics, joints and robot description of a ROS 1 robot.

    No ROS is needed on this machine, and nothing is registered with the master. Messages are stored
    as ROS 2 has them, with the time of their arrival. A topic that is named may begin later; of the
    others, the only one of its type that is published within three seconds is taken.

    \b
    Examples:
      tooltip record ros1 pliers.mcap --master http://robot:11311 --rig rig.yaml
      tooltip record ros1 pliers.mcap --image /head/image_raw/compressed --duration 15
    """
    from tooltip_cli.sources.ros1 import Ros1Bus

    _record_robot(lambda: Ros1Bus(master), out, **options)


@click.command("list", short_help="Show what can be heard.")
@click.option(
    "--on",
    "transports",
    type=click.Choice(TRANSPORTS),
    multiple=True,
    help="Listen there only; may be given several times.",
)
@domain_option
@zenoh_options
@master_option
@json_option
def list_(
    transports: tuple[str, ...],
    domain: int,
    router: str | None,
    zenoh_config: Path | None,
    master: str,
    as_json: bool,
) -> None:
    """Show the topics of a robot: names, types, rates, on every network that can be joined.

    Rates are measured over two seconds, for the types that a recording can hold.

    \b
    Examples:
      tooltip record list
      tooltip record list --on ros2 --domain 7 --json
      tooltip record list --on zenoh --router tcp/robot:7447
    """
    from tooltip_cli.sources.bus import topic_rates
    from tooltip_cli.sources.dds import DdsBus
    from tooltip_cli.sources.ros1 import Ros1Bus
    from tooltip_cli.sources.zenoh_bus import ZenohBus

    open_bus: dict[str, Callable[[], Bus]] = {
        "ros2": lambda: DdsBus(domain),
        "zenoh": lambda: ZenohBus(domain, router, zenoh_config),
        "ros1": lambda: Ros1Bus(master),
    }
    found = []
    for name in transports or TRANSPORTS:
        try:
            bus = open_bus[name]()
            say(f"{name}: listening on {bus.where}")
            heard = topic_rates(bus, 2.0)
        except TooltipError as error:
            if len(transports) == 1:
                raise
            say(f"{name}: {error}")
            continue
        if not heard:
            say(f"{name}: nothing is heard on {bus.where}")
        found += [(name, topic, rate) for topic, rate in heard]
    if as_json:
        print_json(
            [
                {"transport": name, "topic": topic.name, "type": topic.datatype, "hz": rate}
                for name, topic, rate in found
            ]
        )
        return
    rows = [
        (name, topic.name, topic.datatype, "-" if rate is None else f"{rate:.1f}")
        for name, topic, rate in found
    ]
    for line in table(("on", "topic", "type", "Hz"), rows, 3) if rows else ():
        click.echo(line)


def _record_robot(
    open_bus: Callable[[], Bus],
    out: Path,
    *,
    image: str | None,
    joints: str | None,
    info: str | None,
    pose: str | None,
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
    from tooltip_cli.log.recording import Topics
    from tooltip_cli.log.whole import check_absent
    from tooltip_cli.sources.robot import RobotSource
    from tooltip_cli.stages.live import LiveOptions

    check_absent(out, overwrite=force)  # before anybody waits for topics
    given, urdf = load_rig_file(rig), load_urdf(robot)
    bus = open_bus()
    say(f"{out}: listening on {bus.where}")
    source = RobotSource(bus, Topics(image, joints, info, pose), given, urdf)
    options = LiveOptions(duration, until_enough, reconnect, patience, queue, min_free)
    _record(source, out, options, force, as_json)


def _record(
    source: LiveSource, out: Path, options: LiveOptions, force: bool, as_json: bool
) -> None:
    from tooltip_cli.log.stopping import stop_on_signals
    from tooltip_cli.stages.live import record_live
    from tooltip_cli.stages.watching import MotionObserver

    if source.rig is None and options.until_enough:
        raise click.UsageError("--until-enough needs --rig: without one no motion is judged")
    observer = MotionObserver(source.rig) if source.rig is not None else None
    line = StatusLine(out)
    try:
        with stop_on_signals() as stop:
            report = record_live(
                source,
                out,
                options,
                stop=stop,
                overwrite=force,
                observer=observer,
                on_status=line.show,
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


class StatusLine:
    """One line on stderr that is written over, where that is a terminal; notes stay."""

    def __init__(self, out: Path) -> None:
        self._out, self._terminal = out, sys.stderr.isatty()

    def show(self, status: Status) -> None:
        """Show how the recording stands."""
        if self._terminal:
            # a line that wraps could not be written over
            text = status_text(status)[: shutil.get_terminal_size().columns - 1]
            sys.stderr.write(f"\r\x1b[K{text}")
            sys.stderr.flush()

    def note(self, text: str) -> None:
        """Say something that stays."""
        self.clear()
        say(f"{self._out}: {printable(text)}")

    def clear(self) -> None:
        """Remove the line."""
        if self._terminal:
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()


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
