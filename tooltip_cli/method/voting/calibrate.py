"""Clock offset and a small correction of the camera's pose, from the same edges as the tip.

The equations of :mod:`equations` gain unknowns that recordings of one robot share: the offset tau
between the image and joint clocks, and a rotation r and translation t of the camera. A point X of
the tool moves in the camera by dP = (dT/dtau X) tau + r x P + t. What belongs to one recording
alone (its tip, axis and outlines) is eliminated (Schur complement), the rest is added up.

A wrist that only turns does not show everything: a camera that is a little farther off looks like a
tool that is a little longer. Only directions that the frames determine are corrected.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tooltip_cli.method.types import Array, Correction, Refinement
from tooltip_cli.method.voting.equations import residuals_of, robust_weights
from tooltip_cli.method.voting.params import CalibrationParams, RefineParams
from tooltip_cli.method.voting.refine import Fit, best_fit, fit_end
from tooltip_cli.method.voting.sight import NearEdges

PosesAt = Callable[[float], Array]
"""Return (F, 4, 4) camera_from_hand of the chosen frames with image stamps shifted, seconds."""

_LOOSE_MOVE = 0.03  # metres that an end may move by while clocks and camera are put right
_RATE_STEP_S = 0.004  # half the interval over which the hand's motion is differenced


@dataclass(frozen=True)
class Seen:
    """What one recording shows of its tool's end."""

    near: NearEdges
    poses_at: PosesAt
    position: Array  # (3,) metres, hand frame: the end as found without any correction
    axis: Array  # (3,) unit vector, hand frame
    radius: float  # metres


def corrected(poses_at: PosesAt, correction: Correction) -> Array:
    """Return (F, 4, 4) camera_from_hand with a correction applied."""
    return np.asarray(correction.corrected_from_camera @ poses_at(correction.time_offset))


def calibrate(
    recordings: Sequence[Seen],
    camera: bool,
    params: CalibrationParams,
    refine: RefineParams,
) -> Refinement | None:
    """Solve for what recordings of one robot share; None: no end can be fitted.

    How wide an end is is known roughly before clocks and camera are right. So it is solved for with
    ends as wide as they seem, and wider, until enough fits. Returned is what corrects something,
    and of such the one with which most fits.

    Args:
        camera: whether the camera's pose may be corrected besides the clocks' offset. It is where
            clearly more frames fit with than without.
    """
    best: Refinement | None = None
    for factor in params.radius_factors:
        scaled = [replace(seen, radius=factor * seen.radius) for seen in recordings]
        found = _calibrated(scaled, camera, params, refine)
        if found is None:
            continue
        if best is not None:  # what it is measured by
            before = best.support_before
            helps = found.applied and found.support_after > before
            found = replace(found, applied=helps, support_before=before)
        if best is None or _worth(found) > _worth(best):
            best = found
        if best.support_after > params.enough_support:
            break
    return best


def _worth(found: Refinement) -> tuple[bool, float]:
    return found.applied, found.support_after


def _calibrated(
    recordings: Sequence[Seen], camera: bool, params: CalibrationParams, refine: RefineParams
) -> Refinement | None:
    """Solve once."""
    start = _fits_without(recordings, refine)
    if all(fit is None for fit in start):
        return None
    clocks = _solved(recordings, start, np.array([params.time_prior]), params, refine)
    if not camera:
        return _told(recordings, clocks, clocks, refine)
    rotation = np.full(3, np.radians(params.rotation_prior_deg))
    sigmas = np.concatenate([[params.time_prior], rotation, np.full(3, params.translation_prior)])
    both = _solved(recordings, start, sigmas, params, refine)
    gain = both.found.support_after - clocks.found.support_after
    used = both if gain > params.camera_gain else clocks
    return _told(recordings, used, both, refine)


@dataclass(frozen=True)
class _Solution:
    found: Refinement
    values: Array  # (K,) offset, rotation and translation, or the offset alone
    covariance: Array  # (K, K) of them
    fits: Sequence[Fit | None]  # each recording's end with them


