"""The estimate by voting, with clocks and camera put right where that clearly helps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from tooltip_cli.errors import TooltipError, one_of
from tooltip_cli.log.recording import Recording
from tooltip_cli.log.views import Views
from tooltip_cli.method.types import Refinement, TipEstimate
from tooltip_cli.method.voting.calibrate import calibrate
from tooltip_cli.method.voting.ends import ClosePart, first_end
from tooltip_cli.method.voting.estimate import estimate_by_voting, estimate_or_doubt, less_sure
from tooltip_cli.method.voting.params import PUT_RIGHT, VotingSettings
from tooltip_cli.rig.rigfile import Rig
from tooltip_cli.stages.calibrate import rig_of, seen_part
from tooltip_cli.stages.memory import give_back_freed
from tooltip_cli.stages.moving import DetectedEdges
from tooltip_cli.stages.voting import Votes, gather_votes


def vote(
    recording: Recording,
    rig: Rig,
    views: Views,
    settings: VotingSettings,
    allowed: npt.NDArray[np.bool_],
    *,
    out: Path | None,
    jobs: int,
    on_frame: Callable[[], None],
) -> tuple[TipEstimate, DetectedEdges | None]:
    """Estimate the tip from the allowed images (N,); no edges where the motion shows nothing.

    Args:
        rig: that the views are by.

    Raises:
        TooltipError: an image cannot be decoded, the edges not written, or the settings name no
            way to put a rig right.
    """
    if settings.put_right not in PUT_RIGHT:
        raise TooltipError(one_of("choice of what to put right", settings.put_right, PUT_RIGHT))
    votes = gather_votes(recording, views, settings, allowed, out=out, jobs=jobs, on_frame=on_frame)
    if isinstance(votes, TipEstimate):
        return votes, None
    if settings.put_right in ("time", "all"):
        found = _as_asked(recording, rig, views, votes, settings)
    else:
        found = _in_doubt(recording, rig, views, votes, settings)
    return found, votes.detected


def _as_asked(
    recording: Recording, rig: Rig, views: Views, votes: Votes, settings: VotingSettings
) -> TipEstimate:
    """Put right before anything is estimated, as what is asked for may be far off."""
    part = first_end(votes.seen_by(views, settings), votes.spheres, settings)
    camera = settings.put_right == "all"
    found = (
        None if part is None else _refinement(recording, rig, views, votes, part, settings, camera)
    )
    return _estimate(recording, rig, views, votes, found, settings)


def _in_doubt(
    recording: Recording, rig: Rig, views: Views, votes: Votes, settings: VotingSettings
) -> TipEstimate:
    """Put right where the images disagree about the end, and where they then clearly agree more.

    Nobody has said that the rig may be wrong, so nothing is made of it where that does not help.
    """
    estimate, part = estimate_or_doubt(votes.seen_by(views, settings), votes.spheres, settings)
    if part is None or settings.put_right == "none":
        return estimate
    found = _refinement(recording, rig, views, votes, part, settings, camera=True)
    if found is None:
        return estimate
    if found.applied:
        better = _estimate(recording, rig, views, votes, found, settings)
        if gain(estimate, better) > settings.calibration.agreement_gain:
            return better
    return replace(estimate, refinement=replace(found, applied=False))


def _refinement(
    recording: Recording,
    rig: Rig,
    views: Views,
    votes: Votes,
    part: ClosePart,
    settings: VotingSettings,
    camera: bool,
) -> Refinement | None:
    seen = seen_part(recording, rig, votes.pairing, part)
    found = calibrate([seen], camera, settings.calibration, settings.refine)
    if found is None or not found.applied:
        return found
    try:
        rig_of(recording, rig, views, found)
    except TooltipError:  # no joints were logged then
        return replace(found, applied=False)
    return found


def _estimate(
    recording: Recording,
    rig: Rig,
    views: Views,
    votes: Votes,
    found: Refinement | None,
    settings: VotingSettings,
) -> TipEstimate:
    """Estimate by the rig that was found, and add what that leaves unknown."""
    give_back_freed()
    _, views = rig_of(recording, rig, views, found)
    estimate = estimate_by_voting(votes.seen_by(views, settings), votes.spheres, settings)
    if found is None:
        return estimate
    (tip_covariance,) = found.tip_covariances
    return replace(less_sure(estimate, tip_covariance, settings.trust), refinement=found)


def gain(before: TipEstimate, after: TipEstimate) -> float:
    """Return how much more of what the images show of an end fits, if it is the same end."""
    if not after.candidates:
        return -np.inf
    end = after.candidates[0]
    same = min(
        before.candidates, key=lambda item: float(np.linalg.norm(item.position - end.position))
    )
    return (end.agreement or 0.0) - (same.agreement or 0.0)
