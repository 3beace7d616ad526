"""Appendix B: the mixture's derivatives, its maximum, and the covariance that it claims."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers.scenes import FOCAL, TIP, looking_at, observe
from tooltip_cli.method.generative import (
    MixtureFit,
    Observations,
    curvature_covariance,
    fit_mixture,
    residuals,
)

Array = npt.NDArray[np.float64]
CHI2_95_3 = 7.814727903251179  # 95 % quantile of chi-squared with three degrees of freedom


def fit(observations: Observations, start: Array) -> MixtureFit:
    return fit_mixture(
        observations, start, sigma_start_px=20.0, sigma_min_px=0.1, sigma_max_px=30.0
    )


def log_likelihood(observations: Observations, tip: Array, sigma: float, u: float) -> float:
    """Evaluate the model of appendix B term by term."""
    total = 0.0
    for seen, pose in zip(observations.normalized, observations.camera_from_hand, strict=True):
        x, y, z = pose[:3, :3] @ tip + pose[:3, 3]
        distance = FOCAL * np.hypot(x / z - seen[0], y / z - seen[1])
        normal = np.exp(-(distance**2) / (2 * sigma**2)) / (2 * np.pi * sigma**2)
        total += np.log((1 - u) * normal + u / observations.image_area_px)
    return float(total)


@settings(max_examples=50, deadline=None)
@given(
    x=st.floats(-0.2, 0.2), y=st.floats(-0.2, 0.2), z=st.floats(-0.2, 0.2), seed=st.integers(0, 50)
)
def test_the_jacobian_equals_finite_differences(x: float, y: float, z: float, seed: int) -> None:
    observations = observe(count=5, noise_px=3.0, seed=seed)
    position, step = np.array([x, y, z]), 1e-6
    errors, jacobian = residuals(observations, position)
    assert errors.shape == (5, 2)
    for axis, offset in enumerate(np.eye(3) * step):
        ahead, _ = residuals(observations, position + offset)
        behind, _ = residuals(observations, position - offset)
        numerical = (ahead - behind) / (2 * step)
        assert np.allclose(jacobian[:, :, axis], numerical, rtol=1e-5, atol=1e-3)


def test_the_true_tip_has_no_residual() -> None:
    errors, _ = residuals(observe(count=30), TIP)
    assert np.abs(errors).max() < 1e-9


def test_a_tip_behind_the_camera_explains_nothing() -> None:
    observations = observe(count=4)
    errors, jacobian = residuals(observations, TIP + np.array([0.0, 0.0, -50.0]))
    assert np.isinf(errors).all()
    assert not jacobian.any()


def test_the_likelihood_is_that_of_the_appendix() -> None:
    observations = observe(count=25, noise_px=2.0, outliers=0.3, seed=4)
    found = fit(observations, TIP)
    wanted = log_likelihood(observations, found.position, found.sigma_px, found.outlier_share)
    assert abs(found.log_likelihood - wanted) < 1e-6


@pytest.mark.parametrize("seed", range(4))
def test_the_fit_is_a_maximum_in_every_parameter(seed: int) -> None:
    observations = observe(count=80, noise_px=2.0, outliers=0.25, seed=seed)
    found = fit(observations, TIP + 0.01)

    def at(moved: MixtureFit) -> float:
        return log_likelihood(observations, moved.position, moved.sigma_px, moved.outlier_share)

    best = at(found)
    for offset in np.concatenate([np.eye(3), -np.eye(3)]) * 2e-4:
        assert at(replace(found, position=found.position + offset)) < best
    for factor in (0.98, 1.02):
        assert at(replace(found, sigma_px=found.sigma_px * factor)) < best
        assert at(replace(found, outlier_share=found.outlier_share * factor)) < best


@pytest.mark.parametrize("seed", range(8))
def test_a_tip_is_found_among_forty_percent_outliers(seed: int) -> None:
    observations = observe(count=200, noise_px=2.0, outliers=0.4, seed=seed)
    found = fit(observations, TIP + np.array([0.02, -0.03, 0.02]))
    assert np.linalg.norm(found.position - TIP) < 0.0015
    assert abs(found.sigma_px - 2.0) < 0.4
    assert abs(found.outlier_share - 0.4) < 0.12
    assert found.responsibilities.shape == (200,)
    assert ((found.responsibilities >= 0) & (found.responsibilities <= 1)).all()


def test_responsibilities_tell_detections_from_clutter() -> None:
    observations = observe(count=200, noise_px=1.0, outliers=0.3, seed=1)
    errors, _ = residuals(observations, TIP)
    near = np.linalg.norm(errors, axis=1) < 4.0
    good = fit(observations, TIP + 0.01).responsibilities
    assert good[near].min() > 0.5
    assert good[np.linalg.norm(errors, axis=1) > 12.0].max() < 0.01


@pytest.mark.parametrize(("outliers", "noise_px"), [(0.0, 1.5), (0.3, 3.0)])
def test_the_covariance_covers_the_truth_as_often_as_it_says(
    outliers: float, noise_px: float
) -> None:
    trials, held = 200, 0
    for seed in range(trials):
        observations = observe(count=60, noise_px=noise_px, outliers=outliers, seed=seed)
        found = fit(observations, TIP)
        covariance = curvature_covariance(observations, found)
        assert covariance is not None
        offset = found.position - TIP
        held += float(offset @ np.linalg.solve(covariance, offset)) < CHI2_95_3
    assert 0.90 <= held / trials <= 0.99


def test_the_covariance_without_clutter_is_the_least_squares_one() -> None:
    observations = observe(count=100, noise_px=2.0, seed=2)
    found = fit(observations, TIP)
    # certain that nothing is clutter: the curvature is that of a least-squares problem
    sure = replace(found, outlier_share=1e-12)
    covariance = curvature_covariance(observations, sure)
    _, jacobian = residuals(observations, found.position)
    information = np.einsum("nki,nkj->ij", jacobian, jacobian) / sure.sigma_px**2
    assert covariance is not None
    assert np.allclose(covariance, np.linalg.inv(information), rtol=0.05)
    assert np.allclose(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance)[0] > 0


def test_more_views_make_it_surer() -> None:
    sizes = []
    for count in (20, 80, 320):
        observations = observe(count=count, noise_px=2.0, seed=1)
        covariance = curvature_covariance(observations, fit(observations, TIP))
        assert covariance is not None
        sizes.append(float(np.sqrt(np.trace(covariance))))
    assert 1.6 < sizes[0] / sizes[1] < 2.6
    assert 1.6 < sizes[1] / sizes[2] < 2.6


def test_one_view_has_no_maximum_along_its_ray() -> None:
    observations = looking_at(TIP, np.zeros((5, 3)))  # five times the same view
    found = fit(observations, TIP)
    covariance = curvature_covariance(observations, found)
    assert covariance is None or np.linalg.eigvalsh(covariance)[-1] > 1.0


def test_without_support_the_start_is_returned() -> None:
    observations = observe(count=10)
    start = TIP + np.array([0.0, 0.0, -50.0])  # behind every camera
    assert np.array_equal(fit(observations, start).position, start)


@settings(max_examples=20, deadline=None)
@given(order=st.permutations(range(30)))
def test_the_order_of_detections_does_not_matter(order: list[int]) -> None:
    observations = observe(count=30, noise_px=2.0, outliers=0.2, seed=5)
    shuffled = replace(
        observations,
        normalized=observations.normalized[order],
        camera_from_hand=observations.camera_from_hand[order],
    )
    first, second = fit(observations, TIP), fit(shuffled, TIP)
    assert np.abs(first.position - second.position).max() < 1e-8
    assert np.abs(first.responsibilities[order] - second.responsibilities).max() < 1e-5


def test_bounds_on_sigma_are_kept() -> None:
    exact = fit(observe(count=50), TIP)
    assert exact.sigma_px == 0.1
    noisy = fit_mixture(
        observe(count=100, noise_px=8.0),
        TIP,
        sigma_start_px=4.0,
        sigma_min_px=0.1,
        sigma_max_px=5.0,
    )
    assert noisy.sigma_px == 5.0
