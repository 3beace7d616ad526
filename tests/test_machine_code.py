"""Kernels kept on disk: compiled once, loaded without numba, never trusted when damaged."""

from __future__ import annotations

import ctypes
import logging
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from tooltip_cli import machine_code
from tooltip_cli.method.affine import fit_background
from tooltip_cli.method.blocks import match_blocks
from tooltip_cli.method.canny import edge_points

pytest.importorskip("numba")

ROOT = Path(__file__).parents[1]

EVERY_KERNEL = """
import sys
import numpy as np
from tooltip_cli.method.affine import fit_background
from tooltip_cli.method.blocks import match_blocks
from tooltip_cli.method.canny import edge_points

rng = np.random.default_rng(0)
first, second = rng.integers(0, 256, (2, 60, 80), np.uint8)
points = edge_points(first, 300, 700, 7)
matches = match_blocks(first, second, points)
fit = fit_background(points, matches.translations, matches.covariances)
again = fit_background(points.astype(float), matches.translations, matches.covariances)
print(len(points), matches.sad.sum(), *fit.inliers.nonzero()[0], *again.inliers.nonzero()[0])
print("numba" in sys.modules, file=sys.stderr)
"""


def run(folder: Path | str) -> tuple[str, bool]:
    """Run every kernel in a fresh process; returns what came out and whether numba was needed."""
    done = subprocess.run(
        [sys.executable, "-c", EVERY_KERNEL],
        env={**os.environ, "NUMBA_CACHE_DIR": str(folder)},
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout, done.stderr.split()[-1] == "True"


def test_later_processes_need_no_numba_and_mend_what_is_damaged(tmp_path: Path) -> None:
    first, compiled = run(tmp_path)
    assert compiled
    assert run(tmp_path) == (first, False)
    kept = sorted(tmp_path.glob("*.o"))
    assert len(kept) == 4
    (points,) = (file for file in kept if "edge_finder" in file.name)
    whole = points.read_bytes()
    for damaged in (whole[:-100], whole[:-1] + bytes([whole[-1] ^ 1]), b""):
        points.write_bytes(damaged)
        assert run(tmp_path) == (first, True)
    assert run(tmp_path) == (first, False)
    assert sorted(tmp_path.iterdir()) == kept  # no temporary file is left


def test_kernels_run_without_a_cache_folder() -> None:
    kept, needed_numba = run("/proc/no/such/folder")
    assert kept
    assert needed_numba


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A module with kernels of its own, and an empty cache."""
    name = f"kernels_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(
        "import numpy as np\n"
        "def doubler(factor):\n"
        "    def double(values, count):\n"
        "        for i in range(count):\n"
        "            values[i] *= factor\n"
        "        return count\n"
        "    return double\n"
        "def allocator():\n"
        "    def allocate(count):\n"
        "        return np.ones(count, np.int64).sum()\n"
        "    return allocate\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    machine_code._kernel.cache_clear()
    yield name
    machine_code._kernel.cache_clear()


def test_arrays_of_another_kind_are_refused(module: str) -> None:
    double = machine_code.kernel(module, "doubler", "f64* i64", 3)
    values = np.arange(4.0)
    assert double(values, 4) == 4
    np.testing.assert_array_equal(values, [0, 3, 6, 9])
    for wrong in (values.astype(np.float32), values[::2], np.arange(4)):
        with pytest.raises(ctypes.ArgumentError):
            double(wrong, 2)


def test_arrays_that_are_kept_or_only_read_are_taken(module: str) -> None:
    double = machine_code.kernel(module, "doubler", "f64* i64", 3)
    kept = machine_code.Kept(np.arange(4.0))
    assert double(kept, 4) == 4
    np.testing.assert_array_equal(kept.array, [0, 3, 6, 9])
    kept.array.flags.writeable = False
    assert double(kept.array, 0) == 0


def test_every_thread_has_its_own_scratch_space() -> None:
    scratch = machine_code.Scratch()

    def address(key: str) -> int | None:
        (space,) = scratch(key, lambda: (np.empty(100),))
        return space.address.value

    assert address("a") == address("a")
    assert address("a") != address("b")
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(address, "a").result() != address("a")


def test_constants_are_part_of_the_key(module: str) -> None:
    for factor in (2, 5):
        values = np.ones(3)
        machine_code.kernel(module, "doubler", "f64* i64", factor)(values, 3)
        np.testing.assert_array_equal(values, factor)


def test_code_that_needs_numba_runs_and_is_not_kept(module: str, tmp_path: Path) -> None:
    """What allocates calls numba's runtime, which a process without numba does not have."""
    assert machine_code.kernel(module, "allocator", "i64")(7) == 7
    assert not (tmp_path / "cache").exists()


@pytest.mark.parametrize(
    ("without", "said"), [("import", "numba"), ("compiler", "NUMBA_DISABLE_JIT")]
)
def test_slow_numpy_is_announced_once(
    without: str,
    said: str,
    module: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    if without == "import":
        monkeypatch.setitem(sys.modules, "numba", None)
        for kernels in ("_blocks_numba", "_affine_numba", "_canny_numba"):
            monkeypatch.delitem(sys.modules, f"tooltip_cli.method.{kernels}", raising=False)
    else:
        monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    machine_code._say_slow.cache_clear()
    rng = np.random.default_rng(0)
    first, second = rng.integers(0, 256, (2, 40, 40), np.uint8)
    with caplog.at_level(logging.WARNING):
        points = edge_points(first, 300, 700, 7)
        for _ in range(2):
            found = match_blocks(first, second, points)
        fit_background(points, found.translations, found.covariances)
    expected = match_blocks(first, second, points, use_numba=False)
    np.testing.assert_array_equal(found.sad, expected.sad)
    warnings = [record for record in caplog.records if record.name == machine_code.__name__]
    assert len(warnings) == 1
    assert said in warnings[0].getMessage()
    with pytest.raises(ImportError, match=said):
        match_blocks(first, second, points, use_numba=True)
