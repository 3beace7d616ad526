"""Frames chosen as they arrive are those that are chosen afterwards."""

from __future__ import annotations

import numpy as np
import pytest

from tests.test_voting_watching import FOCAL, sweep
from tooltip_cli.method.types import Array, Indices
from tooltip_cli.method.voting.online import CausalPairing, Decided, Spread
from tooltip_cli.method.voting.pairing import farthest_points, pair_frames
from tooltip_cli.method.voting.params import PairingParams

EVERY = PairingParams(frames=10_000)


def fed(poses: Array, params: PairingParams = EVERY) -> tuple[list[Decided], CausalPairing]:
    pairing = CausalPairing(FOCAL, params)
    decided = [item for pose in poses for item in pairing.add(pose)]
    return decided + pairing.finish(), pairing


@pytest.mark.parametrize("unknown", [0.0, 0.2])
@pytest.mark.parametrize("count", [1, 2, 9, 15, 16, 31, 32, 300])
@pytest.mark.parametrize("speed", [0.7, 3.0])
def test_partners_are_those_of_the_whole_recording(
    count: int, unknown: float, speed: float
) -> None:
    poses = sweep(300, speed, 0.8)[:count]
    poses[np.random.default_rng(3).random(count) < unknown] = np.nan
    decided, online = fed(poses)
    assert [item.frame for item in decided] == list(range(count))
    whole = pair_frames(poses, FOCAL, EVERY)
    paired = [item for item in decided if item.partners is not None]
    assert [item.frame for item in paired] == whole.frames.tolist()
    assert [item.partners for item in paired] == [tuple(pair) for pair in whole.partners.tolist()]
    np.testing.assert_array_equal(
        np.array([item.displacements for item in paired]).reshape(-1, 2), whole.displacements
    )
    assert [item.level for item in paired] == whole.levels.tolist()
    assert online.fastest_px == whole.fastest_px
    if count == 300:
        assert len(paired) > 100
        assert len(np.unique(whole.levels)) > (speed > 1)


def test_an_image_is_decided_as_soon_as_no_later_one_matters() -> None:
    pairing = CausalPairing(FOCAL, EVERY)
    for i, pose in enumerate(sweep(80, 0.7, 0.8)):
        decided = pairing.add(pose)
        assert [item.frame for item in decided] == ([i - 15] if i >= 15 else [])
        for item in decided:
            if item.partners is not None:
                assert min(item.partners) >= pairing.oldest
    assert len(pairing.finish()) == 15
    assert pairing.finish() == []


def spread_of(points: Array) -> float:
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    return float((distances + np.eye(len(points)) * 10).min())


def kept(points: Array, capacity: int) -> Array:
    spread, rows = Spread(capacity, points.shape[1]), np.full(capacity, -1)
    for row, point in enumerate(points):
        place = spread.place_for(point)
        if place is not None:
            rows[place] = row
            spread.put(place, point)
    return np.asarray(points[rows[rows >= 0]])


@pytest.mark.parametrize("order", ["random", "along"])
def test_what_is_kept_is_nearly_as_spread_as_what_hindsight_chooses(order: str) -> None:
    rng = np.random.default_rng(0)
    points = rng.random((2000, 2))
    if order == "along":  # as a slow hand does: neighbours come one after the other
        points = points[np.argsort(points[:, 0])]
    chosen = kept(points, 50)
    hindsight = points[farthest_points(points, np.ones(len(points), dtype=bool), 50)]
    assert len(chosen) == 50
    assert spread_of(chosen) > 0.6 * spread_of(hindsight)
    # and every point has one near it
    for some in (chosen, hindsight):
        far = np.linalg.norm(points[:, None] - some[None], axis=2).min(axis=1).max()
        assert far < 0.25


def test_everything_is_kept_while_there_is_room_and_nothing_twice_after() -> None:
    points = np.random.default_rng(1).random((30, 3))
    np.testing.assert_array_equal(kept(points, 30), points)
    spread = Spread(2, 1)
    for value in (0.0, 1.0):
        spread.put(int(value), np.array([value]))
    assert spread.full
    assert spread.place_for(np.array([0.0])) is None
    assert spread.place_for(np.array([0.5])) is None
    assert spread.place_for(np.array([3.0])) is not None


def test_equal_points_leave_room_for_others() -> None:
    assert spread_of(kept(np.array([[0.0], [0.0], [0.0], [2.0], [5.0]]), 3)) == 2.0


def ranked(points: Array, ranks: Indices, capacity: int) -> list[int]:
    spread, rows = Spread(capacity, points.shape[1]), np.full(capacity, -1)
    for row, (point, rank) in enumerate(zip(points, ranks, strict=True)):
        place = spread.place_for(point, int(rank))
        if place is not None:
            rows[place] = row
            spread.put(place, point, int(rank))
    return sorted(rows[rows >= 0].tolist())


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("low", [10, 20, 60])
def test_those_of_a_higher_rank_make_room_and_leave_no_trace(seed: int, low: int) -> None:
    rng = np.random.default_rng(seed)
    points, ranks = rng.random((100, 2)), (rng.permutation(100) >= low).astype(np.intp)
    chosen = ranked(points, 2 * ranks, 20)
    assert len(chosen) == 20
    lower = np.flatnonzero(ranks == 0)
    if low > 20:  # as if the others had never come
        alone = ranked(points[lower], np.zeros(low, dtype=np.intp), 20)
        assert chosen == lower[alone].tolist()
    else:
        assert np.isin(lower, chosen).all()


def test_those_of_one_rank_are_spread_among_those_of_a_lower() -> None:
    rng = np.random.default_rng(1)
    points = np.concatenate([[[0.0, 0.0], [1.0, 1.0]], rng.random((500, 2))])
    ranks = np.array([0, 0] + [1] * 500)
    chosen = ranked(points, ranks, 20)
    assert chosen[:2] == [0, 1]
    assert spread_of(points[chosen]) > 2 * spread_of(points[:20])
