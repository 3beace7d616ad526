"""The shape that voting sees, for the report: a coarse cloud of hand and tool, kept on disk."""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tooltip_cli.log.recording import Recording
from tooltip_cli.log.views import Views
from tooltip_cli.method.types import Mask, TipEstimate
from tooltip_cli.method.voting.estimate import METHOD as VOTING
from tooltip_cli.method.voting.params import VotingSettings
from tooltip_cli.method.voting.volume import agreed_points, reconstruct
from tooltip_cli.report.scenes import VotedShape
from tooltip_cli.stages.artifacts import artifact_path, plain, read_json, stage_key, write_whole
from tooltip_cli.stages.estimate import Estimated
from tooltip_cli.stages.voting import Votes, gather_votes

SUFFIX = ".shape.json"
VERSION = 1
_FRAMES = 50  # of those that vote: enough to recognise a tool, at a quarter of the time
_VOXEL = 0.004  # metres; one point is kept in each
_LEAST = 0.08  # share of the frames that must agree on it
_MOST_POINTS = 2000
_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True)
class Voters:
    """What the frames of an estimate by voting are read from."""

    recording: Recording
    views: Views
    allowed: Mask  # (N,) images that may vote
    settings: VotingSettings
    detected_out: Path | None  # directory of what was detected; None: beside the recording
    seen_by: Views  # that the estimate is by: ``views``, or put right by it

    def votes(self) -> Votes | None:
        """Return what the estimate is made from; None: the motion shows nothing.

        Raises:
            TooltipError: the edges are not stored and cannot be made.
        """
        votes = gather_votes(
            self.recording, self.views, self.settings, self.allowed, out=self.detected_out, jobs=1
        )
        return None if isinstance(votes, TipEstimate) else votes


def voted_shape(voters: Voters, estimated: Estimated, out: Path) -> VotedShape | None:
    """Return what voting sees of hand and tool, and write it under ``out``, or reuse it.

    None where the estimate is not by voting, or the motion shows nothing.

    Raises:
        TooltipError: it cannot be written.
    """
    if estimated.estimate.method != VOTING:
        return None
    key = stage_key("shape", VERSION, {"estimate": estimated.key}, {})
    place = artifact_path(voters.recording.path, SUFFIX, out)
    stored = _stored(place, key)
    if stored is not None:
        return stored
    votes = voters.votes()
    if votes is None:
        return None
    edges = votes.known_to(voters.seen_by)
    frames = edges.frames[:: max(1, len(edges.frames) // _FRAMES)]
    some = votes.seen_by(voters.seen_by, voters.settings, edges.of_frames(frames))
    cloud = reconstruct(some, voters.settings.voting)
    least = max(2, round(_LEAST * len(frames)))
    points, seen = agreed_points(cloud.points, cloud.frames, _VOXEL, least)
    clearest = np.sort(np.argsort(-seen, kind="stable")[:_MOST_POINTS])
    shape = VotedShape(
        points[clearest].round(4), (seen[clearest] / len(frames)).round(3), len(frames)
    )
    write_whole(place, json.dumps({"key": key, **plain(shape)}) + "\n")
    return shape


def _stored(place: Path, key: str) -> VotedShape | None:
    document = read_json(place)
    if not isinstance(document, dict) or document.get("key") != key:
        return None
    try:
        points = np.array(document["points"], dtype=float).reshape(-1, 3)
        return VotedShape(
            points, np.array(document["shares"], dtype=float), int(document["frames"])
        )
    except (KeyError, TypeError, ValueError):
        _LOGGER.info("%s cannot be read and is made anew", place)
        return None
