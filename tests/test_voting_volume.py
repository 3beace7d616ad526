"""The volume's loops against longhand numpy, and points whose place is known."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from itertools import product

import numpy as np
import numpy.typing as npt
import pytest

from tests.helpers.scenes import FOCAL, poses_of
from tooltip_cli.method.types import Indices
from tooltip_cli.method.voting import volume
from tooltip_cli.method.voting.moving import MovingEdges
from tooltip_cli.method.voting.params import VotingParams
from tooltip_cli.method.voting.volume import (
    HandEdges,
    count_frames,
    frames_per_voxel,
    grid_axis,
    reconstruct,
)

Array = npt.NDArray[np.float64]

SMALL = VotingParams(depths=17, coarse=0.04, fine=0.02)
EXTENT = np.array([[-0.5, -0.4], [0.5, 0.4]])


def edges_of(
    poses: Array, frames: Indices, partners: Indices, points: Array, moved: Array, still: Array
) -> HandEdges:
    """Return edges with the same number in each frame, matched to the nearest 1/100 px."""
    per_frame = len(points) // len(frames)
    rng = np.random.default_rng(8)
    covariances = np.tile(np.array([0.3, 0.0, 0.3], dtype=np.float32), (len(points), 2, 1))
    covariances[..., 1] = rng.uniform(-0.1, 0.1, covariances.shape[:2])
    moving = MovingEdges(
        frames,
        partners,
        np.zeros((len(frames), 2, 2, 3)),
        np.full(len(frames), per_frame, dtype=np.int64),
        np.zeros((len(points), 2), np.uint16),
        np.zeros((len(points), 2, 2), np.int8),
        covariances,
    )
    return HandEdges(moving, points, moved, still, poses, FOCAL, EXTENT, 0.2)


@pytest.fixture(scope="module")
def small() -> HandEdges:
    """Return six frames of 40 edges that move by a few pixels, somehow."""
    rng = np.random.default_rng(7)
    poses = poses_of(rng.uniform(-0.3, 0.3, (15, 3)))
    frames = np.arange(2, 14, 2)
    partners = np.stack([frames - 1, frames + 1], axis=1)
    # a grid of places of their own, so that no two edges are equally near to a voxel
    places = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 10), np.linspace(-0.3, 0.3, 8)), axis=-1)
    chosen = np.concatenate([rng.permutation(80)[:40] for _ in frames])
    points = places.reshape(-1, 2)[chosen] + rng.uniform(-0.01, 0.01, (240, 2))
    moved = points[:, None] + rng.uniform(-6, 6, (240, 2, 2)) / FOCAL
    still = points[:, None] + rng.uniform(-1, 1, (240, 2, 2)) / FOCAL
    return edges_of(poses, frames, partners, points, moved, still)


def longhand_profile(edges: HandEdges, e: int, depths: Array) -> Array:
    """Return (D,) how much better an edge's motion fits the hand at each depth than the still."""
    row = edges.moving.frame_of_edge[e]
    camera = edges.camera_from_hand
    total = np.zeros(len(depths))
    for k in range(2):
        uu, uv, vv = edges.moving.covariances[e, k].astype(float)
        extra = SMALL.prediction_variance
        inverse = np.linalg.inv(np.array([[uu + extra, uv], [uv, vv + extra]]))
        partner = camera[edges.moving.partners[row, k]]
        partner_from_camera = partner @ np.linalg.inv(camera[edges.moving.frames[row]])
        step = FOCAL * (edges.moved[e, k] - edges.background[e, k])
        still = min(step @ inverse @ step, 2 * SMALL.clip)
        for i, z in enumerate(depths):
            there = partner_from_camera @ np.array([*(z * edges.points[e]), z, 1.0])
            error = FOCAL * (edges.moved[e, k] - there[:2] / there[2])
            total[i] += (still - min(error @ inverse @ error, 2 * SMALL.clip)) / 2
    return total


def samples(depths: Array) -> Array:
    return np.asarray(depths[0] + depths[1] * np.arange(SMALL.depths))


def profiles_of(edges: HandEdges) -> tuple[Array, npt.NDArray[np.float32]]:
    depths = volume._depth_ranges(edges, SMALL)
    rows = edges.moving.frame_of_edge
    kept, profiles = volume._depth_profiles(edges, rows, depths, SMALL, -np.inf)
    assert kept.all()
    return depths, profiles


def test_depths_cover_the_reach(small: HandEdges) -> None:
    for ranges, frame in zip(volume._depth_ranges(small, SMALL), small.moving.frames, strict=True):
        centre = small.camera_from_hand[frame, 2, 3]
        reached = samples(ranges)[[0, -1]]
        np.testing.assert_allclose(reached, [centre - small.reach, centre + small.reach])
    near = replace(small, reach=1.0)
    np.testing.assert_allclose(volume._depth_ranges(near, SMALL)[:, 0], 0.05)


