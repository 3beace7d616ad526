"""The voting loops without machine code: exactly the same, and said once."""

from __future__ import annotations

import logging

import numpy as np
import numpy.typing as npt
import pytest

from tests.helpers.scenes import FOCAL, poses_of
from tests.test_voting_estimate import SETTINGS, SPHERES, TIP, view
from tooltip_cli import machine_code
from tooltip_cli.method.voting import equations, loops, sight, volume
from tooltip_cli.method.voting.estimate import estimate_by_voting
from tooltip_cli.method.voting.hull import _carve
from tooltip_cli.method.voting.params import RefineParams
from tooltip_cli.method.voting.sight import Measured, NearEdges, measure, see
from tooltip_cli.method.voting.silhouette import BACKGROUND, FOREGROUND, UNKNOWN

pytest.importorskip("numba")


@pytest.fixture
def no_compiler(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """A patch that is undone with the test; its `context` is a platform without numba."""

    def missing(*arguments: object) -> None:
        raise ImportError("numba cannot be imported (there is none for this platform)")

    machine_code._say_slow.cache_clear()
    monkeypatch.setattr(machine_code, "kernel", missing)
    return monkeypatch


def test_an_estimate_without_a_compiler_is_the_same_and_says_so_once(
    no_compiler: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        plain = estimate_by_voting(view(TIP), SPHERES, SETTINGS)
    said = [record for record in caplog.records if record.name == machine_code.__name__]
    assert len(said) == 1
    assert "estimation" in said[0].getMessage()
    no_compiler.undo()
    compiled = estimate_by_voting(view(TIP), SPHERES, SETTINGS)
    assert plain.position is not None
    np.testing.assert_array_equal(plain.position, compiled.position)
    np.testing.assert_array_equal(plain.covariance, compiled.covariance)
    assert plain.candidates[0].support == compiled.candidates[0].support


def carved(
    seed: int,
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    rng = np.random.default_rng(seed)
    poses = poses_of(rng.uniform(-1.0, 1.0, (12, 3)))[:, :3]
    to_pixels = np.array([[FOCAL / 8, 0, 40], [0, FOCAL / 8, 30], [0, 0, 1.0]])
    masks = rng.choice([UNKNOWN, BACKGROUND, FOREGROUND], (12, 60, 80)).astype(np.uint8)
    voxels = rng.uniform(-1.5, 1.5, (4000, 3))  # some behind the cameras, or beside the masks
    order = rng.permutation(12)
    return _carve(voxels, np.ascontiguousarray(to_pixels @ poses), masks, order, 4)


def test_carving_without_a_compiler_is_the_same(no_compiler: pytest.MonkeyPatch) -> None:
    plain = carved(1)
    no_compiler.undo()
    inside, outside = carved(1)
    np.testing.assert_array_equal(plain[0], inside)
    np.testing.assert_array_equal(plain[1], outside)
    assert inside.max() > 2
    assert outside.max() == 5  # one more than the limit, and then no more are looked at
    assert (inside + outside == 0).any()


SLABS = np.array([(-0.01, 0.003), (-0.018, -0.01), (-0.026, -0.018)])


def end_seen(seed: int) -> Measured:
    """Measure an end about which edges lie at random: many, few or none in a frame, some alike."""
    rng = np.random.default_rng(seed)
    poses = poses_of(rng.uniform(-1.0, 1.0, (30, 3)))
    counts = rng.choice([0, 1, 4, 5, 6, 40, 151, 300], 30)
    rows = np.repeat(np.arange(30), counts)
    at = (poses[:, :3, :3] @ TIP + poses[:, :3, 3])[rows]
    pixels = FOCAL * at[:, :2] / at[:, 2:] + rng.normal(0.0, 8.0, (len(rows), 2))
    pixels[::3] = np.round(pixels[::3])
    none = np.zeros((len(rows), 0), np.float32)
    zeros, ones = np.zeros(len(rows)), np.ones(len(rows))
    near = NearEdges(pixels, rows, none, zeros, ones, poses, FOCAL)
    axis = rng.normal(size=3)
    seen = see(near, TIP, axis / np.linalg.norm(axis))
    return measure(near, seen, SLABS, 0.03, 0.01, RefineParams())


@pytest.mark.parametrize("seed", range(8))
def test_an_end_is_measured_without_a_compiler_as_with_one(
    no_compiler: pytest.MonkeyPatch, seed: int
) -> None:
    plain = end_seen(seed)
    no_compiler.undo()
    compiled = end_seen(seed)
    for name in ("stops", "middles", "halves"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(compiled, name))
    assert np.isfinite(compiled.stops).any()
    assert np.isnan(compiled.stops).any()
    assert np.isfinite(compiled.middles).any(axis=0).all()
    assert np.nanmin(compiled.halves) >= 0


@pytest.mark.parametrize("weighted", [False, True])
def test_normal_equations_without_a_compiler_are_the_same(
    no_compiler: pytest.MonkeyPatch, weighted: bool
) -> None:
    rng = np.random.default_rng(0)
    poses = poses_of(rng.uniform(-1.0, 1.0, (30, 3)))
    none = NearEdges(
        np.zeros((0, 2)), np.zeros(0, np.intp), np.zeros((0, 0), np.float32),
        np.zeros(0), np.ones(0), poses, FOCAL,
    )  # fmt: skip
    axis = np.array([0.6, 0.0, 0.8])
    system = equations.equations(
        see(none, TIP, axis), end_seen(1), SLABS, axis, 0.008, RefineParams()
    )
    unknowns = rng.normal(0.0, 0.003, (system.prior.shape[1],))
    frames = rng.integers(0, 3, 30).astype(float) if weighted else None

    def summed() -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        return equations._normal_equations(system, unknowns, 0.002, RefineParams(), frames)

    plain = summed()
    no_compiler.undo()
    compiled = summed()
    for one, other in zip(plain, compiled, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(compiled[0], compiled[0].T)
    assert (np.diag(compiled[0]) > 0).all()


@pytest.mark.parametrize("seed", range(40))
def test_edges_are_placed_without_a_compiler_as_with_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, frames, samples, step = int(rng.choice([2, 8, 9, 17, 25, 41])), 3, 24, 0.02
    full = rng.choice([2e-4, 2e-3, 2e-2, 1.0])  # mostly whole blocks are empty, or few, or none
    scale = rng.choice([0.3, 0.003])  # scores about the least that says anything
    values = scale * rng.uniform(size=(n, n, n)) * (rng.uniform(size=(n, n, n)) < full)
    points = rng.uniform(-0.3, 0.3, (400, 2))
    rows = np.sort(rng.integers(0, frames, 400))
    profiles = rng.normal(0.5, 2.0, (400, samples)).astype(np.float32)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, :3] = np.linalg.qr(rng.normal(size=(frames, 3, 3)))[0]
    poses[:, :3, 3] = -0.6 * poses[:, :3, 2]
    first, stride = 0.6 - n * step, 2 * n * step / (samples - 1)
    depths = np.tile([first, stride, FOCAL], (frames, 1))
    weight, placed = float(rng.choice([1.0, 4.0])), []
    for place in (machine_code.kernel(loops._VOTING, "placer", volume._PLACER), loops._place):
        positions, scores = np.zeros((400, 3)), np.zeros(400)
        blocks = np.zeros((n // volume._BLOCK + 1,) * 3, np.uint8)
        place(
            points, rows, profiles, 400, samples, poses, depths, values.astype(np.float32), n,
            -(n // 2) * step, step, weight, 1 + seed % 3, blocks,
            positions, scores,
        )  # fmt: skip
        placed.append((positions, scores))
    (positions, scores), (plain, plain_scores) = placed
    np.testing.assert_array_equal(scores, plain_scores)
    np.testing.assert_array_equal(positions[scores > 0], plain[scores > 0])
    if full == 1.0 and n > 8 and scale == 0.3:
        assert (scores > 0).mean() > 0.5


def test_half_an_edge_is_left_out_to_even_with_and_without_a_compiler() -> None:
    counts = np.array([51, 151, 251, 5])  # 1.5, 4.5, 7.5 and 0.12 beyond a side
    rows, count = np.repeat(np.arange(4), counts), int(counts.sum())
    across = np.random.default_rng(0).permutation(count).astype(np.float64) * 1e-6
    limits = np.array([[-0.01, 0.01]])
    sides = []
    for measured in (
        machine_code.kernel(loops.ENDS, "measurer", sight._MEASURER),
        loops._measure,
    ):
        stops, (middles, halves) = np.full(4, np.nan), np.full((2, 4, 1), np.nan)
        measured(
            rows, np.zeros(count), across, np.zeros(count), count, np.ones(4), 4,
            limits, 1, 1.0, 0.5, 5, 0.03, np.empty(count), stops, middles, halves,
        )  # fmt: skip
        sides.append((middles - halves)[:, 0])
    np.testing.assert_array_equal(*sides)
    for row, skipped in enumerate((2, 4, 8, 0)):
        expected = np.sort(across[rows == row])[skipped]
        assert sides[0][row] == pytest.approx(expected, abs=1e-9)
