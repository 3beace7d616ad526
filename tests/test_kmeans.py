"""K-means: the same clusters for the same points, in whatever order they come."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tooltip_cli.method.kmeans import Clusters, kmeans, lloyd, nearest

Array = npt.NDArray[np.float64]

CENTRES = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
SIZES = [400, 120, 60, 20]


def blobs(seed: int = 0, spread: float = 0.02) -> Array:
    rng = np.random.default_rng(seed)
    return np.concatenate(
        [
            centre + spread * rng.normal(size=(size, 3))
            for centre, size in zip(CENTRES, SIZES, strict=True)
        ]
    )


def same(first: Clusters, second: Clusters) -> bool:
    return first.means.tobytes() == second.means.tobytes() and np.array_equal(
        first.sizes, second.sizes
    )


def test_known_blobs_are_found_in_order_of_size() -> None:
    points = blobs()
    clusters = kmeans(points, 4, seed=0)
    assert clusters.sizes.tolist() == SIZES
    assert np.abs(clusters.means - CENTRES).max() < 0.02
    assert np.array_equal(clusters.labels, np.repeat(np.arange(4), SIZES))
    assert np.array_equal(clusters.largest, clusters.means[0])
    for number in range(4):
        members = points[clusters.labels == number]
        assert np.abs(clusters.means[number] - members.mean(axis=0)).max() < 1e-12


@pytest.mark.parametrize("seed", range(5))
def test_the_seed_decides_and_the_blobs_are_found_with_any(seed: int) -> None:
    points = blobs()
    first, second = kmeans(points, 4, seed), kmeans(points, 4, seed)
    assert same(first, second)
    assert np.array_equal(first.labels, second.labels)
    assert first.sizes.tolist() == SIZES


@settings(max_examples=25, deadline=None)
@given(data=st.data(), k=st.integers(1, 9))
def test_the_order_of_points_changes_nothing_not_even_a_bit(data: st.DataObject, k: int) -> None:
    points = data.draw(
        arrays(np.float64, st.tuples(st.integers(1, 40), st.just(3)), elements=st.floats(-5, 5))
    )
    order = np.array(data.draw(st.permutations(range(len(points)))))
    straight, shuffled = kmeans(points, k, seed=1), kmeans(points[order], k, seed=1)
    assert same(straight, shuffled)
    assert np.array_equal(straight.labels[order], shuffled.labels)


def test_the_order_changes_nothing_for_more_points_than_are_seeded_from() -> None:
    points = np.concatenate([blobs(seed) for seed in range(8)])
    order = np.random.default_rng(9).permutation(len(points))
    straight, shuffled = kmeans(points, 8, seed=0), kmeans(points[order], 8, seed=0)
    assert len(points) > 2048
    assert same(straight, shuffled)
    assert np.array_equal(straight.labels[order], shuffled.labels)


@settings(max_examples=40, deadline=None)
@given(
    points=arrays(np.float64, st.tuples(st.integers(1, 30), st.just(3)), elements=st.floats(-5, 5)),
    k=st.integers(1, 12),
)
def test_the_result_is_a_fixed_point(points: Array, k: int) -> None:
    clusters = kmeans(points, k, seed=0)
    assert clusters.sizes.sum() == len(points)
    assert (np.diff(clusters.sizes) <= 0).all()
    assert np.array_equal(
        np.bincount(clusters.labels, minlength=len(clusters.means)), clusters.sizes
    )
    distances = np.linalg.norm(points[:, None] - clusters.means[None], axis=2)
    chosen = distances[np.arange(len(points)), clusters.labels]
    assert (chosen <= distances.min(axis=1) + 1e-9).all()
    for number, size in enumerate(clusters.sizes):
        if size:
            mean = points[clusters.labels == number].mean(axis=0)
            assert np.abs(clusters.means[number] - mean).max() < 1e-9


def test_more_means_than_points() -> None:
    points = np.array([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]])
    clusters = kmeans(points, 8, seed=0)
    assert clusters.sizes.tolist() == [1, 1, 1]
    assert sorted(clusters.means[:, 0].tolist()) == [0, 1, 2]
    assert kmeans(points[:1], 8, seed=0).largest.tolist() == [0, 0, 0]


def test_duplicates_are_one_place() -> None:
    points = np.repeat([[1.0, 2, 3], [4.0, 5, 6]], [5, 2], axis=0)
    clusters = kmeans(points, 8, seed=0)
    assert clusters.sizes.tolist() == [5, 2]
    assert clusters.means.tolist() == [[1, 2, 3], [4, 5, 6]]
    alone = kmeans(np.ones((50, 3)), 8, seed=0)
    assert alone.sizes.tolist() == [50]


def test_zeros_of_either_sign_are_the_same_point() -> None:
    points = np.array([[0.0, 1, 0], [-0.0, 1, 0], [5.0, 0, 0]])
    assert same(kmeans(points, 3, seed=0), kmeans(points[[1, 0, 2]], 3, seed=0))


def test_clusters_of_equal_size_are_ordered_by_place() -> None:
    points = np.array([[5.0, 0, 0], [1.0, 0, 0], [3.0, 0, 0]])
    assert kmeans(points, 3, seed=0).means[:, 0].tolist() == [1, 3, 5]


def test_a_mean_that_loses_all_its_points_stays() -> None:
    points = np.array([[0.0, 0, 0], [0.1, 0, 0]])
    means, labels = lloyd(points, np.array([[0.0, 0, 0], [9.0, 9, 9]]))
    assert means[1].tolist() == [9, 9, 9]
    assert labels.tolist() == [0, 0]


def test_the_nearest_of_equals_is_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.linspace(-1, 1, 11)[:, None] * np.ones((1, 3))
    means = np.array([[1.0, 1, 1], [-1.0, -1, -1]])
    whole = nearest(points, means)
    assert whole.tolist() == [1] * 5 + [0] * 6
    monkeypatch.setattr("tooltip_cli.method.kmeans._BLOCK", 3)
    assert np.array_equal(nearest(points, means), whole)


@pytest.mark.parametrize("dimensions", [1, 3])
@pytest.mark.parametrize("count", [1, 7, 512, 1300])
def test_both_forms_are_the_same_to_the_bit(count: int, dimensions: int) -> None:
    pytest.importorskip("numba")
    rng = np.random.default_rng(count)
    points = np.round(rng.normal(size=(count, dimensions)), 1)  # with ties
    means = np.concatenate([points[rng.integers(count, size=5)], np.full((1, dimensions), 99.0)])
    plain, compiled = (lloyd(points, means, use_numba=use_numba) for use_numba in (False, True))
    assert plain[0].tobytes() == compiled[0].tobytes()
    np.testing.assert_array_equal(plain[1], compiled[1])
