"""``tooltip estimate``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from tooltip_cli.cli.options import (
    METHODS,
    PATH,
    PRESET_OF_DETECTIONS,
    Prefer,
    check_names,
    estimator_params,
    force_option,
    jobs_option,
    json_option,
    out_option,
    prefer_option,
    preset_option,
    print_json,
    profile_option,
    progress,
    recordings_argument,
    refine_option,
    rig_option,
    say,
    say_profile,
    tip_sentence,
    topic_options,
)


@click.command()
@recordings_argument
@rig_option
@click.option(
    "--method",
    type=click.Choice(METHODS),
    default="voting",
    show_default=True,
    help="voting: all moving edges vote in a volume fixed to the hand. kmeans: the paper's section "
    "3.2. map: its appendix B. From labels, voting is map.",
)
@click.option(
    "--from-labels",
    type=PATH,
    metavar="CSV",
    help="Estimate from these hand labels instead of detections (the paper's baseline).",
)
@refine_option
@preset_option(PRESET_OF_DETECTIONS)
@prefer_option
@jobs_option
@profile_option
@out_option
@topic_options
@force_option
@json_option
@click.pass_context
def estimate(
    ctx: click.Context,
    recordings: tuple[Path, ...],
    rig: Path | None,
    method: str,
    preset: str,
    prefer: Prefer | None,
    from_labels: Path | None,
    refine: str,
    jobs: int,
    profile: bool,
    out: Path | None,
    image: str | None,
    joints: str | None,
    info: str | None,
    pose: str | None,
    force: bool,
    as_json: bool,
) -> None:
    """Find the 3D tip in the hand frame.

    Uses what 'tooltip detect' finds, making it first where it is missing or out of date, and the
    robot's kinematics. Writes STEM.tip.json. Exits with 3 when the answer cannot be
    trusted; the file then says why.

    \b
    Examples:
      tooltip estimate pliers.mcap
      tooltip estimate pliers.mcap --rig robot.rig.yaml --method map
      tooltip estimate pliers.mcap --from-labels pliers.labels.csv
    """
    from tooltip_cli.log.recording import Topics
    from tooltip_cli.stages.calibrate import refinement_sentence
    from tooltip_cli.stages.clock import measuring
    from tooltip_cli.stages.estimate import estimate as run

    params = estimator_params(method, prefer, refine, from_labels)
    documents: list[dict[str, Any]] = []
    refusals = 0
    check_names(recordings, out)
    for path in recordings:
        with (
            measuring(profile) as stopwatch,
            progress(None, f"detect {path.name}, pairs") as advance,
        ):
            found = run(
                path,
                rig=rig,
                topics=Topics(image=image, joints=joints, info=info, pose=pose),
                params=params,
                preset=preset,
                from_labels=from_labels,
                out=out,
                force=force,
                jobs=jobs,
                on_pair=advance,
            )
        say_profile(str(path), stopwatch)
        for note in found.notes:
            say(f"{path}: {note}")
        if found.detected is not None:
            how = "reused" if found.detected.reused else "computed"
            say(f"{path}: {how} {found.detected.path}")
        say(f"{path}: {'reused' if found.reused else 'computed'} {found.path}")
        for reason in found.estimate.reasons:
            say(f"{path}: {found.estimate.status}: {reason.code}: {reason.text}")
        if found.estimate.refinement is not None:
            say(f"{path}: {refinement_sentence(found.document['refined'])}")
        refusals += found.estimate.position is None
        documents.append(found.document)
        if not as_json:
            click.echo(tip_sentence(path.stem, found.document))
    if as_json:
        print_json(documents[0] if len(documents) == 1 else documents)
    if refusals:
        ctx.exit(3)
