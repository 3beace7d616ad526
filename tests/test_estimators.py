"""Both estimators: the tip from noisy views, or the reason why it cannot be told."""

from __future__ import annotations

from dataclasses import replace

import click
import numpy as np
import numpy.typing as npt
import pytest

from tests.helpers.scenes import TIP, input_of, looking_at, observe, poses_of
from tooltip_cli.cli.estimate import estimate as command
from tooltip_cli.cli.options import METHODS
from tooltip_cli.errors import TooltipError
from tooltip_cli.method import estimators
from tooltip_cli.method.estimators import (
    EstimationInput,
    EstimatorParams,
    estimate_tip,
    hypotheses,
    nearest_point,
)
from tooltip_cli.method.generative import Observations
from tooltip_cli.method.types import Rays, TipEstimate
from tooltip_cli.method.voting.params import PUT_RIGHT

Array = npt.NDArray[np.float64]

both = pytest.mark.parametrize("method", ["kmeans", "map"])


def estimate(data: EstimationInput, method: str, **changes: float) -> TipEstimate:
    params: EstimatorParams = replace(EstimatorParams(method=method), **changes)  # type: ignore[arg-type]  # floats and ints
    return estimate_tip(data, params)


def error_mm(found: TipEstimate) -> float:
    assert found.position is not None
    return 1000 * float(np.linalg.norm(found.position - TIP))


def code_of(found: TipEstimate) -> str:
    assert found.status == "refused"
    assert found.position is None
    assert found.covariance is None
    (reason,) = found.reasons
    assert reason.text[0].islower() or reason.text[0].isdigit()
    return reason.code


def test_the_command_line_offers_every_method() -> None:
    assert estimators.METHODS == METHODS
    assert set(estimators.ESTIMATORS) < set(METHODS)


def test_the_command_line_knows_what_may_be_put_right() -> None:
    (kind,) = (item.type for item in command.params if item.name == "refine")
    assert isinstance(kind, click.Choice)
    assert tuple(kind.choices) == PUT_RIGHT


def test_the_defaults_are_the_papers() -> None:
    params = EstimatorParams()
    assert params.clusters == 8
    assert params.max_ray_distance == 0.0254
    assert params.max_range == 3.0


def test_an_unknown_method_is_refused_with_the_known_ones() -> None:
    with pytest.raises(TooltipError, match="unknown method 'magic'; known: kmeans, map, voting"):
        estimate(input_of(observe(10)), "magic")


@both
def test_exact_views_give_the_exact_tip(method: str) -> None:
    found = estimate(input_of(observe(40)), method)
    assert found.status == "ok"
    assert found.reasons == ()
    assert found.method == method
    assert found.frames_used == 40
    assert error_mm(found) < 0.01
    assert found.candidates[0].position is found.position


@both
@pytest.mark.parametrize("seed", range(3))
def test_noisy_views_with_clutter(method: str, seed: int) -> None:
    observations = observe(150, noise_px=2.0, outliers=0.4, seed=seed)
    found = estimate(input_of(observations), method)
    assert error_mm(found) < {"kmeans": 8.0, "map": 2.0}[method]
    assert found.covariance is not None
    values = np.linalg.eigvalsh(found.covariance)
    assert values[0] > 0
    assert np.sqrt(values[-1]) < 0.01
    supports = [candidate.support for candidate in found.candidates]
    assert all(0 <= support <= 1 for support in supports)
    assert supports[0] == max(supports)


@pytest.mark.parametrize("seed", range(3))
def test_the_kmeans_covariance_is_of_the_size_of_its_error(seed: int) -> None:
    errors, claims = [], []
    for trial in range(8):
        found = estimate(input_of(observe(60, noise_px=2.0, seed=100 * seed + trial)), "kmeans")
        assert found.covariance is not None
        errors.append(error_mm(found) ** 2)
        claims.append(1e6 * float(np.trace(found.covariance)))
    assert 0.2 < np.mean(errors) / np.mean(claims) < 5.0


@both
def test_equal_input_gives_equal_output(method: str) -> None:
    observations = observe(80, noise_px=2.0, outliers=0.3, seed=1)
    first, second = (estimate(input_of(observations), method) for _ in range(2))
    assert first.position is not None
    assert second.position is not None
    assert first.position.tobytes() == second.position.tobytes()
    assert first.covariance is not None
    assert second.covariance is not None
    assert first.covariance.tobytes() == second.covariance.tobytes()


@both
def test_the_order_of_views_does_not_matter(method: str) -> None:
    data = input_of(observe(80, noise_px=2.0, outliers=0.3, seed=2))
    order = np.random.default_rng(0).permutation(80)
    shuffled = replace(
        data,
        rays=data.rays.select(order),
        directions_camera=data.directions_camera[order],
        camera_from_hand=data.camera_from_hand[order],
    )
    first, second = estimate(data, method), estimate(shuffled, method)
    assert first.position is not None
    assert second.position is not None
    assert np.abs(first.position - second.position).max() < 1e-9
    assert first.covariance is not None
    assert second.covariance is not None
    assert np.allclose(first.covariance, second.covariance, rtol=1e-5, atol=1e-12)
    if method == "kmeans":  # its points are sorted before anything is added up
        assert first.position.tobytes() == second.position.tobytes()


@both
@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_views(method: str, count: int) -> None:
    found = estimate(input_of(observe(count)), method)
    assert code_of(found) == "too_few_views"
    assert f"only {count} views" in found.reasons[0].text
    assert found.frames_used == count


@both
def test_three_views_are_enough(method: str) -> None:
    assert error_mm(estimate(input_of(observe(3)), method)) < 0.1


