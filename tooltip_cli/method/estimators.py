"""The 3D tip from pixels in many views: the paper's section 3.2 and appendix B."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from tooltip_cli.errors import TooltipError, one_of
from tooltip_cli.method import generative
from tooltip_cli.method.generative import MixtureFit, Observations
from tooltip_cli.method.kmeans import Clusters, kmeans, lloyd
from tooltip_cli.method.rays import Pairs, angular_spread, meeting_points, pairs_of, plausible
from tooltip_cli.method.types import (
    Array,
    Candidate,
    Indices,
    Mask,
    Rays,
    Reason,
    TipEstimate,
    largest_std,
    refused,
)
from tooltip_cli.method.voting.params import VotingSettings

_PAIRS_AT_ONCE = 1 << 18


@dataclass(frozen=True)
class EstimatorParams:
    """Constants of the estimators; defaults are the paper's where it gives them."""

    method: str = "voting"
    max_ray_distance: float = 0.0254  # metres (3.2: 2.54 cm)
    max_range: float = 3.0  # metres from the hand (3.2)
    clusters: int = 8  # k (4.3)
    z_start: float = 0.05  # metres, nothing is sharp or held nearer; not in the paper
    seed: int = 0  # of K-means' start and of the samples below; not in the paper
    max_pairs: int = 2_000_000  # of rays, all of 2,000; more are sampled; not in the paper
    max_views: int = 2_000  # to search appendix B's maxima in; more are sampled; not in the paper
    max_points: int = 250_000  # intersections to cluster; more are sampled; not in the paper
    sigma_start_px: float = 10.0  # appendix B's sigma, where the fit starts; not in the paper
    sigma_min_px: float = 0.1  # bounds on the fitted sigma; not in the paper
    sigma_max_px: float = 15.0
    min_views: int = 3  # refusal below; not in the paper
    min_view_angle_deg: float = 3.0  # refusal below; not in the paper
    max_deviation: float = 0.05  # metres, refusal above; not in the paper
    min_support: float = 0.05  # share of views that agree, refusal below; not in the paper
    max_disagreement: float = 0.05  # of agreeing views, pixels per image side; not in the paper
    # of the method "voting" alone; not in the paper
    voting: VotingSettings = field(default_factory=VotingSettings)

    @property
    def relevant(self) -> object:
        """What the chosen method depends on."""
        return self.voting if self.method == "voting" else replace(self, voting=VotingSettings())


@dataclass(frozen=True)
class EstimationInput:
    """Everything that an estimator sees: the tip's pixels as rays, and the hand."""

    rays: Rays  # in the hand frame
    directions_camera: Array  # (N, 3) unit vectors, optical frame
    camera_from_hand: Array  # (N, 4, 4)
    spheres: Array  # (S, 4) centre and radius, metres, hand frame
    focal_px: float
    image_area_px: float

    def observations(self) -> Observations:
        """Return the same as observations of the generative model."""
        return Observations(
            self.directions_camera[:, :2] / self.directions_camera[:, 2:],
            self.camera_from_hand,
            self.focal_px,
            self.image_area_px,
        )


def estimate_tip(data: EstimationInput, params: EstimatorParams) -> TipEstimate:
    """Estimate the tip in the hand frame from one pixel in each view.

    The method ``voting`` sees more than that; given pixels alone it is ``map``.

    Raises:
        TooltipError: unknown method.
    """
    if params.method not in METHODS:
        raise TooltipError(one_of("method", params.method, METHODS))
    method = params.method if params.method in ESTIMATORS else "map"
    reasons = _too_little(data, params)
    if reasons:
        return refused(method, len(data.rays), *reasons)
    return ESTIMATORS[method](data, params)


def hypotheses(data: EstimationInput, params: EstimatorParams) -> tuple[Array, Pairs]:
    """Return the plausible intersections of all pairs of rays and the pairs' indices (3.2).

    Where there are more pairs or points than the parameters allow, of a seeded sample.
    """
    meet = partial(
        meeting_points,
        data.rays,
        max_distance=params.max_ray_distance,
        z_start=params.z_start,
    )
    first, second = pairs_of(len(data.rays), params.max_pairs, params.seed)
    found = [np.zeros(0, np.int32)]
    for start in range(0, len(first), _PAIRS_AT_ONCE):
        part = slice(start, start + _PAIRS_AT_ONCE)
        points, rows = meet(first[part], second[part])
        found.append(start + rows[plausible(points, data.spheres, params.max_range)])
    keep = np.concatenate(found)
    if len(keep) > params.max_points:
        rng = np.random.default_rng(params.seed)
        keep = np.sort(rng.choice(keep, params.max_points, replace=False))
    first, second = first[keep], second[keep]
    # found once more, as all that are not kept would take ten times the memory
    return meet(first, second)[0], np.stack([first, second], axis=1)


