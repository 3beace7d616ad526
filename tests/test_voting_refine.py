"""An end put right by outlines that are drawn exactly: position, axis, uncertainty, refusal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from tests.helpers.scenes import FOCAL, poses_of
from tooltip_cli.method.voting.moving import MovingEdges
from tooltip_cli.method.voting.params import RefineParams
from tooltip_cli.method.voting.refine import RefinedEnd, refine_end
from tooltip_cli.method.voting.sight import across_axis
from tooltip_cli.method.voting.volume import Cloud, HandEdges

Array = npt.NDArray[np.float64]

PARAMS = RefineParams()
FRAMES = 80
TIP = np.array([0.03, -0.05, 0.13])
AXIS = np.array([0.6, -0.48, 0.64])
NOISE_PX = 0.2


def poses(seed: int, spread: float = 0.8) -> Array:
    rng = np.random.default_rng(seed)
    return poses_of(rng.uniform(-spread, spread, (FRAMES, 3)))


def outline(pose: Array, tip: Array, axis: Array, wide: float, high: float) -> Array:
    """Return (E, 3) points in the camera frame on the outline of a bar with an elliptic end."""
    basis = across_axis(axis)
    turns = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    rim = tip + (wide * np.cos(turns))[:, None] * basis[:, 0]
    rim = rim + (high * np.sin(turns))[:, None] * basis[:, 1]
    towards = pose[:3, :3].T @ (pose[:3, :3] @ tip + pose[:3, 3])
    side = np.cross(towards, axis)
    side /= np.linalg.norm(side)
    reach = np.hypot(wide * (basis[:, 0] @ side), high * (basis[:, 1] @ side))
    along = np.linspace(0, 0.045, 40)[:, None] * axis
    bar = np.concatenate([tip - along + reach * side, tip - along - reach * side])
    return np.asarray(np.concatenate([rim, bar]) @ pose[:3, :3].T + pose[:3, 3])


def seen(
    parts: list[tuple[Array, Array, float, float]],
    seed: int,
    missing: float = 0.0,
    views: Array | None = None,
) -> tuple[HandEdges, Cloud]:
    """Return what is seen of bars; in a share of the frames, one side of them is missing."""
    rng = np.random.default_rng(seed)
    views = poses(seed) if views is None else views
    edges, rows = [], []
    for row, pose in enumerate(views):
        points = np.concatenate([outline(pose, *part) for part in parts])
        pixels = points[:, :2] / points[:, 2:] + rng.normal(0, NOISE_PX / FOCAL, (len(points), 2))
        if rng.uniform() < missing:
            middle = pose[:3, :3] @ parts[0][0] + pose[:3, 3]
            pixels = pixels[pixels[:, 0] > middle[0] / middle[2]]
        edges.append(pixels)
        rows.append(np.full(len(pixels), row, dtype=np.intp))
    frames = np.arange(FRAMES, dtype=np.intp)
    nothing = MovingEdges(
        frames,
        np.stack([frames, frames], axis=1),
        np.zeros((FRAMES, 2, 2, 3)),
        np.zeros(FRAMES, dtype=np.int64),
        np.zeros((0, 2), np.uint16),
        np.zeros((0, 2, 2), np.int8),
        np.zeros((0, 2, 3), np.float32),
    )
    none = np.zeros((0, 2, 2))
    extent = np.array([[-1.0, -1.0], [1.0, 1.0]])
    hand = HandEdges(nothing, np.zeros((0, 2)), none, none, views, FOCAL, extent, 0.3)
    count = sum(len(part) for part in edges)
    cloud = Cloud(
        np.zeros((0, 3)),
        np.zeros(0, dtype=np.intp),
        FRAMES,
        np.zeros((3, 3, 3), dtype=np.float32),
        0.008,
        score=1.0,
        consistent=1.0,
        edges=np.concatenate(edges),
        edge_rows=np.concatenate(rows),
        profiles=np.ones((count, 4), dtype=np.float32),  # all fit at every depth
        depths=np.tile([0.1, 0.3, FOCAL], (FRAMES, 1)),
    )
    return hand, cloud


def off(seed: int, step: float, turn_deg: float) -> tuple[Array, Array]:
    """Return a start that is a step and a turn away from the truth."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=3)
    turn = rng.normal(size=2)
    turn *= np.tan(np.radians(turn_deg)) / np.linalg.norm(turn)
    axis = AXIS + across_axis(AXIS) @ turn
    return TIP + step * direction / np.linalg.norm(direction), axis / np.linalg.norm(axis)