@both
def test_a_hand_that_hardly_turns_cannot_show_the_depth(method: str) -> None:
    found = estimate(input_of(observe(100, noise_px=0.5, spread=np.radians(0.8))), method)
    assert code_of(found) == "depth_unobservable"
    assert "degrees" in found.reasons[0].text


@both
def test_a_hand_that_turns_a_little_with_noise_cannot_show_the_depth(method: str) -> None:
    found = estimate(
        input_of(observe(30, noise_px=6.0, spread=np.radians(2.5), seed=3)),
        method,
        max_deviation=0.005,
    )
    assert code_of(found) == "depth_unobservable"


def around_the_line_of_sight(count: int) -> Observations:
    """Turn the hand about the ray to the tip, in the image plane alone (paper, 4.4)."""
    base = poses_of(np.zeros((1, 3)))[0]
    tip_camera = base[:3, :3] @ TIP + base[:3, 3]
    axis = tip_camera / np.linalg.norm(tip_camera)
    poses = np.tile(base, (count, 1, 1))
    for row, angle in enumerate(np.linspace(-1, 1, count)):
        x, y, z = axis
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        poses[row, :3, :3] = turn @ base[:3, :3]
        poses[row, :3, 3] = tip_camera - poses[row, :3, :3] @ TIP
    exact = looking_at(TIP, np.zeros((count, 3)))
    return Observations(exact.normalized, poses, exact.focal_px, exact.image_area_px)


@both
def test_turning_in_the_image_plane_leaves_the_depth_open(method: str) -> None:
    found = estimate(input_of(around_the_line_of_sight(40)), method)
    assert code_of(found) == "depth_unobservable"


@both
@pytest.mark.parametrize("seed", range(3))
def test_views_of_nothing_in_particular_are_refused(method: str, seed: int) -> None:
    found = estimate(input_of(observe(300, outliers=1.0, seed=seed)), method)
    assert code_of(found) == "inconsistent_views"
    assert "of 300 views agree on any one point" in found.reasons[0].text


@both
def test_a_tip_inside_the_hand_is_not_believed(method: str) -> None:
    observations = observe(40, noise_px=0.5)
    x, y, z = map(float, TIP)
    found = estimate(input_of(observations, (((x, y, z), 0.05),)), method)
    assert found.position is None or np.linalg.norm(found.position - TIP) > 0.05


@both
def test_a_tip_out_of_reach_is_not_believed(method: str) -> None:
    found = estimate(input_of(observe(40)), method, max_range=0.1)
    assert found.position is None


def test_hypotheses_are_filtered_with_their_pairs() -> None:
    data = input_of(observe(30, noise_px=2.0, outliers=0.3), (((0.0, 0.0, 0.0), 0.1),))
    points, pairs = hypotheses(data, EstimatorParams(max_range=0.25))
    distances = np.linalg.norm(points, axis=1)
    assert len(points) == len(pairs) > 50
    assert ((distances > 0.1) & (distances <= 0.25)).all()
    rays = data.rays
    for point, (i, j) in zip(points[:20], pairs[:20], strict=True):
        for ray in (i, j):
            offset = point - rays.origins[ray]
            across = offset - (offset @ rays.directions[ray]) * rays.directions[ray]
            assert np.linalg.norm(across) <= 0.0127 + 1e-9


def test_z_start_reaches_the_hypotheses() -> None:
    data = input_of(observe(20))
    depth = np.linalg.norm(TIP - data.rays.origins, axis=1)
    near = hypotheses(data, EstimatorParams(z_start=float(np.median(depth))))
    assert 0 < len(near[0]) < 20 * 19 // 2


def test_the_nearest_point_minimises_the_distance_to_all_lines() -> None:
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(12, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    rays = Rays(np.arange(12), rng.normal(size=(12, 3)), directions)

    def cost(point: Array) -> float:
        offsets = point - rays.origins
        along = (offsets * directions).sum(axis=1, keepdims=True) * directions
        return float(np.square(offsets - along).sum())

    point = nearest_point(rays)
    for offset in np.concatenate([np.eye(3), -np.eye(3)]) * 1e-3:
        assert cost(point) < cost(point + offset)


def test_the_nearest_point_of_exact_rays_is_their_meeting() -> None:
    assert np.abs(nearest_point(input_of(observe(5)).rays) - TIP).max() < 1e-9


def test_the_seed_moves_kmeans_little() -> None:
    data = input_of(observe(80, noise_px=2.0, outliers=0.3, seed=4))
    errors = [error_mm(estimate(data, "kmeans", seed=seed)) for seed in range(4)]
    assert max(errors) < 10.0


def test_map_beats_kmeans_on_what_it_models() -> None:
    errors = {"kmeans": 0.0, "map": 0.0}
    for seed in range(8):
        data = input_of(observe(100, noise_px=2.0, outliers=0.3, seed=50 + seed))
        for method in errors:
            errors[method] += error_mm(estimate(data, method))
    assert errors["map"] < errors["kmeans"]


@both
@pytest.mark.parametrize("seed", range(3))
def test_of_very_many_views_a_sample_gives_the_same_within_its_uncertainty(
    method: str, seed: int
) -> None:
    data = input_of(observe(500, noise_px=3.0, outliers=0.3, seed=9))
    whole = estimate(data, method)
    part = estimate(data, method, seed=seed, max_pairs=20_000, max_points=8_000, max_views=150)
    assert whole.position is not None
    assert part.position is not None
    assert part.covariance is not None
    apart = part.position - whole.position
    assert apart @ np.linalg.solve(part.covariance, apart) < 9.0
    if method == "kmeans":
        assert part.position.tobytes() != whole.position.tobytes()
    else:  # all views decide in the end
        assert np.linalg.norm(apart) < 1e-6