def estimate_kmeans(data: EstimationInput, params: EstimatorParams) -> TipEstimate:
    """Section 3.2: cluster the pairs' intersections, take the largest cluster's mean."""
    points, pairs = hypotheses(data, params)
    if not len(points):
        return refused("kmeans", len(data.rays), _inconsistent(0, len(data.rays)))
    clusters = kmeans(points, params.clusters, params.seed)
    candidates = tuple(
        Candidate(mean, float(size / len(points)))
        for mean, size in zip(clusters.means, clusters.sizes, strict=True)
    )
    covariance = _jackknife(points, pairs, clusters, data.rays.frames)
    count = len(data.rays)
    if covariance is not None and (
        count * (count - 1) // 2 > params.max_pairs or len(points) == params.max_points
    ):
        covariance += _redrawn(data, params, clusters.largest)
    return _checked("kmeans", candidates, covariance, data, params)


def estimate_map(data: EstimationInput, params: EstimatorParams) -> TipEstimate:
    """Appendix B: the maximum of the posterior, its covariance from the curvature there.

    Of very many views a seeded sample decides between the maxima; all then decide where it lies.
    """
    observations = data.observations()
    sample = observations
    if len(data.rays) > params.max_views:
        rng = np.random.default_rng(params.seed)
        sample = observations.select(rng.choice(len(data.rays), params.max_views, replace=False))

    def climb(seen: Observations, start: Array, sigma_px: float, outliers: float) -> MixtureFit:
        return generative.fit_mixture(
            seen,
            start,
            sigma_start_px=sigma_px,
            sigma_min_px=params.sigma_min_px,
            sigma_max_px=params.sigma_max_px,
            outlier_start=outliers,
        )

    fits = [climb(sample, start, params.sigma_start_px, 0.5) for start in _starts(data, params)]
    allowed = [
        fit for fit in fits if plausible(fit.position[None], data.spheres, params.max_range)[0]
    ]
    if not allowed:
        return refused("map", len(data.rays), _inconsistent(0, len(data.rays)))
    ranked = _distinct(sorted(allowed, key=lambda fit: -fit.log_likelihood))
    if sample is not observations:
        best = ranked[0]
        ranked[0] = climb(observations, best.position, best.sigma_px, best.outlier_share)
    candidates = tuple(
        Candidate(fit.position, float(fit.responsibilities.mean())) for fit in ranked
    )
    covariance = generative.curvature_covariance(observations, ranked[0])
    return _checked("map", candidates, covariance, data, params)


ESTIMATORS: dict[str, Callable[[EstimationInput, EstimatorParams], TipEstimate]] = {
    "kmeans": estimate_kmeans,
    "map": estimate_map,
}
METHODS = ("voting", *ESTIMATORS)


def _starts(data: EstimationInput, params: EstimatorParams) -> list[Array]:
    """Return where to start climbing: the clusters' means and the point nearest to all rays."""
    points, _ = hypotheses(data, params)
    starts = list(kmeans(points, params.clusters, params.seed).means) if len(points) else []
    return [*starts, nearest_point(data.rays)]


def nearest_point(rays: Rays) -> Array:
    """Return the (3,) point with the least squared distance to all lines, metres."""
    projectors = np.eye(3) - rays.directions[:, :, None] * rays.directions[:, None, :]
    normal = projectors.sum(axis=0)
    right = np.einsum("nij,nj->i", projectors, rays.origins)
    point: Array = np.linalg.lstsq(normal, right, rcond=None)[0]
    return point


def _distinct(fits: list[MixtureFit], distance: float = 0.005) -> list[MixtureFit]:
    """Keep the first of fits that climbed to the same place (within 5 mm)."""
    kept: list[MixtureFit] = []
    for fit in fits:
        if all(np.linalg.norm(fit.position - other.position) > distance for other in kept):
            kept.append(fit)
    return kept


def _jackknife(
    points: Array, pairs: Pairs, clusters: Clusters, frames: Indices, groups: int = 10
) -> Array | None:
    """Covariance of the largest cluster's mean from leaving out a tenth of the frames in turn.

    Intersections are not independent (each ray takes part in many), so the scatter within the
    cluster says little; leaving out frames respects that. Frames are grouped by index modulo ten.
    """
    member = frames % groups
    means = []
    for group in range(groups):
        keep = (member[pairs] != group).all(axis=1)
        if keep.all() or not keep.any():
            continue
        moved, _ = lloyd(points[keep], clusters.means)
        means.append(moved[0])
    if len(means) < 2:
        return None
    deviations = np.array(means) - np.mean(means, axis=0)
    covariance: Array = (len(means) - 1) / len(means) * deviations.T @ deviations
    return covariance


