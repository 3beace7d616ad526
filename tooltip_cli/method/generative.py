"""The generative model of appendix B: a Gaussian around the projected tip, mixed with clutter.

``p(d | x, c) = (1 - u) N(P_c x, sigma^2 I)(d) + u b(d)`` with b uniform over the image. Pixels are
those of the ideal pin-hole camera, the lens distortion undone. The paper gives neither u nor sigma:
both are fitted together with the tip by expectation maximisation, within bounds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tooltip_cli.method.types import Array, Indices, Mask

_EM_STEPS = 200
_NEWTON_STEPS = 20
_TOLERANCE_M = 1e-9


@dataclass(frozen=True)
class Observations:
    """Detections as ideal pixels, with the camera's pose in the hand frame."""

    normalized: Array  # (N, 2) x/z, y/z of the viewing direction, optical frame
    camera_from_hand: Array  # (N, 4, 4)
    focal_px: float  # pixels per unit of normalized coordinates
    image_area_px: float  # pixels^2, the support of b

    def select(self, keep: Mask | Indices) -> Observations:
        """Return the chosen rows."""
        return replace(
            self, normalized=self.normalized[keep], camera_from_hand=self.camera_from_hand[keep]
        )


@dataclass(frozen=True)
class MixtureFit:
    """A local maximum of the posterior."""

    position: Array  # (3,) metres, hand frame
    sigma_px: float  # standard deviation of good detections
    outlier_share: float  # u
    log_likelihood: float
    responsibilities: Array  # (N,) probability that a detection is not clutter


def residuals(observations: Observations, position: Array) -> tuple[Array, Array]:
    """Return reprojection errors and their derivative with respect to the tip.

    Args:
        position: (3,) metres, hand frame.

    Returns:
        (N, 2) pixels (infinite behind the camera) and (N, 2, 3) pixels per metre.
    """
    rotation = observations.camera_from_hand[:, :3, :3]
    points = rotation @ position + observations.camera_from_hand[:, :3, 3]
    depth = points[:, 2]
    ahead = depth > 1e-6
    safe = np.where(ahead, depth, 1.0)
    projected = points[:, :2] / safe[:, None]
    errors = observations.focal_px * (projected - observations.normalized)
    jacobian = (rotation[:, :2, :] - projected[:, :, None] * rotation[:, 2:3, :]) / safe[
        :, None, None
    ]
    errors[~ahead] = np.inf
    jacobian[~ahead] = 0.0
    return errors, observations.focal_px * jacobian


def fit_mixture(
    observations: Observations,
    start: Array,
    *,
    sigma_start_px: float,
    sigma_min_px: float,
    sigma_max_px: float,
    outlier_start: float = 0.5,
) -> MixtureFit:
    """Climb to the nearest maximum by expectation maximisation.

    Args:
        start: (3,) metres, hand frame.

    Returns:
        The fit; its position is ``start`` when nothing supports it.
    """
    position, sigma, outliers = start.astype(float), sigma_start_px, outlier_start
    for _ in range(_EM_STEPS):
        _, good = _expectation(observations, position, sigma, outliers)
        moved = _weighted_least_squares(observations, position, good)
        errors, _ = residuals(observations, moved)
        squared = np.where(good > 0, np.square(np.where(good[:, None] > 0, errors, 0)).sum(1), 0)
        total = good.sum()
        if total < 1e-3:
            break
        sigma_new = float(
            np.clip(np.sqrt((good * squared).sum() / (2 * total)), sigma_min_px, sigma_max_px)
        )
        outliers_new = float(np.clip(1 - total / len(good), 1e-4, 0.999))
        settled = (
            np.linalg.norm(moved - position) < _TOLERANCE_M
            and abs(sigma_new - sigma) < 1e-6 * sigma
            and abs(outliers_new - outliers) < 1e-6
        )
        position, sigma, outliers = moved, sigma_new, outliers_new
        if settled:
            break
    likelihood, good = _expectation(observations, position, sigma, outliers)
    return MixtureFit(position, sigma, outliers, likelihood, good)


def _expectation(
    observations: Observations, position: Array, sigma: float, outliers: float
) -> tuple[float, Array]:
    """Return the log-likelihood of all detections and each one's probability of being good."""
    errors, _ = residuals(observations, position)
    squared = np.square(errors).sum(axis=1)
    gaussian = (1 - outliers) * np.exp(-0.5 * squared / sigma**2) / (2 * np.pi * sigma**2)
    total = gaussian + outliers / observations.image_area_px
    return float(np.log(total).sum()), gaussian / total


def _weighted_least_squares(observations: Observations, position: Array, weights: Array) -> Array:
    """Minimise the weighted squared reprojection error by damped Gauss-Newton steps."""
    used = weights > 1e-12
    weights, observations = weights[used], observations.select(used)
    damping = 1e-9
    errors, jacobian = residuals(observations, position)
    cost = float((weights * np.square(errors).sum(axis=1)).sum())
    for _ in range(_NEWTON_STEPS):
        normal = np.einsum("n,nki,nkj->ij", weights, jacobian, jacobian)
        gradient = np.einsum("n,nki,nk->i", weights, jacobian, errors)
        scale = np.trace(normal) / 3
        if not np.isfinite(scale) or scale <= 0:
            break
        step = np.linalg.solve(normal + damping * scale * np.eye(3), -gradient)
        trial_errors, trial_jacobian = residuals(observations, position + step)
        trial_cost = float((weights * np.square(trial_errors).sum(axis=1)).sum())
        if trial_cost <= cost:
            position, errors, jacobian, cost = (
                position + step,
                trial_errors,
                trial_jacobian,
                trial_cost,
            )
            damping = max(damping / 10, 1e-12)
            if np.linalg.norm(step) < _TOLERANCE_M:
                break
        else:
            damping = max(damping, 1e-6) * 10
            if damping > 1e6:
                break
    return position


def curvature_covariance(observations: Observations, fit: MixtureFit) -> Array | None:
    """Return the inverse of the observed information at the maximum (Laplace approximation).

    Returns:
        (3, 3) m^2, or None where the log-likelihood has no maximum in some direction.
    """
    step = 1e-5
    hessian = np.empty((3, 3))
    for axis, offset in enumerate(np.eye(3) * step):
        ahead = _gradient(observations, fit.position + offset, fit)
        behind = _gradient(observations, fit.position - offset, fit)
        hessian[axis] = (ahead - behind) / (2 * step)
    information = -(hessian + hessian.T) / 2
    values, vectors = np.linalg.eigh(information)
    if not np.isfinite(values).all() or values[0] <= 0:
        return None
    covariance: Array = (vectors / values) @ vectors.T
    return covariance


def _gradient(observations: Observations, position: Array, fit: MixtureFit) -> Array:
    errors, jacobian = residuals(observations, position)
    _, good = _expectation(observations, position, fit.sigma_px, fit.outlier_share)
    finite = np.where(np.isfinite(errors), errors, 0.0)
    gradient: Array = -np.einsum("n,nki,nk->i", good, jacobian, finite) / fit.sigma_px**2
    return gradient
