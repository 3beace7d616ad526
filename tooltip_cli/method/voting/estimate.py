"""The tip from all moving edges: reconstruct, find the end, say how good it is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tooltip_cli.method.rays import angular_spread
from tooltip_cli.method.types import Array, Candidate, Reason, TipEstimate, largest_std, refused
from tooltip_cli.method.voting.pairing import Pairing, displacement, probe_pixels
from tooltip_cli.method.voting.params import PairingParams, TrustParams, VotingSettings

if TYPE_CHECKING:
    from tooltip_cli.method.voting.ends import ClosePart
    from tooltip_cli.method.voting.volume import Cloud, HandEdges

METHOD = "voting"
_UNCERTAIN = "uncertain_end"
_OF_END = (
    "as it is round or wide or the images show little of it; turn it so that the camera sees it "
    "from more sides"
)
_OF_RIG = (
    "as this recording says too little of clocks and camera; put them right with several, by "
    "tooltip calibrate"
)
_FRAMES_FOR_SPREAD = 10  # fewer cannot show that the camera keeps to one side of the hand


def check_motion(
    pairing: Pairing, camera_from_hand: Array, settings: VotingSettings
) -> Reason | None:
    """Return why the hand's motion cannot show the tip, or None where it can."""
    trust, count = settings.trust, len(pairing.frames)
    spread = view_spread_deg(camera_from_hand[pairing.frames])
    if count >= _FRAMES_FOR_SPREAD and spread < trust.min_view_angle_deg:
        return Reason(
            "depth_unobservable",
            f"seen from the hand, the camera moves by only {spread:.0f} degrees, so the tip's "
            "depth cannot be told; tilt the wrist out of the image plane",
        )
    if count >= trust.min_frames:
        return None
    params = settings.pairing
    if pairing.fastest_px > params.smallest * params.displacement_px:
        return Reason(
            "too_fast",
            f"a tool's end moves by about {pairing.fastest_px:.0f} pixels between images, and at "
            f"most {params.fastest_px:.0f} can be followed, which only "
            f"{count} frames keep to; turn the wrist more slowly, or record at a higher rate",
        )
    return Reason(
        "no_motion",
        f"the hand turns enough in only {count} frames, at least {trust.min_frames} are needed; "
        "turn the wrist further while recording",
    )


def view_spread_deg(camera_from_hand: Array) -> float:
    """Return the largest angle between the camera's directions seen from the hand, degrees."""
    seen_from = np.linalg.inv(camera_from_hand)[:, :3, 3]
    lengths = np.linalg.norm(seen_from, axis=1, keepdims=True)
    return float(np.degrees(angular_spread(seen_from / lengths)))


@dataclass(frozen=True)
class Doubt:
    """What an estimate was made from, about whose end the images disagree."""

    cloud: Cloud
    part: ClosePart  # the end, and what is seen about it


def estimate_by_voting(
    edges: HandEdges, spheres: Array, settings: VotingSettings, cloud: Cloud | None = None
) -> TipEstimate:
    """Find the tool's far end among all edges that move with the hand.

    Args:
        spheres: (S, 4) centre and radius of hand and wrist, metres.
        cloud: of the same edges, by poses that are nearly these; None: it is made by these.
    """
    return estimate_or_doubt(edges, spheres, settings, cloud)[0]


def estimate_or_doubt(
    edges: HandEdges, spheres: Array, settings: VotingSettings, cloud: Cloud | None = None
) -> tuple[TipEstimate, Doubt | None]:
    """Do the same, and return what the estimate was made from where the images disagree.

    Returns:
        the estimate, and the doubt; None: the images agree, or the estimate is refused.
    """
    # here, as whoever only looks whether the motion will do has no use for them
    from tooltip_cli.method.voting.end import tool_shape
    from tooltip_cli.method.voting.ends import close_part, find_ends
    from tooltip_cli.method.voting.volume import reconstruct

    used = len(edges.moving.frames)
    if cloud is None:
        cloud = reconstruct(edges, settings.voting)
    shape = tool_shape(cloud, spheres, edges.reach, settings.end)
    trust = settings.trust
    halved = _halved(edges, settings.pairing)
    clutter = cloud.consistent < (trust.fast_consistent if halved else trust.min_consistent)
    faint = cloud.score < trust.min_score
    if not len(shape.voxels):
        weak = faint or clutter
        why = _nothing_consistent(cloud) if weak else _only_the_hand()
        return refused(METHOD, used, why), None
    found = find_ends(edges, cloud, shape, spheres, settings)
    convincing = found[0].agreement >= trust.convincing_agreement
    # noise hides edges and spoils their matches; silhouettes need neither
    if (clutter and not convincing) or (faint and not (convincing and found[0].by_outlines)):
        return refused(METHOD, used, _nothing_consistent(cloud)), None
    candidates = [end.candidate for end in found]
    if settings.prefer is not None:
        candidates = [preferred(candidates, np.array(settings.prefer))]
    first = candidates[0]
    reason = _hidden(first.position, edges, trust)
    if reason is not None:
        return refused(METHOD, used, reason), None
    end = next(end for end in found if end.candidate is first)
    agreement = end.agreement
    reasons = () if len(candidates) == 1 else (_ambiguous(candidates),)
    if agreement < trust.doubtful_agreement:
        reasons = (*reasons, _disagreeing(agreement))
    reasons = (*reasons, *_uncertain(first.covariance, trust, _OF_END))
    found_tip = TipEstimate(
        METHOD, first.position, first.covariance, tuple(candidates), reasons, used
    )
    if agreement >= trust.full_agreement:
        return found_tip, None
    part = close_part(edges, cloud, end, settings.refine)
    return found_tip, None if part is None else Doubt(cloud, part)