def _redrawn(data: EstimationInput, params: EstimatorParams, mean: Array, draws: int = 4) -> Array:
    """Scatter of a cluster's mean when pairs, points and K-means' start are drawn anew.

    K-means has several solutions where wrong intersections lie all around the right ones, and with
    very many frames these differ by more than the jackknife tells.
    """
    offsets = []
    for draw in range(1, draws + 1):
        again = replace(params, seed=params.seed + draw)
        means = kmeans(hypotheses(data, again)[0], params.clusters, again.seed).means
        offsets.append(means[np.argmin(np.linalg.norm(means - mean, axis=1))] - mean)
    scatter: Array = np.array(offsets).T @ np.array(offsets) / draws
    return scatter


def _too_little(data: EstimationInput, params: EstimatorParams) -> list[Reason]:
    count = len(data.rays)
    if count < params.min_views:
        return [
            Reason(
                "too_few_views",
                f"only {count} views show the tip, at least {params.min_views} are needed; record "
                "a longer sweep",
            )
        ]
    spread = np.degrees(angular_spread(data.rays.directions))
    return [_flat(spread)] if spread < params.min_view_angle_deg else []


def _flat(angle_deg: float) -> Reason:
    return Reason(
        "depth_unobservable",
        f"seen from the hand, the views differ by only {angle_deg:.1f} degrees, so the tip's depth "
        "cannot be told; turn the wrist about axes across the line of sight",
    )


def _checked(
    method: str,
    candidates: tuple[Candidate, ...],
    covariance: Array | None,
    data: EstimationInput,
    params: EstimatorParams,
) -> TipEstimate:
    """Return the estimate, or a refusal where it cannot be trusted."""
    position = candidates[0].position
    used = len(data.rays)
    agree = _agree(position, data, params)
    agreeing = int(np.count_nonzero(agree))
    # what clutter would put around any one pixel, and a margin for having looked everywhere
    chance = np.pi * params.max_disagreement**2 * used
    if agreeing < max(params.min_support * used, chance + 5 * np.sqrt(chance) + 2):
        return refused(method, used, _inconsistent(agreeing, used))
    # where the cameras stood, free of the pixels' errors, which spread the rays too
    lines = position - data.rays.origins[agree]
    parallax = angular_spread(lines / np.linalg.norm(lines, axis=1, keepdims=True))
    if np.degrees(parallax) < params.min_view_angle_deg:
        return refused(method, used, _flat(np.degrees(parallax)))
    if covariance is None:
        return refused(
            method,
            used,
            Reason(
                "depth_unobservable",
                "the views do not determine the tip in every direction; turn the wrist about "
                "another axis too",
            ),
        )
    deviation = largest_std(covariance)
    if deviation > params.max_deviation:
        return refused(
            method,
            used,
            Reason(
                "depth_unobservable",
                f"the tip's worst axis has a standard deviation of {deviation * 1000:.0f} mm, more "
                f"than {params.max_deviation * 1000:.0f} mm; turn the wrist further, and about "
                "axes across the line of sight",
            ),
        )
    return TipEstimate(method, position, covariance, candidates, (), used)


def _agree(position: Array, data: EstimationInput, params: EstimatorParams) -> Mask:
    """Return (N,) which views pass near a position and also show it near where they saw it.

    Near the camera every ray passes near every other, and only the pixel tells; far away it is the
    other way round.
    """
    offsets = position - data.rays.origins
    along = (offsets * data.rays.directions).sum(axis=1)
    distances = np.linalg.norm(offsets - along[:, None] * data.rays.directions, axis=1)
    errors, _ = generative.residuals(data.observations(), position)
    limit_px = params.max_disagreement * np.sqrt(data.image_area_px)
    near_px = np.linalg.norm(errors, axis=1) <= limit_px
    return np.asarray((along > params.z_start) & (distances <= params.max_ray_distance) & near_px)


def _inconsistent(agreeing: int, used: int) -> Reason:
    return Reason(
        "inconsistent_views",
        f"only {agreeing} of {used} views agree on any one point that is fixed to the hand; check "
        "the calibration, the clocks, and that the tool moves with the hand",
    )
