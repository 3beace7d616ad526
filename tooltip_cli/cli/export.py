"""``tooltip export``: the result for viewers, robots and programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from tooltip_cli.cli.options import (
    METHODS,
    PATH,
    PRESET_OF_DETECTIONS,
    Prefer,
    estimator_params,
    jobs_option,
    json_option,
    prefer_option,
    preset_option,
    print_json,
    progress,
    refine_option,
    rig_option,
    say,
    topic_options,
)

if TYPE_CHECKING:
    from tooltip_cli.stages.export import Result


@click.command(short_help="Write the result for viewers and robots.")
@click.argument("recording", type=PATH, metavar="REC")
@click.argument("target", type=PATH, metavar="[OUT.mcap]", required=False)
@click.option("--urdf", type=PATH, metavar="FILE", help="Write the robot with a tool_tip link.")
@click.option(
    "--cloud",
    type=PATH,
    metavar="FILE",
    help="Write hand and tool as a point cloud (PLY, metres, hand frame), tip in red.",
)
@click.option("--tf", "as_tf", is_flag=True, help="Print the transform from the hand to the tip.")
@rig_option
@click.option(
    "--method",
    type=click.Choice(METHODS),
    default="voting",
    show_default=True,
    help="Of the estimate.",
)
@preset_option(PRESET_OF_DETECTIONS)
@prefer_option
@refine_option
@click.option("--out", type=PATH, help="Directory of the results. Default: beside the recording.")
@jobs_option
@topic_options
@click.option("--force", is_flag=True, help="Replace what exists.")
@json_option
def export(
    recording: Path,
    target: Path | None,
    urdf: Path | None,
    cloud: Path | None,
    as_tf: bool,
    rig: Path | None,
    method: str,
    preset: str,
    prefer: Prefer | None,
    refine: str,
    out: Path | None,
    jobs: int,
    image: str | None,
    joints: str | None,
    info: str | None,
    pose: str | None,
    force: bool,
    as_json: bool,
) -> None:
    """Write the result for viewers and robots.

    OUT.mcap holds everything in one file for viewing: the recording, the robot, /tf of the whole
    chain, marks over the video (detection: black rings, prediction: green cross, label: yellow
    rings), and in the hand's frame the rays, the candidates and the tip with an ellipsoid of two
    standard deviations. --urdf writes the robot with the link 'tool_tip' on a fixed joint of the
    hand. --tf prints a static_transform_publisher command, and a geometry_msgs/TransformStamped
    as YAML. --cloud writes what was seen of hand and tool, coarse but enough to see why the tip is
    where it is. Detections and estimate are made first where they are missing or out of date, or
    were made with other options than these.

    Exits with 3 where --urdf or --tf has no estimate to take: it was refused.

    \b
    Examples:
      tooltip export pliers.mcap pliers.view.mcap
      tooltip export pliers.mcap --urdf robot_with_pliers.urdf
      tooltip export pliers.mcap --tf
      tooltip export pliers.mcap --cloud pliers.ply
    """
    from tooltip_cli.log.recording import Topics
    from tooltip_cli.stages.calibrate import refinement_sentence
    from tooltip_cli.stages.export import (
        export_cloud,
        export_urdf,
        open_result,
        tip_transform,
        transform_text,
    )

    if target is None and urdf is None and cloud is None and not as_tf:
        raise click.UsageError(
            "nothing to export; give OUT.mcap, --urdf FILE, --cloud FILE or --tf"
        )
    with progress(None, f"estimate {recording.name}") as advance:
        result = open_result(
            recording,
            rig=rig,
            topics=Topics(image=image, joints=joints, info=info, pose=pose),
            params=estimator_params(method, prefer, refine),
            preset=preset,
            out=out,
            jobs=jobs,
            on_pair=advance,
        )
    how = "reused" if result.estimated.reused else "computed"
    say(f"{recording}: {how} {result.estimated.path}")
    refined = result.estimated.document.get("refined")
    if refined is not None:
        say(f"{recording}: {refinement_sentence(refined)}")
    document: dict[str, object] = {"recording": str(recording)}
    tell = (lambda text: None) if as_json else click.echo
    if target is not None:
        document["topics"] = _export_log(result, target, out, jobs, force)
        document["mcap"] = str(target)
        tell(target)
    if urdf is not None:
        export_urdf(result, urdf, overwrite=force)
        document["urdf"] = str(urdf)
        tell(urdf)
    if cloud is not None:
        document["points"] = export_cloud(result, cloud, overwrite=force, out=out, jobs=jobs)
        document["cloud"] = str(cloud)
        tell(cloud)
    if as_tf:
        document["transform"] = tip_transform(result)
        tell(transform_text(tip_transform(result)).rstrip())
    if as_json:
        print_json(document)


def _export_log(
    result: Result, target: Path, out: Path | None, jobs: int, force: bool
) -> dict[str, int]:
    """Write the file for viewing; return the messages of each topic."""
    from tooltip_cli.stages.viewing import export_log

    for reason in result.estimated.estimate.reasons:
        say(f"{result.recording.path}: {reason.code}: {reason.text}")
    pairs = len(result.recording.image_stamps_ns) - 1
    with progress(pairs, f"detect {result.recording.path.name}") as advance:
        done = export_log(result, target, overwrite=force, out=out, jobs=jobs, on_pair=advance)
    if done.detected is not None:
        how = "reused" if done.detected.reused else "computed"
        say(f"{result.recording.path}: {how} {done.detected.path}")
    for note in done.notes:
        say(f"{target}: {note}")
    say(f"{target}: " + ", ".join(f"{n} {topic}" for topic, n in sorted(done.topics.items())))
    return done.topics
