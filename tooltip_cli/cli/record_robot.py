"""``tooltip record`` from robots that publish ROS messages, on whatever network."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from tooltip_cli.cli.options import PATH, json_option, print_json, say, table, topic_options
from tooltip_cli.cli.recording import (
    live_options,
    load_rig_file,
    load_urdf,
    out_argument,
    record_until_end,
    result_options,
    rig_options,
)
from tooltip_cli.errors import MissingExtraError, TooltipError

if TYPE_CHECKING:
    from tooltip_cli.log.recording import Topics
    from tooltip_cli.sources.bus import Bus
    from tooltip_cli.sources.robot import RobotSource

_Command = TypeVar("_Command", bound=Callable[..., object])
TRANSPORTS = ("ros2", "zenoh", "ros1")
_RETRY_S = 1.0


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
    rig: Path | None,
    robot: Path | None,
    reconnect: bool,
    force: bool,
    **options: Any,
) -> None:
    from tooltip_cli.log.recording import Topics
    from tooltip_cli.log.whole import check_absent

    check_absent(out, overwrite=force)  # before anybody waits for topics
    topics = Topics(image, joints, info, pose)
    source = robot_source(open_bus, str(out), topics, rig, robot, wait=reconnect)
    record_until_end(source, out, reconnect=reconnect, force=force, **options)


def robot_source(
    open_bus: Callable[[], Bus],
    name: str,
    topics: Topics,
    rig: Path | None,
    robot: Path | None,
    *,
    wait: bool,
) -> RobotSource:
    """Return the source of a robot on a network.

    Args:
        name: what messages begin with.
        wait: whether to wait for the network, where it cannot be joined.
    """
    from tooltip_cli.sources.robot import RobotSource

    given, urdf = load_rig_file(rig), load_urdf(robot)
    bus = _joined(open_bus, name, wait=wait)
    say(f"{name}: listening on {bus.where}")
    return RobotSource(bus, topics, given, urdf)


def _joined(open_bus: Callable[[], Bus], name: str, *, wait: bool) -> Bus:
    """Join a network, again and again where that is asked for."""
    told = False
    while True:
        try:
            return open_bus()
        except MissingExtraError:
            raise
        except TooltipError as error:
            if not wait:
                raise
            if not told:
                say(f"{name}: {error}; waiting for it")
            told = True
        time.sleep(_RETRY_S)