def _told(
    recordings: Sequence[Seen], used: _Solution, full: _Solution, refine: RefineParams
) -> Refinement:
    """Return what is used, with what the rest leaves unknown of each recording's tip.

    What the full solution says besides and is not used is in doubt as a whole.
    """
    missing = full.values.copy()
    if used.found.applied:
        missing[: len(used.values)] -= used.values
    doubt = full.covariance + np.outer(missing, missing)
    correction = _correction(full.values)
    tips = []
    for seen, fit in zip(recordings, full.fits, strict=True):
        follow = np.zeros((3, len(missing)))
        if fit is not None:
            shared = _shared_derivatives(seen, fit, correction, len(missing))
            follow = _followed(fit, shared, refine)[3][:3]
        tips.append(follow @ doubt @ follow.T)
    return replace(used.found, tip_covariances=tuple(tips))


def _fits_without(recordings: Sequence[Seen], refine: RefineParams) -> list[Fit | None]:
    """Fit each end as it is; where too little agrees, as well as can be, for a start."""
    fits: list[Fit | None] = []
    for seen in recordings:
        found = best_fit(seen.near, seen.position, seen.axis, seen.radius, refine)
        if found is None:
            loose = _loose(refine, 1.0)
            found = fit_end(seen.near, seen.position, seen.axis, seen.radius, loose)
        fits.append(found)
    return fits


def _loose(refine: RefineParams, factor: float) -> RefineParams:
    """Return parameters for ends that wrong clocks or cameras have blurred."""
    loss = max(refine.loss_px, factor * refine.first_loss_px)
    return replace(refine, loss_px=loss, max_move=_LOOSE_MOVE)


def _solved(
    recordings: Sequence[Seen],
    start: list[Fit | None],
    sigmas: Array,
    params: CalibrationParams,
    refine: RefineParams,
) -> _Solution:
    fits, values = start, np.zeros(len(sigmas))
    information, scatter = np.eye(len(sigmas)), np.eye(len(sigmas))
    for index in range(params.rounds):
        loose = _loose(refine, 0.6**index)
        information, scatter, right = _gathered(recordings, fits, values, loose)
        # in the frames' own terms: robust weights are not inverse variances, and a shape that is
        # not quite what the equations say is wrong in all frames alike
        variances = sigmas**2
        scale = (np.diag(scatter) @ variances) / max(float(np.diag(information) @ variances), 1e-12)
        # not nothing where frames say nothing, as of clocks of a hand that stands still
        prior = params.common_error * max(float(scale), 1e-12) * np.diag(1.0 / variances)
        step = np.linalg.solve(information + prior, right - prior @ values)
        values = values + step
        fits = _refit(recordings, fits, values, loose)
        if np.abs(step / sigmas).max() < params.settled and loose.loss_px <= refine.loss_px:
            break
    values, covariance, determined = _determined(values, sigmas, information, scatter, params)
    deviations = np.sqrt(np.diag(covariance))
    fits = _refit(recordings, fits, values, replace(refine, max_move=_LOOSE_MOVE))
    before, after = (
        float(np.mean([0.0 if fit is None else fit.support(refine) for fit in group]))
        for group in (start, fits)
    )
    certain = len(sigmas) > 1 or bool(abs(values[0]) > params.certain * deviations[0])
    helps = determined > 0 and certain and after > before
    found = Refinement(_correction(values), deviations, helps, before, after)
    return _Solution(found, values, covariance, fits)


def _correction(values: Array) -> Correction:
    if len(values) == 1:
        return Correction(float(values[0]))
    return Correction(float(values[0]), values[1:4], values[4:])


def _refit(
    recordings: Sequence[Seen], fits: Sequence[Fit | None], values: Array, refine: RefineParams
) -> list[Fit | None]:
    correction = _correction(values)
    again: list[Fit | None] = []
    for seen, fit in zip(recordings, fits, strict=True):
        if fit is None:
            again.append(None)
            continue
        near = replace(seen.near, camera_from_hand=corrected(seen.poses_at, correction))
        width = fit.end_width if fit.pointed else None
        again.append(fit_end(near, fit.position, fit.axis, seen.radius, refine, width) or fit)
    return again