def test_depth_profiles_are_the_likelihood_ratios(small: HandEdges) -> None:
    depths, profiles = profiles_of(small)
    rows = small.moving.frame_of_edge
    some = range(0, len(rows), 7)
    expected = [longhand_profile(small, e, samples(depths[rows[e]])) for e in some]
    np.testing.assert_allclose(profiles[some], expected, atol=2e-4)
    assert profiles.max() > 2  # and is not everywhere the same
    assert profiles.min() < -2


def test_only_edges_that_may_be_fixed_to_the_hand_are_held(
    small: HandEdges, monkeypatch: pytest.MonkeyPatch
) -> None:
    depths, profiles = profiles_of(small)
    likely = profiles.max(axis=1) > volume._KEEP_RATIO
    assert 0 < likely.sum() < len(likely)
    monkeypatch.setattr(volume, "_EDGES_AT_ONCE", 10)
    kept, held = volume._depth_profiles(small, small.moving.frame_of_edge, depths, SMALL)
    np.testing.assert_array_equal(kept, likely)
    np.testing.assert_array_equal(held, profiles[likely])


def longhand_vote(
    edges: HandEdges, rows: Indices, depths: Array, profiles: npt.NDArray[np.floating], x: Array
) -> tuple[float, float]:
    """Return how many frames show something at a place (3,), and how many should."""
    cell = FOCAL / volume._CELL_PX
    low, high = cell * edges.extent
    size = np.ceil(high - low) + 1
    seen = due = 0.0
    for row in np.unique(rows):
        frame, partner = edges.moving.frames[row], edges.moving.partners[row, 1]
        here, there = (edges.camera_from_hand[i] @ [*x, 1.0] for i in (frame, partner))
        pixel, other = (FOCAL * point[:2] / point[2] for point in (here, there))
        at = np.floor(pixel / volume._CELL_PX - low + 0.5)
        if (at < 0).any() or (at >= size).any():
            continue
        if np.linalg.norm(other - pixel) < volume._LEAST_MOTION_PX:
            continue
        due += 1
        mine = np.flatnonzero(rows == row)
        away = np.abs(np.round(cell * edges.points[mine] - low) - at)
        close = np.flatnonzero(away.max(axis=1) <= volume._SMEAR)
        if not len(close):
            continue
        nearest = mine[close[np.argmin(np.square(away[close]).sum(axis=1))]]
        sample = int(np.floor((here[2] - depths[row, 0]) / depths[row, 1] + 0.5))
        if 0 <= sample < SMALL.depths:
            seen += float(np.clip(profiles[nearest, sample] / volume._FULL_RATIO, 0, 1))
    return seen, due


def test_votes_are_the_frames_that_show_each_voxel(small: HandEdges) -> None:
    depths, profiles = profiles_of(small)
    profiles = profiles + np.float32(2.0)  # so that most voxels with an edge get a vote
    rows = small.moving.frame_of_edge
    hits, expected = volume._vote(small, small.points, rows, profiles, depths, SMALL)
    axis = grid_axis(small.reach, SMALL.coarse)
    assert hits.shape == expected.shape == (len(axis),) * 3
    for index in product(range(0, len(axis), 2), repeat=3):
        x = axis[list(index)]
        if np.linalg.norm(x) > small.reach:
            assert expected[index] == hits[index] == 0
            continue
        seen, due = longhand_vote(small, rows, depths, profiles, x)
        assert expected[index] == due
        assert hits[index] == pytest.approx(seen, abs=1e-4)
    assert 0 < np.count_nonzero(hits) < hits.size
    assert len(np.unique(expected)) > 2


def test_what_projects_just_outside_the_image_is_not_expected(small: HandEdges) -> None:
    depths, profiles = profiles_of(small)
    rows = small.moving.frame_of_edge
    cramped = replace(small, extent=np.array([[0.04, 0.04], [0.2, 0.2]]))
    _, expected = volume._vote(cramped, small.points, rows, profiles, depths, SMALL)
    axis = grid_axis(small.reach, SMALL.coarse)
    due = np.array(
        [
            longhand_vote(cramped, rows, depths, profiles, axis[list(index)])[1]
            if np.linalg.norm(axis[list(index)]) <= small.reach
            else 0
            for index in product(range(len(axis)), repeat=3)
        ]
    )
    np.testing.assert_array_equal(expected.ravel(), due)


