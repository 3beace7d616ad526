"""What is watched, a recording or a live source, and what is said and written of it."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from tooltip_cli.errors import TooltipError
from tooltip_cli.log.recording import Topics, read_recording
from tooltip_cli.log.views import resolve_rig, resolve_urdf, resolve_views
from tooltip_cli.method.voting.params import VotingSettings
from tooltip_cli.sources.live import LiveSource
from tooltip_cli.stages.artifacts import digest, provenance, stage_key, write_whole
from tooltip_cli.stages.estimate import SUFFIX, tip_document
from tooltip_cli.stages.feeds import LiveFeed, PlayedFeed
from tooltip_cli.stages.held_out import unlabelled
from tooltip_cli.stages.watch import Update, WatchOptions, watch

VERSION = 1


def watched_document(update: Update, origin: dict[str, Any] | None) -> dict[str, Any]:
    """Return an update as JSON has it: what ``tip.json`` holds, and how it came about.

    Args:
        origin: provenance; None: of an update that is not the last.
    """
    document = tip_document(update.estimate, origin or {})
    if origin is None:
        del document["provenance"]
    verdict = update.verdict
    return {
        "final": update.final,
        "time_s": round(update.time_s, 6),
        "stamp_ns": update.stamp_ns,
        "delay_s": round(update.delay_s, 3),
        "compute_s": round(update.compute_s, 3),
        "behind_s": round(update.behind_s, 3),
        **asdict(update.counts),
        "motion": None
        if verdict is None
        else {
            "verdict": verdict.code,
            "frames": verdict.frames,
            "view_deg": verdict.view_deg,
            "turn_deg": verdict.turn_deg,
        },
        **document,
    }


def watch_recording(
    path: Path,
    options: WatchOptions,
    settings: VotingSettings,
    *,
    rig: Path | None = None,
    topics: Topics | None = None,
    speed: float = 1.0,
    **told: Any,
) -> tuple[Update, dict[str, Any]]:
    """Watch a recording that is played; frames that hand labels exist for are left out.

    Args:
        rig: rig file; default: the one stored in the recording.
        speed: times its own speed; 0: as fast as possible.
        told: ``stop`` and the callables of :func:`watch`.

    Returns:
        the last estimate, and its provenance.

    Raises:
        TooltipError: anything wrong with the inputs, as for the estimate stage.
    """
    recording = read_recording(path, topics or Topics())
    resolved = resolve_rig(recording, rig)
    views = resolve_views(recording, resolved)  # says what is missing
    allowed = unlabelled(recording, views.camera, None)
    left_out = frozenset(recording.image_stamps_ns[~allowed].tolist())
    if recording.pose_topic is not None:
        resolved = replace(resolved, pose_topic=recording.pose_topic)
    if resolved.pose_topic is None:
        resolved = replace(resolved, urdf=resolve_urdf(recording, resolved)[0])
    resolved = replace(
        resolved,
        camera=views.camera,
        camera_frame=resolved.camera_frame or recording.image_frame,
    )
    feed = PlayedFeed(recording, resolved, speed)
    last = watch(feed, resolved, options, settings, left_out=left_out, **told)
    parents = {"recording": recording.sha256, "poses": digest(views.hand_from_camera)}
    return last, provenance(
        path, recording.sha256, stage_key("watch", VERSION, parents, settings), settings
    )


def watch_live(
    source: LiveSource,
    options: WatchOptions,
    settings: VotingSettings,
    *,
    reconnect: bool = False,
    patience_s: float = 10.0,
    **told: Any,
) -> tuple[Update, dict[str, Any]]:
    """Watch a live source, whose rig must be known.

    Args:
        reconnect: wait for a source that disappears, instead of ending.
        patience_s: without images, after which it ends.
        told: ``stop`` and the callables of :func:`watch`.

    Returns:
        the last estimate, and its provenance, which names no recording.

    Raises:
        TooltipError: no image came, the hand's pose never became known, or images do not fit.
    """
    rig = source.rig
    if rig is None:
        raise TooltipError(
            "a live source needs a rig: which frame is the hand, where is the camera"
        )
    feed = LiveFeed(source, reconnect=reconnect, patience_s=patience_s)
    last = watch(feed, rig, options, settings, **told)
    origin = provenance(Path(), "", "", settings)
    return last, {**origin, "recording": None, "recording_sha256": None, "key": None}


def free_for_tip(out: Path, stem: str, force: bool) -> Path:
    """Return where the last estimate will be written.

    Raises:
        TooltipError: it exists and ``force`` was not given.
    """
    path = out / f"{stem}{SUFFIX}"
    if path.exists() and not force:
        raise TooltipError(f"{path} exists already; name another directory, or give --force")
    return path


def write_tip(path: Path, update: Update, origin: dict[str, Any]) -> None:
    """Write an estimate as a tip file.

    Raises:
        TooltipError: it cannot be written.
    """
    write_whole(path, json.dumps(tip_document(update.estimate, origin), indent=1) + "\n")
