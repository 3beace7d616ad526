"""``tooltip calibrate``."""

from __future__ import annotations

from pathlib import Path

import click

from tooltip_cli.cli.options import (
    PATH,
    force_option,
    jobs_option,
    json_option,
    print_json,
    progress,
    recordings_argument,
    rig_option,
    say,
    topic_options,
)


@click.command()
@recordings_argument
@rig_option
@click.option(
    "--camera/--clocks-only",
    default=True,
    show_default=True,
    help="Put the camera's pose right too, where clearly more of what the images show then fits.",
)
@click.option(
    "--out",
    type=PATH,
    metavar="DIR",
    help="Write the corrected rig here: rig.yaml with the files that it names.",
)
@jobs_option
@topic_options
@force_option
@json_option
def calibrate(
    recordings: tuple[Path, ...],
    rig: Path | None,
    camera: bool,
    out: Path | None,
    jobs: int,
    image: str | None,
    joints: str | None,
    info: str | None,
    pose: str | None,
    force: bool,
    as_json: bool,
) -> None:
    """Find clock offset and camera pose from recordings of one robot.

    Each recording may show another tool: its tip is its own, the offset between image and joint
    clocks and the camera's pose are shared. Only what the images determine is put right; a wrist
    that turns about one point says little about how far the camera is.

    \b
    Examples:
      tooltip calibrate pen.mcap pliers.mcap
      tooltip calibrate pen.mcap pliers.mcap --out corrected
      tooltip estimate pen.mcap --rig corrected/rig.yaml
    """
    from tooltip_cli.log.recording import Topics
    from tooltip_cli.stages.calibrate import calibrate as run
    from tooltip_cli.stages.calibrate import free_for_rig, refinement_sentence, write_rig

    if out is not None:
        free_for_rig(out, force)
    with progress(None, "calibrate, frames") as advance:
        found = run(
            recordings,
            rig=rig,
            topics=Topics(image=image, joints=joints, info=info, pose=pose),
            camera=camera,
            jobs=jobs,
            on_frame=advance,
        )
    for path, why in found.left_out:
        say(f"{path}: left out: {why}")
    if as_json:
        print_json(found.document)
    else:
        click.echo(refinement_sentence(found.document))
    if out is None:
        return
    if not found.refinement.applied:
        say("nothing to put right: no rig file is written")
        return
    say(f"written {write_rig(found.rig, out)}")
