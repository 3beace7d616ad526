"""The compiled kernels under pytest-benchmark, to compare one state of the code with another.

    pytest tests/benchmarks/test_kernels.py --benchmark-save=before
    pytest tests/benchmarks/test_kernels.py --benchmark-compare=before

All is synthetic, so that it runs anywhere; the suite does not collect it.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from tooltip_cli.method.affine import fit_background
from tooltip_cli.method.blocks import Form, _match_compiled, best_form, match_blocks
from tooltip_cli.method.canny import edge_points
from tooltip_cli.method.detector import DetectorParams, detect_tip, find_edges
from tooltip_cli.method.kmeans import kmeans
from tooltip_cli.method.rays import intersections
from tooltip_cli.method.types import Rays

Image = npt.NDArray[np.uint8]


@pytest.fixture(scope="module")
def pair() -> tuple[Image, Image]:
    """Two images of a textured scene with sensor noise, the second moved a little."""
    rng = np.random.default_rng(0)
    scene = cv2.resize(rng.integers(0, 256, (120, 160), np.uint8), (648, 488))
    first, second = scene[4:484, 4:644], scene[5:485, 2:642]
    noisy = (np.clip(view + rng.normal(0, 4, view.shape), 0, 255) for view in (first, second))
    first, second = (np.ascontiguousarray(view, np.uint8) for view in noisy)
    return first, second


@pytest.mark.parametrize("use_numba", [True, False], ids=["compiled", "opencv"])
def test_edge_points(benchmark: Any, pair: tuple[Image, Image], use_numba: bool) -> None:
    assert len(benchmark(edge_points, pair[0], 50, 150, 7, use_numba)) > 5000


@pytest.mark.parametrize("form", Form)
def test_match_blocks(benchmark: Any, pair: tuple[Image, Image], form: Form) -> None:
    if form > best_form():
        pytest.skip(f"this processor is not one for {form.name}")
    edges = edge_points(pair[0], 50, 150, 7)
    benchmark(_match_compiled, *pair, edges, 5, 11, 199, 0.25, None, form)


@pytest.mark.parametrize("iterations", [0, 6])
def test_fit_background(benchmark: Any, pair: tuple[Image, Image], iterations: int) -> None:
    edges = edge_points(pair[0], 50, 150, 7)
    matches = match_blocks(*pair, edges)
    motion = (edges, matches.translations, matches.covariances)
    assert benchmark(fit_background, *motion, iterations=iterations) is not None


def test_a_pair_of_images(benchmark: Any, pair: tuple[Image, Image]) -> None:
    params = DetectorParams()
    benchmark(lambda: detect_tip(*pair, find_edges(pair[0], params), params))


@pytest.mark.parametrize("count", [400, 2000])
def test_intersections(benchmark: Any, count: int) -> None:
    rng = np.random.default_rng(0)
    origins = rng.normal(0, 0.2, (count, 3)) - (0.0, 0.0, 0.6)
    directions = rng.normal(0, 0.01, (count, 3)) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    rays = Rays(np.arange(count), origins, directions)
    assert len(benchmark(intersections, rays, max_distance=0.0254)[0]) > count


def test_kmeans(benchmark: Any) -> None:
    points = np.random.default_rng(0).normal(0, 0.02, (50_000, 3))
    assert len(benchmark(kmeans, points, 8, 0).means) == 8