def less_sure(estimate: TipEstimate, covariance: Array, trust: TrustParams) -> TipEstimate:
    """Return an estimate with what is unknown of clocks and camera added to all that it states.

    Args:
        covariance: (3, 3) m^2, hand frame, of the tip.
    """
    candidates = tuple(
        item if item.covariance is None else replace(item, covariance=item.covariance + covariance)
        for item in estimate.candidates
    )
    if estimate.covariance is None:
        return replace(estimate, candidates=candidates)
    covariance, reasons = estimate.covariance + covariance, estimate.reasons
    if not any(reason.code == _UNCERTAIN for reason in reasons):
        reasons = (*reasons, *_uncertain(covariance, trust, _OF_RIG))
    return replace(estimate, covariance=covariance, candidates=candidates, reasons=reasons)


def preferred(candidates: list[Candidate], direction: Array) -> Candidate:
    """Return the candidate that lies farthest in a direction (3,), hand frame."""
    return max(candidates, key=lambda item: float(item.position @ direction))


def _halved(edges: HandEdges, params: PairingParams) -> bool:
    """Return whether the motion between partners is too far for whole images.

    Matches of smaller images are less certain, so more of them fit a hand that moves otherwise.
    """
    probes = probe_pixels(edges.camera_from_hand, edges.focal_px, params)
    moving = edges.moving
    moved = displacement(probes[moving.frames][:, None], probes[moving.partners])
    return bool((moved > params.max_displacement_px).any())


def _hidden(position: Array, edges: HandEdges, trust: TrustParams) -> Reason | None:
    """Return why the end that was found may not be the tool's end, or None."""
    if np.linalg.norm(position) > 0.95 * edges.reach:
        return Reason(
            "beyond_reach",
            f"the tool reaches to where the search ends, {edges.reach:.2f} m from the hand; "
            "its end may lie farther out",
        )
    camera = edges.camera_from_hand[edges.moving.frames]
    points = camera[:, :3, :3] @ position + camera[:, :3, 3]
    normalized = points[:, :2] / np.maximum(points[:, 2:], 1e-6)
    low, high = edges.extent
    inside = ((normalized > low) & (normalized < high)).all(axis=1) & (points[:, 2] > 0)
    share = float(inside.mean())
    if share < trust.min_in_view:
        return Reason(
            "out_of_view",
            f"the tool's end lies inside the image in only {share:.0%} of the frames; hold the "
            "tool nearer to the middle of the image",
        )
    return None


def _nothing_consistent(cloud: Cloud) -> Reason:
    return Reason(
        "inconsistent_views",
        f"only {cloud.consistent:.0%} of what moves is fixed to the hand, and no place on the hand "
        f"shows in more than {cloud.score:.0%} of the frames; check the calibration and the "
        "clocks, keep the fingers still, and let nothing else move near the hand",
    )


def _only_the_hand() -> Reason:
    return Reason(
        "nothing_beyond_the_hand",
        "nothing fixed to the hand shows outside the spheres that stand for hand and wrist; check "
        "hand.spheres in the rig file, and that the hand holds a tool",
    )


def _disagreeing(agreement: float) -> Reason:
    share = f"only {agreement:.0%} of what the images show of the end fits"
    return Reason(
        "images_disagree",
        (share if agreement else "the images show too little of the end")
        + "; the clocks or the camera's pose may be off: tooltip calibrate, with several "
        "recordings, finds out by how much",
    )


def _uncertain(covariance: Array | None, trust: TrustParams, why: str) -> tuple[Reason, ...]:
    std = 0.0 if covariance is None else largest_std(covariance)
    if std <= trust.doubtful_std:
        return ()
    away = f"the end may lie {1000 * std:.0f} mm away (one standard deviation), "
    return (Reason(_UNCERTAIN, away + why),)


def _ambiguous(candidates: list[Candidate]) -> Reason:
    others = ", ".join(
        "(" + ", ".join(f"{1000 * value:.0f}" for value in item.position) + ")"
        for item in candidates[1:]
    )
    return Reason(
        "ambiguous_end",
        f"the tool has {len(candidates)} ends that could be meant; the "
        f"one farthest from the wrist is given, the others are at {others} mm; --prefer with one "
        "of these as direction chooses",
    )
