"""``tooltip record``: simulate, import from bags, data sets and videos, or listen to a robot."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tooltip_cli.cli.options import PATH, jobs_option, progress, say, topic_options
from tooltip_cli.cli.record_camera import camera
from tooltip_cli.cli.record_robot import list_, ros1, ros2, zenoh
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
    from tooltip_cli.sources.base import Source


@click.group()
def record() -> None:
    """Record or import images and joint angles into an MCAP log.

    The log keeps the streams as they came. With --rig it also keeps the rig, the camera file and
    the robot description, so that later commands need nothing but the log.

    Until it is finished the log is called OUT.mcap.unfinished and is on the disk up to the last
    half second; what Ctrl-C, a crash or a full disk leaves of it, 'tooltip salvage' recovers.

    \b
    Examples:
      tooltip record sim pliers.mcap --tool pliers
      tooltip record bag drive.bag pliers.mcap --image /head/image_raw --rig rig.yaml
      tooltip record lerobot datasets/g1 can.mcap --episode 1
      tooltip record video pliers.mp4 pliers.mcap --joints joints.csv --rig rig.yaml
      tooltip record camera pliers.mcap --camera 0 --joints udp://:9870 --rig rig.yaml
      tooltip record ros2 pliers.mcap --duration 15 --rig rig.yaml
      tooltip record zenoh pliers.mcap --router tcp/robot:7447 --rig rig.yaml
      tooltip record ros1 pliers.mcap --master http://robot:11311 --rig rig.yaml
    """


record.add_command(camera)
record.add_command(ros2)
record.add_command(zenoh)
record.add_command(ros1)
record.add_command(list_)


@record.command("sim", short_help="Simulate a robot that sweeps a tool.")
@out_argument
@click.option(
    "--tool",
    default="pliers",
    show_default=True,
    help="One of the paper's: hot_glue_gun, screwdriver, bottle, electrical_plug, paint_brush, "
    "robot_finger, pen, pliers, hammer, scissors.",
)
@click.option("--frames", type=int, default=500, show_default=True, help="Number of images.")
@click.option("--seed", type=int, default=0, show_default=True, help="Grasp, motion and noise.")
@click.option("--size", default="640x480", show_default=True, metavar="WxH", help="In pixels.")
@click.option("--fps", type=float, default=30.0, show_default=True, help="Images a second.")
@click.option(
    "--noise",
    type=float,
    default=2.0,
    show_default=True,
    help="Standard deviation of the sensor's noise, grey levels.",
)
@click.option("--jpeg-quality", type=int, default=90, show_default=True, help="1 to 100.")
@click.option(
    "--head-motion",
    type=float,
    default=0.0,
    show_default=True,
    help="The head turns within plus or minus this, degrees.",
)
@click.option(
    "--motion",
    default="sweep",
    show_default=True,
    help="Of the wrist: sweep, in_plane, still or fast.",
)
@click.option(
    "--background",
    default="auto",
    show_default=True,
    help="motorcycle, astronaut, coffee, chelsea, clutter, or auto: the seed chooses.",
)
@jobs_option
@result_options
def sim(
    out: Path,
    tool: str,
    frames: int,
    seed: int,
    size: str,
    fps: float,
    noise: float,
    jpeg_quality: int,
    head_motion: float,
    motion: str,
    background: str,
    jobs: int,
    min_free: int,
    force: bool,
    as_json: bool,
) -> None:
    """Simulate a robot that sweeps a tool before its camera.

    Beside OUT.mcap it writes the labels of the test frames, STEM.labels.csv: the true pixel with
    1.5 px of noise, labeler 'sim'. The truth itself is the log's attachment truth.json. Equal
    options give equal recordings.

    \b
    Examples:
      tooltip record sim pliers.mcap --tool pliers
      tooltip record sim pen.mcap --tool pen --frames 200 --seed 7 --size 320x240
    """
    from tooltip_cli.log.stopping import stop_on_signals
    from tooltip_cli.sources.sim import SimParams
    from tooltip_cli.stages.simulate import record_simulation

    params = SimParams(
        tool=tool,
        frames=frames,
        seed=seed,
        size=_size(size),
        fps=fps,
        noise_sigma=noise,
        jpeg_quality=jpeg_quality,
        head_motion_deg=head_motion,
        motion=motion,
        background=background,
    )
    with progress(frames, f"record {out.name}") as advance, stop_on_signals() as stop:
        done = record_simulation(
            params,
            out,
            jobs=jobs,
            overwrite=force,
            min_free_bytes=min_free,
            stop=stop,
            on_image=advance,
        )
    document = tell(out, done.report)
    say(f"{done.labels}: simulated labels of the test frames")
    finish({**document, "labels": str(done.labels)}, as_json)


@record.command("bag", short_help="Import ROS 1 and ROS 2 bags and other MCAP files.")
@click.argument("bag", type=PATH, metavar="IN")
@out_argument
@topic_options
@rig_options
@result_options
def bag_(
    bag: Path,
    out: Path,
    image: str | None,
    joints: str | None,
    info: str | None,
    pose: str | None,
    rig: Path | None,
    robot: Path | None,
    min_free: int,
    force: bool,
    as_json: bool,
) -> None:
    """Import a ROS 1 bag, a ROS 2 bag or any MCAP file with ROS messages.

    IN is a .bag file, a ROS 2 folder, a .db3 or an .mcap file. Taken are the images, their
    CameraInfo, the joint states (or the hand's poses) and the robot description; ROS 2 messages
    pass byte for byte. Where several topics could be meant, name one.

    \b
    Examples:
      tooltip record bag drive.bag pliers.mcap --rig rig.yaml --robot robot.urdf
      tooltip record bag rosbag2_folder pliers.mcap --image /head/image_raw/compressed
    """
    from tooltip_cli.log.recording import Topics
    from tooltip_cli.sources.bag import BagSource

    topics = Topics(image=image, joints=joints, info=info, pose=pose)
    source = BagSource(bag, topics, load_rig_file(rig), load_urdf(robot))
    finish(_record(source, out, force, min_free), as_json)


@record.command("lerobot", short_help="Import one episode of a LeRobot data set.")
@click.argument("dataset", type=PATH, metavar="DATASET")
@out_argument
@click.option("--episode", type=int, required=True, metavar="N", help="Index of the episode.")
@click.option("--camera", metavar="KEY", help="Image feature, where there are several.")
@click.option(
    "--state",
    metavar="KEY",
    default="observation.state",
    show_default=True,
    help="Feature that holds the joint positions, in rad or m.",
)
@rig_options
@result_options
def lerobot(
    dataset: Path,
    out: Path,
    episode: int,
    camera: str | None,
    state: str,
    rig: Path | None,
    robot: Path | None,
    min_free: int,
    force: bool,
    as_json: bool,
) -> None:
    """Import one episode of a LeRobot data set, version 2.0, 2.1 or 3.0.

    DATASET is the local folder with meta, data and videos. Video frames become JPEG of quality
    95. Joints keep the data set's names; 'joints' in the rig file maps them to the URDF's.

    \b
    Examples:
      tooltip record lerobot datasets/g1 can.mcap --episode 1 --rig rig.yaml --robot g1.urdf
      tooltip record lerobot datasets/aloha a.mcap --episode 0 --camera observation.images.top
    """
    from tooltip_cli.sources.lerobot import LeRobotSource

    source = LeRobotSource(dataset, episode, camera, state, load_rig_file(rig), load_urdf(robot))
    finish(_record(source, out, force, min_free), as_json)


@record.command("video", short_help="Import a video or a folder of images.")
@click.argument("video", type=PATH, metavar="VIDEO_OR_FOLDER")
@out_argument
@click.option("--joints", type=PATH, metavar="CSV", help="Columns: stamp_ns, then one a joint.")
@click.option("--poses", type=PATH, metavar="CSV", help="Columns: stamp_ns,x,y,z,qx,qy,qz,qw.")
@click.option(
    "--pose-frame",
    metavar="FRAME",
    help="Frame in which the poses are given. Default: the parent of the rig's camera mount.",
)
@click.option(
    "--fps",
    type=click.FloatRange(min=0, min_open=True),
    help="Images a second, in place of the video's own times or the images' stamps.",
)
@click.option(
    "--start",
    metavar="STAMP",
    help="Stamp of the first image: whole nanoseconds, or seconds with a point or 's'.",
)
@rig_options
@result_options
def video_(
    video: Path,
    out: Path,
    joints: Path | None,
    poses: Path | None,
    pose_frame: str | None,
    fps: float | None,
    start: str | None,
    rig: Path | None,
    robot: Path | None,
    min_free: int,
    force: bool,
    as_json: bool,
) -> None:
    """Import a video or a folder of images, with a table of joint angles or hand poses.

    The tables are CSV with a header: stamp_ns (or stamp, in seconds), then one column a joint in
    rad or m; or stamp_ns,x,y,z,qx,qy,qz,qw. The first frame of a video stands at the tables'
    first stamp, or at --start.

    Images of a folder take their stamps from stamps.csv in it (file,stamp_ns), from names that
    are stamps, or from --fps. JPEG and PNG files are stored as they are.

    \b
    Examples:
      tooltip record video pliers.mp4 pliers.mcap --joints joints.csv --rig rig.yaml
      tooltip record video frames/ pliers.mcap --joints joints.csv --fps 30 --start 1700000000.5
      tooltip record video frames/ board.mcap --poses poses.csv --pose-frame base --rig rig.yaml
    """
    from tooltip_cli.sources.video import VideoSource, parse_start

    source = VideoSource(
        video,
        joints_csv=joints,
        poses_csv=poses,
        fps=fps,
        start_ns=parse_start(start) if start is not None else None,
        pose_frame=pose_frame,
        rig=load_rig_file(rig),
        urdf=load_urdf(robot),
    )
    finish(_record(source, out, force, min_free), as_json)


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise click.BadParameter(f"'{text}' is no size; give WIDTHxHEIGHT, such as 640x480")
    return int(width), int(height)


def _record(source: Source, out: Path, force: bool, min_free: int) -> dict[str, Any]:
    """Write the log, say what was read and left out, and return the result."""
    from tooltip_cli.log.stopping import stop_on_signals
    from tooltip_cli.stages.record import record as write

    with progress(source.frames, f"record {out.name}") as advance, stop_on_signals() as stop:
        report = write(
            source, out, overwrite=force, min_free_bytes=min_free, stop=stop, on_image=advance
        ).report
    document = tell(out, report)
    described = any(topic.endswith("robot_description") for topic in report.read)
    if source.rig is not None and source.rig.pose_topic is None and not described:
        say(f"{out}: holds no robot description; give --robot, or name it in the rig file")
    return document
