"""The voting loops without machine code: exactly the same, and said once."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from tests.helpers.scenes import FOCAL, poses_of
from tests.test_voting_estimate import SETTINGS, SPHERES, TIP, view
from tooltip_cli import machine_code
from tooltip_cli.method.voting import equations, volume
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
    assert compiled.position is not None
    assert plain.covariance is not None
    assert compiled.covariance is not None
    # but for the order of the sums in the normal equations
    np.testing.assert_allclose(plain.position, compiled.position, rtol=0, atol=1e-9)
    np.testing.assert_allclose(plain.covariance, compiled.covariance, rtol=1e-6, atol=1e-12)
    assert plain.candidates[0].support == pytest.approx(compiled.candidates[0].support)


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
    counts = rng.choice([0, 1, 4, 5, 6, 40, 300], 30)
    rows = np.repeat(np.arange(30), counts)
    at = (poses[:, :3, :3] @ TIP + poses[:, :3, 3])[rows]
    pixels = FOCAL * at[:, :2] / at[:, 2:] + rng.normal(0.0, 8.0, (len(rows), 2))
    pixels[::3] = np.round(pixels[::3])
    none = np.zeros((len(rows), 0), np.float32)
    zeros, ones = np.zeros(len(rows)), np.ones(len(rows))
    near = NearEdges(pixels, rows, none, zeros, ones, poses, FOCAL)
    axis = rng.normal(size=3)
    sight = see(near, TIP, axis / np.linalg.norm(axis))
    return measure(near, sight, SLABS, 0.03, 0.01, RefineParams())


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
def test_normal_equations_without_a_compiler_are_nearly_the_same(weighted: bool) -> None:
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
    plain, compiled = (
        form(system, unknowns, 0.002, RefineParams(), frames)
        for form in (equations._plainly_added_up, equations._added_up)
    )
    for one, other in zip(plain, compiled, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(one).max())
    np.testing.assert_array_equal(compiled[0], compiled[0].T)
    assert (np.diag(compiled[0]) > 0).all()


@pytest.mark.parametrize("substeps", [1, 3])
def test_edges_are_placed_without_a_compiler_as_with_one(
    no_compiler: pytest.MonkeyPatch, substeps: int
) -> None:
    edges = view(TIP)
    params = replace(SETTINGS.voting, depths=17)
    depths = volume._depth_ranges(edges, params)
    kept, profiles = volume._depth_profiles(edges, edges.moving.frame_of_edge, depths, params)
    rows, points = edges.moving.frame_of_edge[kept], edges.points[kept]
    rng = np.random.default_rng(2)
    n = len(volume.grid_axis(edges.reach, params.coarse))
    values = rng.uniform(0.0, 0.3, (n, n, n)) * (rng.uniform(size=(n, n, n)) < 0.02)
    values[n // 2 + 8 :] = 0.0  # empty blocks

    def placed() -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        return volume._place(
            edges, points, rows, profiles, depths, values.astype(np.float32),
            params.coarse, params, substeps,
        )  # fmt: skip

    positions, scores = placed()
    no_compiler.undo()
    compiled, compiled_scores = placed()
    np.testing.assert_array_equal(scores, compiled_scores)
    somewhere = scores > 0
    assert 0.1 < somewhere.mean() < 0.99
    np.testing.assert_array_equal(positions[somewhere], compiled[somewhere])