def _gathered(
    recordings: Sequence[Seen], fits: Sequence[Fit | None], values: Array, refine: RefineParams
) -> tuple[Array, Array, Array]:
    """Return information (K, K), scatter (K, K) of its frames, and right side (K,), summed."""
    size = len(values)
    information, scatter, right = np.zeros((size, size)), np.zeros((size, size)), np.zeros(size)
    correction = _correction(values)
    for seen, fit in zip(recordings, fits, strict=True):
        if fit is not None:
            shared = _shared_derivatives(seen, fit, correction, size)
            one = _reduced(fit, shared, refine)
            information, scatter, right = information + one[0], scatter + one[1], right + one[2]
    return information, scatter, right


def _shared_derivatives(seen: Seen, fit: Fit, correction: Correction, size: int) -> Array:
    """Return (R, K): how the equations' targets change with what recordings share."""
    system = fit.system
    tau = correction.time_offset
    shifted = [
        corrected(seen.poses_at, replace(correction, time_offset=tau + step))
        for step in (-_RATE_STEP_S, _RATE_STEP_S)
    ]
    poses = corrected(seen.poses_at, correction)[system.frames]
    rate = ((shifted[1] - shifted[0]) / (2.0 * _RATE_STEP_S))[system.frames]
    points = fit.position + system.places[:, None] * fit.axis
    velocity = np.einsum("rij,rj->ri", rate[:, :3, :3], points) + rate[:, :3, 3]
    towards = np.einsum("rij,rj->ri", poses[:, :3, :3], system.towards)  # camera frame
    derivatives = np.empty((len(towards), size))
    derivatives[:, 0] = (velocity * towards).sum(axis=1)
    if size > 1:
        in_camera = np.einsum("rij,rj->ri", poses[:, :3, :3], points) + poses[:, :3, 3]
        derivatives[:, 1:4] = np.cross(in_camera, towards)
        derivatives[:, 4:] = towards
    return derivatives


def _reduced(fit: Fit, shared: Array, refine: RefineParams) -> tuple[Array, Array, Array]:
    """Eliminate a recording's own unknowns from its normal equations."""
    residuals, weights, own, follow = _followed(fit, shared, refine)
    free = shared - own @ follow
    information = shared.T @ (weights * free)
    scores = np.zeros((int(fit.system.frames.max()) + 1, shared.shape[1]))
    np.add.at(scores, fit.system.frames, weights * residuals[:, None] * free)
    return (information + information.T) / 2, scores.T @ scores, scores.sum(axis=0)


def _followed(fit: Fit, shared: Array, refine: RefineParams) -> tuple[Array, Array, Array, Array]:
    """Return (R,) residuals, (R, 1) weights, (R, U) own derivatives of a recording's equations, and
    (U, K) how its own unknowns follow what recordings share.
    """
    system = fit.system
    residuals, own = residuals_of(system, fit.unknowns)
    weights = robust_weights(system, residuals, fit.loss, refine)[:, None]
    normal = own.T @ (weights * own) + system.prior.T @ system.prior + 1e-9 * np.eye(own.shape[1])
    return residuals, weights, own, np.linalg.solve(normal, own.T @ (weights * shared))


def _determined(
    values: Array, sigmas: Array, information: Array, scatter: Array, params: CalibrationParams
) -> tuple[Array, Array, int]:
    """Keep what the frames determine, in units of what was expected.

    Returns:
        values (K,) without the rest, their covariance (K, K), and how many directions are kept.
    """
    scaled = np.linalg.inv(information * np.outer(sigmas, sigmas) + 1e-9 * np.eye(len(sigmas)))
    scores = params.common_error * scatter * np.outer(sigmas, sigmas)
    scores += 1e-9 * np.eye(len(sigmas))  # what has no information is not known exactly
    covariance = scaled @ scores @ scaled
    variances, directions = np.linalg.eigh(covariance)
    known = variances < params.determined**2
    kept = directions[:, known]
    projected = kept @ (kept.T @ (values / sigmas))
    spread = kept @ np.diag(variances[known]) @ kept.T
    rest = np.eye(len(sigmas)) - kept @ kept.T  # left as it was expected
    return projected * sigmas, (spread + rest) * np.outer(sigmas, sigmas), int(known.sum())
