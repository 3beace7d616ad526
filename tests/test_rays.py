"""Rays in the hand frame and where they nearly meet, against solutions found another way."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tooltip_cli.method.rays import (
    angular_spread,
    closest_points,
    intersections,
    plausible,
    rays_in_hand,
    sphere_array,
)
from tooltip_cli.method.types import Rays

Array = npt.NDArray[np.float64]

numbers = st.floats(-3.0, 3.0)
points = st.tuples(numbers, numbers, numbers).map(np.array)
units = points.filter(lambda v: float(np.linalg.norm(v)) > 0.1).map(lambda v: v / np.linalg.norm(v))


def rays_of(origins: Array, directions: Array) -> Rays:
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return Rays(np.arange(len(origins)), origins, unit)


def towards(target: Array, count: int, noise: float = 0.0, seed: int = 0) -> Rays:
    """Return rays from all around that pass a target within some noise."""
    rng = np.random.default_rng(seed)
    origins = target + 0.5 * rng.normal(size=(count, 3)) / 2 + np.array([0.0, 0.0, -0.6])
    return rays_of(origins, target + noise * rng.normal(size=(count, 3)) - origins)


@settings(max_examples=200)
@given(o1=points, d1=units, o2=points, d2=units)
def test_closest_points_equal_a_least_squares_solution(
    o1: Array, d1: Array, o2: Array, d2: Array
) -> None:
    assume(abs(d1 @ d2) < 0.999)
    a1, a2 = closest_points(o1, d1, o2, d2)
    found, *_ = np.linalg.lstsq(np.stack([d1, -d2], axis=1), o2 - o1, rcond=None)
    assert np.allclose([a1, a2], found, atol=1e-8)


@settings(max_examples=200, deadline=None)
@given(o1=points, d1=units, o2=points, d2=units)
def test_the_midpoint_is_nearest_to_both_rays(o1: Array, d1: Array, o2: Array, d2: Array) -> None:
    """The point with the least sum of squared distances to two lines, by its normal equations."""
    assume(abs(d1 @ d2) < 0.99)
    a1, a2 = closest_points(o1, d1, o2, d2)
    assume(min(abs(a1), abs(a2)) > 1e-6)
    d1, d2 = d1 * np.sign(a1), d2 * np.sign(a2)  # both rays look towards their meeting point
    found, pairs = intersections(rays_of(np.stack([o1, o2]), np.stack([d1, d2])), max_distance=1e9)
    across = [np.eye(3) - np.outer(d, d) for d in (d1, d2)]
    nearest = np.linalg.solve(across[0] + across[1], across[0] @ o1 + across[1] @ o2)
    assert pairs.tolist() == [[0, 1]]
    assert np.allclose(found[0], nearest, atol=1e-6)


def test_as_printed_the_second_parameter_comes_out_negated() -> None:
    """Paper, 3.2: [g1-s1, g2-s2] alpha = s2-s1; the second column lacks its minus sign."""
    s1, s2, meeting = np.array([0.0, 0, 0]), np.array([1.0, 0, 0]), np.array([0.5, 0.2, 2.0])
    g1, g2 = meeting, s2 + (meeting - s2) / 2  # alpha is 1 on the first ray and 2 on the second
    printed, *_ = np.linalg.lstsq(np.stack([g1 - s1, g2 - s2], axis=1), s2 - s1, rcond=None)
    assert np.allclose(printed, [1.0, -2.0])
    lengths = np.linalg.norm([g1 - s1, g2 - s2], axis=1)
    ours = closest_points(s1, (g1 - s1) / lengths[0], s2, (g2 - s2) / lengths[1])
    assert np.allclose(ours / lengths, [1.0, 2.0])
    # a tip in front of both cameras would be thrown out by "alpha must be positive"
    assert printed[1] < 0 < ours[1]


def test_parallel_rays_meet_nowhere() -> None:
    forward = np.array([[0.0, 0.0, 1.0]])
    for second in (forward, -forward):
        rays = rays_of(np.array([[0.0, 0, 0], [0.001, 0, 0]]), np.concatenate([forward, second]))
        found, pairs = intersections(rays, max_distance=1.0)
        assert found.shape == (0, 3)
        assert pairs.shape == (0, 2)
        assert np.isnan(
            closest_points(rays.origins[0], forward[0], rays.origins[1], second[0])
        ).all()


def test_nearly_parallel_rays_make_finite_points_or_none() -> None:
    for angle in (1e-9, 1e-7, 1e-6, 1e-4):
        rays = rays_of(
            np.array([[0.0, 0, 0], [1e-3, 0, 0]]), np.array([[0.0, 0, 1], [np.sin(-angle), 0, 1]])
        )
        found, _ = intersections(rays, max_distance=0.0254)
        assert np.isfinite(found).all()


def test_rays_end_at_their_cameras() -> None:
    origins = np.array([[-1.0, 0, 0], [1.0, 0, 0]])
    ahead = rays_of(origins, np.array([[1.0, 0, 1], [-1.0, 0, 1]]))
    found, _ = intersections(ahead, max_distance=0.01)
    assert np.allclose(found, [[0, 0, 1]])
    for flipped in (
        [[-1.0, 0, -1], [-1, 0, 1]],
        [[1.0, 0, 1], [1, 0, -1]],
        [[-1.0, 0, -1], [1, 0, -1]],
    ):
        behind = rays_of(origins, np.array(flipped))
        assert len(intersections(behind, max_distance=0.01)[0]) == 0


def test_z_start_is_where_rays_begin() -> None:
    rays = rays_of(np.array([[-1.0, 0, 0], [1.0, 0, 0]]), np.array([[1.0, 0, 1], [-1.0, 0, 1]]))
    distance = np.sqrt(2.0)
    assert len(intersections(rays, max_distance=0.01, z_start=distance - 1e-6)[0]) == 1
    assert len(intersections(rays, max_distance=0.01, z_start=distance + 1e-6)[0]) == 0


@pytest.mark.parametrize(("gap", "count"), [(0.0253, 1), (0.0255, 0)])
def test_pairs_further_apart_than_the_limit_are_left_out(gap: float, count: int) -> None:
    rays = rays_of(np.array([[0.0, 0, 0], [0.5, gap, 0]]), np.array([[0.0, 0, 1], [-0.5, 0, 1]]))
    found, _ = intersections(rays, max_distance=0.0254)
    assert len(found) == count
    if count:
        assert np.allclose(found[0], [0, gap / 2, 1], atol=1e-9)


def test_all_pairs_of_rays_through_a_point_meet_there() -> None:
    target = np.array([0.1, -0.2, 0.05])
    rays = towards(target, 40)
    found, pairs = intersections(rays, max_distance=0.0254)
    assert len(found) == 40 * 39 // 2
    assert np.abs(found - target).max() < 1e-6
    assert sorted(map(tuple, pairs.tolist())) == [
        (i, j) for i in range(40) for j in range(i + 1, 40)
    ]


def test_blocks_of_pairs_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    rays = towards(np.zeros(3), 30, noise=0.02)
    whole = intersections(rays, max_distance=0.0254, use_numba=False)
    monkeypatch.setattr("tooltip_cli.method.rays._ROWS_AT_A_TIME", 7)
    parts = intersections(rays, max_distance=0.0254, use_numba=False)
    assert np.array_equal(whole[0], parts[0])
    assert np.array_equal(whole[1], parts[1])


@settings(max_examples=30, deadline=None)
@given(order=st.permutations(range(20)))
def test_the_order_of_rays_changes_nothing_not_even_a_bit(order: list[int]) -> None:
    rays = towards(np.zeros(3), 20, noise=0.02, seed=3)
    shuffled = rays.select(np.array(order))

    def rows(found: Array, pairs: npt.NDArray[np.int32], names: npt.NDArray[np.intp]) -> set[bytes]:
        keys = np.sort(names[pairs], axis=1)
        return {key.tobytes() + point.tobytes() for key, point in zip(keys, found, strict=True)}

    first = intersections(rays, max_distance=0.0254)
    second = intersections(shuffled, max_distance=0.0254)
    assert len(first[0]) > 50
    assert rows(*first, rays.frames) == rows(*second, shuffled.frames)


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_rays_meet_nowhere(count: int) -> None:
    found, pairs = intersections(towards(np.zeros(3), count), max_distance=1.0)
    assert found.shape == (0, 3)
    assert pairs.shape == (0, 2)


def test_points_beyond_reach_or_within_the_hand_are_not_plausible() -> None:
    spheres = sphere_array([((0.0, 0.0, 0.06), 0.06), ((0.0, 0.0, -0.1), 0.05)])
    candidates = np.array(
        [[0, 0, 0.06], [0, 0, 0.1199], [0, 0, 0.1201], [0, 0, -0.1], [3.0, 0, 0], [3.0001, 0, 0]]
    )
    assert plausible(candidates, spheres, 3.0).tolist() == [False, False, True, False, True, False]
    assert plausible(candidates, sphere_array([]), 3.0).tolist() == [True] * 5 + [False]
    assert plausible(np.zeros((0, 3)), spheres, 3.0).shape == (0,)


def test_rays_in_the_hand_are_moved_with_the_camera() -> None:
    hand_from_camera = np.eye(4)
    hand_from_camera[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    hand_from_camera[:3, 3] = [1, 2, 3]
    rays = rays_in_hand(np.array([7]), np.array([[1.0, 0.0, 0.0]]), hand_from_camera[None])
    assert rays.frames.tolist() == [7]
    assert rays.origins.tolist() == [[1, 2, 3]]
    assert rays.directions.tolist() == [[0, 1, 0]]


@settings(max_examples=50)
@given(angle=st.floats(0.001, 3.14), count=st.integers(2, 30))
def test_the_spread_is_the_largest_angle(angle: float, count: int) -> None:
    angles = np.linspace(0.0, angle, count)
    directions = np.stack([np.sin(angles), np.zeros(count), np.cos(angles)], axis=1)
    assert abs(angular_spread(directions) - angle) < 1e-7
    assert angular_spread(directions[:1]) == 0.0
    assert angular_spread(directions[:0]) == 0.0


def test_one_outlier_among_many_directions_spreads_them() -> None:
    directions = np.tile([0.0, 0.0, 1.0], (3000, 1))
    directions[2900] = [1.0, 0.0, 0.0]
    assert abs(angular_spread(directions) - np.pi / 2) < 1e-7


@pytest.mark.parametrize("width", [0.02, 0.5, 3.0])
def test_the_spread_of_very_many_directions_is_told_to_a_hundredth(width: float) -> None:
    rng = np.random.default_rng(0)
    directions = np.array([0.1, -0.2, 1.0]) + width * rng.uniform(-1, 1, (6000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    exact = float(np.arccos(np.clip((directions @ directions.T).min(), -1.0, 1.0)))
    assert 0.99 * exact <= angular_spread(directions) <= exact + 1e-7


@pytest.mark.parametrize("count", [0, 1, 2, 3, 150])
def test_both_forms_of_the_intersections_are_the_same(count: int) -> None:
    pytest.importorskip("numba")
    rays = towards(np.array([0.1, 0.0, 0.2]), count, noise=0.02)
    forms = [
        intersections(rays, max_distance=0.0254, z_start=0.05, use_numba=use_numba)
        for use_numba in (False, True)
    ]
    assert count < 150 or len(forms[0][0]) > 1000
    for plain, compiled in zip(*forms, strict=True):
        np.testing.assert_array_equal(compiled, plain)


def test_of_too_many_pairs_a_seeded_sample_is_looked_at() -> None:
    rays = towards(np.zeros(3), 60)
    whole, pairs = intersections(rays, max_distance=1.0)
    known = {tuple(pair): point for pair, point in zip(pairs.tolist(), whole, strict=True)}
    found, some = intersections(rays, max_distance=1.0, max_pairs=500, seed=3)
    assert 450 < len(found) <= 500
    for pair, point in zip(some.tolist(), found, strict=True):
        np.testing.assert_array_equal(point, known[tuple(pair)])
    assert set(some.ravel().tolist()) == set(range(60))
    again, _ = intersections(rays, max_distance=1.0, max_pairs=500, seed=3)
    other, _ = intersections(rays, max_distance=1.0, max_pairs=500, seed=4)
    np.testing.assert_array_equal(again, found)
    assert not np.array_equal(other, found)
    exactly_all, _ = intersections(rays, max_distance=1.0, max_pairs=60 * 59 // 2)
    np.testing.assert_array_equal(exactly_all, whole)