def test_every_other_frame_votes_where_there_are_many(
    small: HandEdges, monkeypatch: pytest.MonkeyPatch
) -> None:
    depths, profiles = profiles_of(small)
    profiles = profiles + np.float32(2.0)
    rows = small.moving.frame_of_edge
    half = rows % 2 == 0
    axis = grid_axis(small.reach, SMALL.coarse)
    monkeypatch.setattr(volume, "_VOTING_FRAMES", 3)
    hits, expected = volume._vote(small, small.points, rows, profiles, depths, SMALL)
    chosen = replace(small, points=small.points[half])
    for index in product(range(len(axis)), repeat=3):
        seen, due = longhand_vote(chosen, rows[half], depths, profiles[half], axis[list(index)])
        if np.linalg.norm(axis[list(index)]) <= small.reach:
            assert expected[index] == 2 * due
            assert hits[index] == pytest.approx(2 * seen, abs=1e-4)
    assert hits.max() > 0


@pytest.mark.parametrize("every", [1, 2])
def test_every_cell_knows_its_nearest_edge(small: HandEdges, every: int) -> None:
    rng = np.random.default_rng(3)
    crowded = rng.uniform(-0.05, 0.05, (240, 2))
    rows = small.moving.frame_of_edge
    raster, nearest = volume._nearest_edges(small, crowded, rows, every)
    cells = np.round(raster[0] * crowded - raster[1:]).astype(int)
    assert len(nearest) == len(small.moving.frames) / every
    for row, v, u in np.argwhere(nearest >= 0)[::7] * (every, 1, 1):
        mine = np.abs(cells[rows == row] - (u, v))
        mine = np.square(mine[mine.max(axis=1) <= volume._SMEAR]).sum(axis=1)
        edge = nearest[row // every, v, u]
        assert rows[edge] == row
        assert np.square(cells[edge] - (u, v)).sum() == mine.min()
    for edge in np.flatnonzero(rows % every == 0):
        u, v = cells[edge]
        assert (nearest[rows[edge] // every, v - 1 : v + 2, u - 1 : u + 2] >= 0).all()


def test_a_fine_voxel_is_divided_by_what_is_expected_of_the_coarse_one_about_it() -> None:
    coarse, fine = grid_axis(0.2, SMALL.coarse), grid_axis(0.2, SMALL.fine)
    expected = np.random.default_rng(4).uniform(30.0, 90.0, (len(coarse),) * 3).astype(np.float32)
    middle = (2 * np.pi) ** -1.5  # of a Gaussian of one voxel
    for place in np.array([[0.08, -0.12, 0.04], [-0.08, 0.12, -0.04]]):
        shares = volume._recount(np.tile(place, (5, 1)), np.arange(5), expected, 0.2, SMALL)
        index, about = (
            tuple(np.round((place - axis[0]) / (axis[1] - axis[0])).astype(int))
            for axis in (fine, coarse)
        )
        assert shares[index] * expected[about] == pytest.approx(5 * middle, rel=0.02)


def trilinear(values: npt.NDArray[np.floating], at: Array) -> float | None:
    """Return the value at a place in voxels, None outside."""
    low = np.floor(at).astype(int)
    if (low < 0).any() or (low > len(values) - 2).any():
        return None
    total = 0.0
    for corner in product((0, 1), repeat=3):
        weights = np.where(np.array(corner) == 1, at - low, 1 - (at - low))
        total += float(np.prod(weights)) * float(values[tuple(low + corner)])
    return total


@pytest.mark.parametrize("substeps", [1, 3])
def test_every_edge_goes_where_volume_and_motion_agree(small: HandEdges, substeps: int) -> None:
    depths, profiles = profiles_of(small)
    profiles = profiles + np.float32(2.0)  # so that most edges have somewhere to go
    rows = small.moving.frame_of_edge
    axis = grid_axis(small.reach, SMALL.coarse)
    votes = np.random.default_rng(5).uniform(0, 1, (len(axis),) * 3).astype(np.float32)
    positions, scores = volume._place(
        small, small.points, rows, profiles, depths, votes, SMALL.coarse, SMALL, substeps
    )
    placed = 0
    fine = np.arange((SMALL.depths - 1) * substeps + 1) / substeps
    for e in range(0, len(rows), 5):
        row = rows[e]
        hand_from_camera = np.linalg.inv(small.camera_from_hand[small.moving.frames[row]])
        ratios = np.interp(fine, np.arange(SMALL.depths), profiles[e])
        best, found, score = -np.inf, np.zeros(3), 0.0
        for q, ratio in zip(fine, ratios, strict=True):
            z = depths[row, 0] + q * depths[row, 1]
            place = (hand_from_camera @ [*(z * small.points[e]), z, 1.0])[:3]
            value = trilinear(votes, (place - axis[0]) / SMALL.coarse)
            if ratio <= 0 or value is None:
                continue
            total = SMALL.volume_weight * np.log(max(value, 1e-3)) + ratio
            if total > best:
                best, found, score = total, place, value
        np.testing.assert_allclose(positions[e], found, atol=1e-9)
        assert scores[e] == pytest.approx(score, abs=1e-6)
        placed += score > 0
    assert placed > 20
    assert np.count_nonzero(scores) < len(rows)


def test_frames_are_counted_once_a_voxel() -> None:
    rng = np.random.default_rng(2)
    positions = rng.uniform(-0.03, 0.05, (600, 3))
    frames = rng.integers(0, 9, 600)
    corner, step, shape = np.array([-0.02, -0.03, -0.01]), 0.01, (5, 6, 4)
    seen = defaultdict(set)
    for place, frame in zip(positions, frames, strict=True):
        seen[tuple(np.round((place - corner) / step).astype(int))].add(int(frame))
    counts = count_frames(positions, frames, corner, step, shape)
    assert counts.shape == shape
    for index in product(*map(range, shape)):
        assert counts[index] == len(seen.get(index, ()))
    assert counts.max() > 2
    assert count_frames(positions[:0], frames[:0], corner, step, shape).sum() == 0
    axis = grid_axis(0.03, 0.01)
    np.testing.assert_array_equal(
        frames_per_voxel(positions, frames, axis),
        count_frames(positions, frames, np.full(3, axis[0]), 0.01, (7, 7, 7)),
    )


def test_the_grid_is_centred_on_the_hand_and_covers_the_reach() -> None:
    axis = grid_axis(0.35, 0.008)
    assert axis[len(axis) // 2] == 0
    assert axis[-1] >= 0.35 > axis[-1] - 0.008
    np.testing.assert_allclose(np.diff(axis), 0.008)


def seen_points(
    points: Array, frames: int, wrong: float = 0.0, still: float = 0.0
) -> tuple[HandEdges, npt.NDArray[np.bool_]]:
    """Return all points seen in all frames, and (E,) which of them are right.

    A share moves anywhere instead, a share not at all.
    """
    rng = np.random.default_rng(1)
    phase = np.arange(2 * frames + 1) / 8
    angles = np.stack([0.6 * np.sin(phase), 0.6 * np.sin(0.7 * phase + 1), 0 * phase], axis=1)
    poses = poses_of(angles)
    rows = np.arange(1, 2 * frames, 2)
    partners = np.stack([rows - 1, rows + 1], axis=1)
    inside = np.einsum("nij,pj->npi", poses[:, :3, :3], points) + poses[:, None, :3, 3]
    seen = inside[..., :2] / inside[..., 2:]
    moved = np.moveaxis(seen[partners], 1, 2).reshape(-1, 2, 2)
    here = seen[rows].reshape(-1, 2)
    draw = rng.uniform(size=len(here))
    bad, stuck = draw < wrong, draw > 1 - still
    moved = np.where(
        bad[:, None, None], here[:, None] + rng.uniform(-5, 5, moved.shape) / FOCAL, moved
    )
    moved = np.where(stuck[:, None, None], here[:, None], moved)
    background = np.repeat(here[:, None], 2, axis=1)
    return edges_of(poses, rows, partners, here, moved, background), ~(bad | stuck)


@pytest.mark.parametrize(("wrong", "still"), [(0.0, 0.0), (0.2, 0.2)])
def test_points_are_put_where_they_are(wrong: float, still: float) -> None:
    rng = np.random.default_rng(4)
    points = np.array([0.03, -0.04, 0.09]) + rng.uniform(-0.03, 0.03, (25, 3))
    edges, right = seen_points(points, 45, wrong, still)
    cloud = reconstruct(edges, VotingParams())
    assert cloud.frame_count == 45
    assert cloud.score > (0.95 if wrong == 0 else 0.6)
    assert cloud.consistent == len(cloud.points) / len(edges.points)
    assert len(cloud.points) == len(cloud.frames)
    assert len(cloud.points) > 0.9 * right.sum()
    away = np.linalg.norm(cloud.points[:, None] - points, axis=2)
    gaps = away.min(axis=1)
    assert np.median(gaps) < 0.002
    assert (gaps < VotingParams().fine).mean() > 0.9
    # each frame has each point, not one of them many times
    close = gaps < 2 * VotingParams().fine
    pairs = np.unique(np.stack([away.argmin(axis=1), cloud.frames])[:, close], axis=1)
    assert pairs.shape[1] > 0.85 * right.sum()


def test_edges_of_nothing_give_an_empty_cloud() -> None:
    edges, _ = seen_points(np.zeros((0, 3)), 5)
    cloud = reconstruct(edges, SMALL)
    assert cloud.points.shape == (0, 3)
    assert cloud.frame_count == 5
    assert cloud.score == 0


def test_edges_of_the_background_are_nowhere() -> None:
    rng = np.random.default_rng(4)
    points = rng.uniform(-0.1, 0.1, (25, 3))
    edges, _ = seen_points(points, 30, still=1.0)
    cloud = reconstruct(edges, SMALL)
    assert len(cloud.points) < 0.05 * len(edges.points)
