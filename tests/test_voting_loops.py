"""The voting loops without machine code: exactly the same, and said once."""

from __future__ import annotations

import logging

import numpy as np
import numpy.typing as npt
import pytest

from tests.helpers.scenes import FOCAL, poses_of
from tests.test_voting_estimate import SETTINGS, SPHERES, TIP, view
from tooltip_cli import machine_code
from tooltip_cli.method.voting.estimate import estimate_by_voting
from tooltip_cli.method.voting.hull import _carve
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
