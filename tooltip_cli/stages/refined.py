"""The estimate by voting, with clocks and camera put right where that clearly helps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
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
from tooltip_cli.method.voting.volume import Cloud, HandEdges
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
    ballot = _Ballot(recording, rig, views, settings, votes)
    asked = settings.put_right in ("time", "all")
    return ballot.put_right_first() if asked else ballot.put_right_in_doubt(), votes.detected


@dataclass(frozen=True)
class _Ballot:
    """What is voted on, and the rig that may be put right."""

    recording: Recording
    rig: Rig
    views: Views  # by the rig
    settings: VotingSettings
    votes: Votes

    def put_right_first(self) -> TipEstimate:
        """Put right before anything is estimated, as what is asked for may be far off."""
        seen = self.votes.seen_by(self.views, self.settings)
        part = first_end(seen, self.votes.spheres, self.settings)
        del seen
        camera = self.settings.put_right == "all"
        found, views = (None, self.views) if part is None else self.look_at(part, camera)
        return self.estimate(views, found)

    def put_right_in_doubt(self) -> TipEstimate:
        """Put right where the images disagree about the end, and then clearly agree more.

        Nobody has said that the rig may be wrong: nothing is made of it where that does not help.
        """
        seen = self.votes.seen_by(self.views, self.settings)
        estimate, doubt = estimate_or_doubt(seen, self.votes.spheres, self.settings)
        if doubt is None or self.settings.put_right == "none":
            return estimate
        found, views = self.look_at(doubt.part, camera=True)
        if found is None:
            return estimate
        if found.applied:
            moved = self.votes.moved(seen, views)
            if moved is None:
                del seen, doubt
                better = self.estimate(views, found)
            else:  # where edges lie in the hand frame changes by millimetres
                better = self.conclude(moved, found, doubt.cloud)
            if gain(estimate, better) > self.settings.calibration.agreement_gain:
                return better
        return replace(estimate, refinement=replace(found, applied=False))

    def look_at(self, part: ClosePart, camera: bool) -> tuple[Refinement | None, Views]:
        """Return what an end says of the rig, and the views by what of it is used."""
        seen = seen_part(self.recording, self.rig, self.votes.pairing, part)
        found = calibrate([seen], camera, self.settings.calibration, self.settings.refine)
        if found is None:
            return None, self.views
        try:
            _, views = rig_of(self.recording, self.rig, self.views, found)
        except TooltipError:  # no joints were logged then
            return replace(found, applied=False), self.views
        return found, views

    def estimate(self, views: Views, found: Refinement | None) -> TipEstimate:
        """Estimate by some views, and add what was found and what that leaves unknown."""
        give_back_freed()
        return self.conclude(self.votes.seen_by(views, self.settings), found)

    def conclude(
        self, seen: HandEdges, found: Refinement | None, cloud: Cloud | None = None
    ) -> TipEstimate:
        """Estimate from edges, and add what was found of the rig."""
        estimate = estimate_by_voting(seen, self.votes.spheres, self.settings, cloud)
        if found is None:
            return estimate
        (tip_covariance,) = found.tip_covariances
        trust = self.settings.trust
        return replace(less_sure(estimate, tip_covariance, trust), refinement=found)


def gain(before: TipEstimate, after: TipEstimate) -> float:
    """Return how much more of what the images show of an end fits, if it is the same end."""
    if not after.candidates:
        return -np.inf
    end = after.candidates[0]
    same = min(
        before.candidates, key=lambda item: float(np.linalg.norm(item.position - end.position))
    )
    return (end.agreement or 0.0) - (same.agreement or 0.0)
