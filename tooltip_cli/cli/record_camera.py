"""``tooltip record camera``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from tooltip_cli.cli.recording import (
    live_options,
    load_rig_file,
    load_urdf,
    out_argument,
    record_until_end,
    result_options,
    rig_options,
)

if TYPE_CHECKING:
    from tooltip_cli.sources.live import LiveSource

_Command = TypeVar("_Command", bound=Callable[..., object])


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
            help="udp://HOST:PORT or tcp://HOST:PORT with JSON lines, rtde://HOST of a UR robot, a "
            "CSV file that grows, or a Python object module:factory.",
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
    rig: Path | None,
    robot: Path | None,
    **options: Any,
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
    source = camera_source(camera, joints, joint_stamps, rig, robot)
    record_until_end(source, out, **options)