def refined(
    parts: list[tuple[Array, Array, float, float]],
    seed: int,
    radius: float,
    step: float = 0.004,
    turn_deg: float = 15.0,
    missing: float = 0.0,
) -> RefinedEnd:
    hand, cloud = seen(parts, seed, missing)
    found = refine_end(hand, cloud, *off(seed, step, turn_deg), radius, PARAMS, 0)
    assert found is not None
    return found


def error_mm(found: RefinedEnd) -> float:
    return float(1000 * np.linalg.norm(found.position - TIP))


def axis_error_deg(found: RefinedEnd) -> float:
    return float(np.degrees(np.arccos(np.clip(found.axis @ AXIS, -1, 1))))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("wide", "high"), [(0.002, 0.002), (0.012, 0.012), (0.02, 0.005)])
def test_the_end_of_a_bar(wide: float, high: float, seed: int) -> None:
    found = refined([(TIP, AXIS, wide, high)], seed, radius=max(wide, 0.006))
    assert error_mm(found) < 0.8
    assert axis_error_deg(found) < 1.5
    assert found.agreement > 0.85


@pytest.mark.parametrize("seed", range(3))
def test_a_missing_side_moves_the_end_little(seed: int) -> None:
    found = refined([(TIP, AXIS, 0.012, 0.012)], seed, radius=0.012, missing=0.4)
    assert error_mm(found) < 1.5


@pytest.mark.parametrize("seed", range(3))
def test_the_longest_of_several_pins(seed: int) -> None:
    aside = across_axis(AXIS) @ (0.009, 0.006)
    body = (TIP - 0.02 * AXIS + aside / 2, AXIS, 0.013, 0.013)
    pins = [(TIP, AXIS, 0.002, 0.002), (TIP - 0.006 * AXIS + aside, AXIS, 0.002, 0.002), body]
    hand, cloud = seen(pins, seed)
    found = refine_end(hand, cloud, TIP + aside / 2, AXIS, 0.012, PARAMS, 0)
    assert found is not None
    assert error_mm(found) < 1.0


def test_another_axis_is_tried_where_the_first_leads_nowhere() -> None:
    hand, cloud = seen([(TIP, AXIS, 0.012, 0.012)], 5)
    found = refine_end(hand, cloud, *off(5, 0.003, 48.0), 0.012, PARAMS, 0)
    assert found is not None
    assert error_mm(found) < 0.8


def test_the_uncertainty_is_that_of_chance() -> None:
    errors, stated = [], []
    for seed in range(8):
        found = refined([(TIP, AXIS, 0.008, 0.008)], seed, radius=0.008)
        errors.append(found.position - TIP)
        stated.append(np.trace(found.position_covariance))
        np.testing.assert_allclose(found.position_covariance, found.position_covariance.T)
        assert np.linalg.eigvalsh(found.position_covariance).min() > 0
        assert found.axis_variance > 0
    spread = np.std(errors, axis=0)
    assert 0.3 < np.sqrt(np.mean(stated)) / np.linalg.norm(spread) < 3.0


def test_the_same_again_and_in_any_order_within_frames() -> None:
    hand, cloud = seen([(TIP, AXIS, 0.01, 0.01)], 1)
    start = off(1, 0.004, 10.0)
    first = refine_end(hand, cloud, *start, 0.01, PARAMS, 0)
    order = np.lexsort([np.random.default_rng(0).random(len(cloud.edges)), cloud.edge_rows])
    shuffled = replace(cloud, edges=cloud.edges[order], edge_rows=cloud.edge_rows[order])
    second = refine_end(hand, shuffled, *start, 0.01, PARAMS, 0)
    assert first is not None
    assert second is not None
    np.testing.assert_allclose(first.position, second.position, atol=1e-9)


def test_nothing_near_is_no_end() -> None:
    hand, cloud = seen([(TIP, AXIS, 0.01, 0.01)], 1)
    assert refine_end(hand, cloud, -TIP, AXIS, 0.01, PARAMS, 0) is None


def test_what_moves_too_far_is_not_taken() -> None:
    hand, cloud = seen([(TIP, AXIS, 0.006, 0.006)], 2)
    start = TIP - 0.022 * AXIS
    found = refine_end(hand, cloud, start, AXIS, 0.006, PARAMS, 0)
    assert found is None or np.linalg.norm(found.position - start) <= PARAMS.max_move


def test_edges_anywhere_are_no_end() -> None:
    hand, cloud = seen([(TIP, AXIS, 0.01, 0.01)], 3)
    rng = np.random.default_rng(3)
    noise = rng.uniform(-0.15, 0.15, cloud.edges.shape)
    anywhere = replace(cloud, edges=cloud.edges + noise)
    assert refine_end(hand, anywhere, TIP, AXIS, 0.01, PARAMS, 0) is None
