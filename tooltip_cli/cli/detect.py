"""``tooltip detect``."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import click

from tooltip_cli.cli.options import (
    check_names,
    force_option,
    jobs_option,
    json_option,
    out_option,
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
    "--preset",
    type=click.Choice(["paper"]),
    default="paper",
    show_default=True,
    help="Parameters of the detector.",
)
@jobs_option
@out_option
@topic_options
@force_option
@json_option
def detect(
    recordings: tuple[Path, ...],
    rig: Path | None,
    preset: str,
    jobs: int,
    out: Path | None,
    image: str | None,
    joints: str | None,
    info: str | None,
    pose: str | None,
    force: bool,
    as_json: bool,
) -> None:
    """Find the tip's pixel in each frame by motion.

    Each pair of consecutive images gives the edge point that moves most against the background
    (paper, section 3.1). Writes STEM.detections.mcap, which opens beside the recording in a
    viewer. Detection is two-dimensional: --rig is accepted for symmetry and changes nothing.

    \b
    Examples:
      tooltip detect pliers.mcap
      tooltip detect *.mcap --jobs 2 --out results
    """
    from tooltip_cli.log.recording import Topics, read_recording
    from tooltip_cli.stages.detect import detect_in

    results: list[dict[str, Any]] = []
    topics = Topics(image=image, joints=joints, info=info, pose=pose)
    check_names(recordings, out)
    for path in recordings:
        recording = read_recording(path, topics)
        with progress(len(recording.image_stamps_ns) - 1, f"detect {path.name}") as advance:
            found = detect_in(recording, out=out, force=force, jobs=jobs, on_pair=advance)
        for note in recording.notes:
            say(f"{path}: {note}")
        detections = found.detections
        valid = int(detections.valid.sum())
        flags = Counter(flag for row in detections.flags for flag in row)
        how = "reused" if found.reused else "computed"
        detail = "".join(f", {count} {flag}" for flag, count in sorted(flags.items()))
        say(f"{path}: {how} {len(detections.frames)} pairs, {valid} detections{detail}")
        results.append(
            {
                "recording": str(path),
                "detections_file": str(found.path),
                "reused": found.reused,
                "pairs": len(detections.frames),
                "detections": valid,
                "flags": flags,
            }
        )
    if as_json:
        print_json(results)
    else:
        for result in results:
            click.echo(result["detections_file"])
