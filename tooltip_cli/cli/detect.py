"""``tooltip detect``."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from tooltip_cli.cli.options import (
    check_names,
    force_option,
    jobs_option,
    json_option,
    out_option,
    preset_option,
    print_json,
    profile_option,
    progress,
    recordings_argument,
    rig_option,
    say,
    say_profile,
    topic_options,
)

if TYPE_CHECKING:
    from tooltip_cli.log.recording import Recording, Topics
    from tooltip_cli.method.types import Reason
    from tooltip_cli.stages.moving import DetectedEdges, PendingEdges
    from tooltip_cli.stages.near import NearHand


@click.command()
@recordings_argument
@rig_option
@preset_option(
    "paper: the tip's pixel in consecutive images, among all edges. voting: that, looked for near "
    "the hand, and all moving edges of frames paired by the hand's motion; both need the rig."
)
@jobs_option
@profile_option
@out_option
@topic_options
@force_option
@json_option
def detect(
    recordings: tuple[Path, ...],
    rig: Path | None,
    preset: str,
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
    """Find the tip's pixel in each frame by motion.

    Each pair of consecutive images gives the edge point that moves most against the background
    (paper, section 3.1). Writes STEM.detections.mcap, which opens beside the recording in a
    viewer. Where the rig is known, only edges that the tool can reach are looked at, which takes
    less time, and STEM.edges.mcap is written too, for 'tooltip estimate --method voting': the
    moving edges of frames that are paired by how far the hand moves between them.

    \b
    Examples:
      tooltip detect pliers.mcap
      tooltip detect *.mcap --jobs 2 --out results
      tooltip detect pliers.mcap --preset paper
    """
    from tooltip_cli.log.recording import Topics
    from tooltip_cli.stages.clock import measuring

    results: list[dict[str, Any]] = []
    topics = Topics(image=image, joints=joints, info=info, pose=pose)
    check_names(recordings, out)
    for path in recordings:
        with measuring(profile) as stopwatch:
            results.append(_detect_one(path, topics, rig, preset, out, force, jobs))
        say_profile(str(path), stopwatch)
    if as_json:
        print_json(results)
    else:
        for result in results:
            click.echo(result["detections_file"])


def _detect_one(
    path: Path,
    topics: Topics,
    rig: Path | None,
    preset: str,
    out: Path | None,
    force: bool,
    jobs: int,
) -> dict[str, Any]:
    """Detect in one recording; returns what is said of it as JSON."""
    from tooltip_cli.log.recording import read_recording
    from tooltip_cli.stages.clock import laps
    from tooltip_cli.stages.detect import detect_in
    from tooltip_cli.stages.moving import PendingEdges

    lap = laps()
    recording = read_recording(path, topics)
    lap("read")
    has_rig = rig is not None or "rig.yaml" in recording.attachments
    near, edges = None, None
    if preset == "voting" and has_rig:
        near, edges = _by_rig(recording, rig, out, force, jobs)
    along = [edges.job] if isinstance(edges, PendingEdges) else []
    with progress(len(recording.image_stamps_ns) - 1, f"detect {path.name}") as advance:
        found = detect_in(
            recording,
            near=near,
            out=out,
            force=force,
            jobs=jobs,
            on_pair=advance,
            along=along,
        )
    for note in recording.notes:
        say(f"{path}: {note}")
    detections = found.detections
    valid = int(detections.valid.sum())
    flags = Counter(flag for row in detections.flags for flag in row)
    how = "reused" if found.reused else "computed"
    detail = "".join(f", {count} {flag}" for flag, count in sorted(flags.items()))
    say(f"{path}: {how} {len(detections.frames)} pairs, {valid} detections{detail}")
    result: dict[str, Any] = {
        "recording": str(path),
        "detections_file": str(found.path),
        "reused": found.reused,
        "pairs": len(detections.frames),
        "detections": valid,
        "flags": flags,
    }
    if edges is not None:
        result["edges_file"] = _finished(path, edges, jobs)
    elif preset == "voting":
        say(f"{path}: no rig is stored or given, so only consecutive images are compared")
    return result


def _by_rig(
    recording: Recording, rig: Path | None, out: Path | None, force: bool, jobs: int
) -> tuple[NearHand, DetectedEdges | PendingEdges | Reason]:
    """Return where the hand is, and the moving edges, what finds them, or why there are none."""
    from tooltip_cli.log.views import resolve_rig, resolve_views
    from tooltip_cli.method.voting.params import VotingSettings
    from tooltip_cli.stages.clock import laps
    from tooltip_cli.stages.near import near_hand
    from tooltip_cli.stages.voting import edges_for_voting

    lap = laps()
    views = resolve_views(recording, resolve_rig(recording, rig))
    near = near_hand(recording, views)
    lap("poses")
    settings = VotingSettings()
    return near, edges_for_voting(recording, views, settings, out=out, force=force, jobs=jobs)


def _finished(path: Path, edges: DetectedEdges | PendingEdges | Reason, jobs: int) -> str | None:
    """Write moving edges that are not stored; returns their file, or None where there are none."""
    from tooltip_cli.method.types import Reason
    from tooltip_cli.stages.moving import PendingEdges

    if isinstance(edges, Reason):
        say(f"{path}: no moving edges: {edges.code}: {edges.text}")
        return None
    if isinstance(edges, PendingEdges):
        with progress(None, f"moving edges {path.name}, frames") as advance:
            edges = edges.finish(jobs, advance)
    how = "reused" if edges.reused else "computed"
    say(f"{path}: {how} moving edges of {len(edges.edges.frames)} frames in {edges.path}")
    return str(edges.path)
