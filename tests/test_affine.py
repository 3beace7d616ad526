"""The affine motion model against dense linear algebra, known warps and bad data."""

from __future__ import annotations

import itertools
import math
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tooltip_cli.method.affine import STILL, AffineFit, fit_affine, fit_background, mahalanobis
from tooltip_cli.method.blocks import match_blocks, matchable

Floats = npt.NDArray[np.float64]

try:
    import numba  # noqa: F401  (whether this works is the question)

    FORMS = [False, True]
except ImportError:
    FORMS = [False]

both_forms = pytest.mark.parametrize("use_numba", FORMS)
seeds = st.integers(0, 2**32 - 1)

TURN = np.array([[1.01, -0.02, 3.1], [0.015, 0.995, -2.4]])


def covariances(rng: np.random.Generator, count: int) -> Floats:
    """Error models like those of edges: round ones and long ones in any direction."""
    angle, wide = rng.uniform(0, math.pi, count), rng.uniform(0.25, 10, count)
    narrow = rng.uniform(0.25, 1, count)
    c, s = np.cos(angle), np.sin(angle)
    return np.stack(
        [wide * c * c + narrow * s * s, (wide - narrow) * c * s, wide * s * s + narrow * c * c], 1
    )


def background(
    rng: np.random.Generator, count: int, model: Floats, moving: float = 0.0
) -> tuple[npt.NDArray[np.int32], Floats, Floats]:
    """Edges that follow a model, but for a part that goes anywhere; whole pixels are not kept."""
    edges = rng.integers(0, [640, 480], (count, 2)).astype(np.int32)
    translations = edges @ model[:, :2].T + model[:, 2] - edges
    away = rng.random(count) < moving
    translations[away] += rng.uniform(2, 8, (away.sum(), 2)) * [1, -1]
    return edges, translations, covariances(rng, count)


def matrices(packed: Floats) -> Floats:
    return packed[:, [0, 1, 1, 2]].reshape(-1, 2, 2)


def dense(edges: Any, translations: Any, packed: Floats) -> tuple[Floats, Floats, Floats]:
    """X_1, Sigma and x_2 of section 3.1, element by element."""
    count = len(edges)
    design, sigma = np.zeros((2 * count, 6)), np.zeros((2 * count, 2 * count))
    for i, (u, v) in enumerate(edges):
        design[2 * i] = [u, v, 1, 0, 0, 0]
        design[2 * i + 1] = [0, 0, 0, u, v, 1]
        sigma[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = matrices(packed)[i]
    return design, sigma, (np.asarray(edges, float) + translations).ravel()


def corner_error(model: Floats, truth: Floats) -> float:
    """Largest disagreement of two models in a 640 x 480 image, pixels."""
    corners = np.array([[u, v, 1] for u in (0, 639) for v in (0, 479)])
    return float(np.abs(corners @ (model - truth).T).max())


def found(fit: AffineFit | None) -> AffineFit:
    assert fit is not None
    return fit


@settings(deadline=None)
@given(seed=seeds, count=st.integers(4, 40))
def test_block_form_equals_the_dense_normal_equations(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    edges = rng.integers(0, 640, (count, 2))
    edges[:3] = [[0, 0], [600, 30], [40, 500]]
    translations, packed = rng.normal(0, 3, (count, 2)), covariances(rng, count)
    design, sigma, target = dense(edges, translations, packed)
    whitener = np.linalg.inv(np.linalg.cholesky(sigma))
    expected = np.linalg.lstsq(whitener @ design, whitener @ target, rcond=None)[0]
    model = fit_affine(edges, translations, packed)
    assert model is not None
    np.testing.assert_allclose(model.ravel(), expected, rtol=1e-9, atol=1e-9)
    normal = design.T @ np.linalg.solve(sigma, design)
    right = design.T @ np.linalg.solve(sigma, target)
    np.testing.assert_allclose(normal @ model.ravel(), right, rtol=1e-9, atol=1e-9 * right.max())


@settings(deadline=None)
@given(seed=seeds)
def test_weights_scale_the_information_and_a_mask_leaves_out(seed: int) -> None:
    rng = np.random.default_rng(seed)
    edges, translations, packed = background(rng, 30, TURN, 0.3)
    weights = rng.uniform(0.1, 3, 30)
    weighted = fit_affine(edges, translations, packed, weights)
    scaled = fit_affine(edges, translations, packed / weights[:, None])
    assert weighted is not None
    assert scaled is not None
    np.testing.assert_allclose(weighted, scaled, rtol=1e-9, atol=1e-9)
    mask = np.arange(30) % 3 > 0
    masked = fit_affine(edges, translations, packed, mask.astype(float))
    chosen = fit_affine(edges[mask], translations[mask], packed[mask])
    assert masked is not None
    assert chosen is not None
    np.testing.assert_allclose(masked, chosen, rtol=1e-9, atol=1e-9)


@settings(deadline=None)
@given(seed=seeds)
def test_distances_equal_the_formula(seed: int) -> None:
    rng = np.random.default_rng(seed)
    edges, translations, packed = background(rng, 10, TURN, 0.5)
    expected = []
    for (u, v), step, matrix in zip(edges, translations, matrices(packed), strict=True):
        error = np.eye(2, 3) @ [u, v, 1] + step - TURN @ [u, v, 1]
        expected.append(math.sqrt(error @ np.linalg.inv(matrix) @ error))
    distances = mahalanobis(TURN, edges, translations, packed)
    np.testing.assert_allclose(distances, expected, rtol=1e-9, atol=1e-6)


@both_forms
def test_model_maps_the_first_image_to_the_second(use_numba: bool) -> None:
    edges = np.array([[10, 20], [300, 40], [50, 400], [200, 210]], np.int32)
    steps = np.tile(np.array([[3, -2]], np.int32), (4, 1))
    fit = found(fit_background(edges, steps, np.tile([1.0, 0.2, 2.0], (4, 1)), use_numba=use_numba))
    np.testing.assert_allclose(fit.model, [[1, 0, 3], [0, 1, -2]], atol=1e-12)
    np.testing.assert_allclose(fit.distances, 0, atol=1e-9)
    assert fit.inliers.all()


@both_forms
@settings(deadline=None, max_examples=40)
@given(seed=seeds, count=st.integers(3, 200))
def test_a_known_model_is_recovered_exactly(use_numba: bool, seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    model = np.eye(2, 3) + rng.normal(0, [0.05, 0.05, 20], (2, 3))
    edges, translations, packed = background(rng, count, model)
    edges[:3] = [[0, 0], [600, 30], [40, 400]]
    translations[:3] = edges[:3] @ model[:, :2].T + model[:, 2] - edges[:3]
    for fitted in (
        fit_affine(edges, translations, packed),
        found(fit_background(edges, translations, packed, use_numba=use_numba)).model,
    ):
        assert fitted is not None
        np.testing.assert_allclose(fitted, model, rtol=1e-9, atol=1e-9)


@both_forms
@pytest.mark.parametrize("moving", [0.0, 0.1, 0.3])
def test_scattered_outliers_do_not_matter(use_numba: bool, moving: float) -> None:
    edges, translations, packed = background(np.random.default_rng(4), 3000, TURN, moving)
    translations += np.random.default_rng(5).normal(0, 0.2, translations.shape)
    fit = found(fit_background(edges, translations, packed, use_numba=use_numba))
    assert corner_error(fit.model, TURN) < 0.05
    plain = fit_affine(edges, translations, packed)
    assert plain is not None
    assert moving == 0 or corner_error(plain, TURN) > 10 * corner_error(fit.model, TURN)


@both_forms
@pytest.mark.parametrize(("camera", "part"), [(STILL, 0.35), (TURN, 0.2)], ids=["still", "moving"])
def test_a_moving_object_does_not_matter(camera: Floats, part: float, use_numba: bool) -> None:
    """Many edges, all in one corner, move alike: the worst case for least squares."""
    edges, translations, packed = background(np.random.default_rng(6), 3000, camera)
    distance = np.hypot(*(edges - [150, 330]).T)
    arm = distance < np.quantile(distance, part)
    translations = translations + np.where(arm[:, None], [4.0, -3.0], 0.0)
    fit = found(fit_background(edges, translations, packed, use_numba=use_numba))
    assert corner_error(fit.model, camera) < 0.3
    assert np.median(fit.distances[arm]) > 5 * np.median(fit.distances[~arm])
    plain = fit_affine(edges, translations, packed)
    assert plain is not None
    assert corner_error(plain, camera) > 10 * corner_error(fit.model, camera)


@both_forms
@pytest.mark.parametrize(
    "warp",
    [
        np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
        np.array([[1.0, 0.004, 1.3], [-0.004, 1.0, 0.7]]),
        np.array([[1.006, 0.0, -1.9], [0.0, 1.006, -1.4]]),
        np.array([[1.0, -0.01, 2.4], [0.01, 1.0, -3.2]]),
    ],
)
def test_a_warped_image_gives_its_warp(warp: Floats, use_numba: bool) -> None:
    rng = np.random.default_rng(7)
    coarse = rng.integers(0, 256, (60, 80), np.uint8)
    first = cv2.resize(coarse, (640, 480), interpolation=cv2.INTER_CUBIC)
    second = cv2.warpAffine(first, warp, (640, 480), borderMode=cv2.BORDER_REFLECT)
    noise = rng.normal(0, 2, second.shape)
    second = np.clip(second + noise, 0, 255).astype(np.uint8)
    second[300:420, 100:240] = rng.integers(0, 256, (120, 140))  # something that is not there
    v, u = np.nonzero(cv2.Canny(first, 50, 150))
    edges = np.stack([u, v], axis=1).astype(np.int32)
    edges = edges[matchable(edges, (480, 640))]
    matches = match_blocks(np.asarray(first, np.uint8), second, edges, use_numba=use_numba)
    fit = found(
        fit_background(edges, matches.translations, matches.covariances, use_numba=use_numba)
    )
    assert corner_error(fit.model, warp) < 0.15


@pytest.mark.skipif(len(FORMS) < 2, reason="numba is not installed")
@settings(deadline=None, max_examples=60)
@given(
    seed=seeds,
    count=st.integers(3, 400),
    whole=st.booleans(),
    iterations=st.integers(0, 10),
    fraction=st.floats(0, 0.5),
    within=st.floats(0, 3),
    start=st.sampled_from([None, STILL, TURN]),
)
def test_both_forms_agree(
    seed: int,
    count: int,
    whole: bool,
    iterations: int,
    fraction: float,
    within: float,
    start: Floats | None,
) -> None:
    edges, translations, packed = background(np.random.default_rng(seed), count, TURN, 0.3)
    steps: Any = np.round(translations).astype(np.int32) if whole else translations
    options: dict[str, Any] = {
        "iterations": iterations,
        "drop_fraction": fraction,
        "keep_within": within,
        "start": start,
    }
    plain = fit_background(edges, steps, packed, **options, use_numba=False)
    compiled = fit_background(edges, steps, packed, **options, use_numba=True)
    if plain is None or compiled is None:
        assert plain is compiled
        return
    np.testing.assert_array_equal(compiled.inliers, plain.inliers)
    np.testing.assert_allclose(compiled.model, plain.model, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(compiled.distances, plain.distances, rtol=1e-9, atol=1e-9)


@both_forms
@settings(deadline=None, max_examples=30)
@given(seed=seeds)
def test_order_of_the_edges_does_not_matter(use_numba: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    edges, translations, packed = background(rng, 300, TURN, 0.2)
    fit = found(fit_background(edges, translations, packed, use_numba=use_numba))
    order = rng.permutation(300)
    again = found(
        fit_background(edges[order], translations[order], packed[order], use_numba=use_numba)
    )
    np.testing.assert_allclose(again.model, fit.model, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(again.distances, fit.distances[order], rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(again.inliers, fit.inliers[order])


@both_forms
def test_start_decides_what_is_dropped_first(use_numba: bool) -> None:
    """Half of the edges stay, half go: whichever the start explains is the background."""
    edges, _, packed = background(np.random.default_rng(13), 400, STILL)
    goes = np.arange(400) % 2 == 1
    steps = np.where(goes[:, None], [5, 2], 0).astype(np.int32)
    moved = np.array([[1.0, 0.0, 5.0], [0.0, 1.0, 2.0]])
    for start, background_goes in ((STILL, False), (moved, True)):
        fit = found(fit_background(edges, steps, packed, start=start, use_numba=use_numba))
        assert (fit.inliers <= (goes == background_goes)).all()
        np.testing.assert_allclose(fit.model, start, atol=1e-9)


@both_forms
def test_schedule_drops_what_it_says(use_numba: bool) -> None:
    edges, translations, packed = background(np.random.default_rng(8), 2000, TURN, 0.2)
    translations += np.random.default_rng(9).normal(0, 0.3, translations.shape)
    kept = []
    for iterations in range(4):
        fit = found(
            fit_background(
                edges,
                translations,
                packed,
                iterations=iterations,
                drop_fraction=0.2,
                keep_within=0.0,
                use_numba=use_numba,
            )
        )
        kept.append(int(fit.inliers.sum()))
        used = fit.inliers
        again = fit_affine(edges[used], translations[used], packed[used])
        assert again is not None
        np.testing.assert_allclose(fit.model, again, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(
            fit.distances, mahalanobis(fit.model, edges, translations, packed), atol=1e-9
        )
    assert kept[0] == 2000
    for before, after in itertools.pairwise(kept):  # ties can only spare an edge
        assert 0.8 * before - 1 <= after <= 0.83 * before


@both_forms
def test_what_the_model_explains_is_never_dropped(use_numba: bool) -> None:
    edges, translations, packed = background(np.random.default_rng(10), 500, TURN)
    translations += np.random.default_rng(11).uniform(-0.3, 0.3, translations.shape)
    fit = found(fit_background(edges, translations, packed, start=None, use_numba=use_numba))
    assert fit.distances.max() < 1.0
    assert fit.inliers.all()


@both_forms
def test_equal_distances_share_their_fate(use_numba: bool) -> None:
    """Still edges and equally many pairs of opposite ones: halves of a tie cannot be told apart."""
    grid = np.stack(np.meshgrid(np.arange(20), np.arange(20)), -1).reshape(-1, 2) * 20
    edges = np.concatenate([grid, grid, grid]).astype(np.int32)
    steps = np.zeros((1200, 2), np.int32)
    steps[400:800], steps[800:] = [3, 0], [-3, 0]
    packed = np.tile([0.25, 0.0, 0.25], (1200, 1))
    fit = found(fit_background(edges, steps, packed, drop_fraction=0.1, use_numba=use_numba))
    assert fit.inliers.all()  # 800 edges tie for the worst tenth
    np.testing.assert_allclose(fit.distances[400:], 6.0, rtol=1e-9)
    fit = found(fit_background(edges, steps, packed, drop_fraction=0.7, use_numba=use_numba))
    assert fit.inliers.tolist() == [True] * 400 + [False] * 800


@both_forms
def test_dropping_stops_before_the_model_is_lost(use_numba: bool) -> None:
    """On a line but for two edges that contradict one another: both are needed."""
    edges = np.array([[10 * i, 5 * i] for i in range(20)] + [[50, 300]] * 2, np.int32)
    steps = np.zeros((22, 2), np.int32)
    steps[20:] = [[0, 5], [0, -5]]
    packed = np.tile([0.25, 0.0, 0.25], (22, 1))
    fit = found(fit_background(edges, steps, packed, use_numba=use_numba))
    assert fit.inliers.all()
    np.testing.assert_allclose(fit.model, np.eye(2, 3), atol=1e-9)


def degenerate() -> dict[str, tuple[Any, Any, Any]]:
    rng = np.random.default_rng(12)
    edges, translations, packed = background(rng, 20, TURN)
    line = np.stack([np.arange(20) * 31 + 5, np.arange(20) * 17 + 400], axis=1)
    unknown, flat, negative = translations.copy(), packed.copy(), packed.copy()
    unknown[3, 0] = math.nan
    flat[5] = [1.0, 1.0, 1.0]
    negative[7] = [-1.0, 0.0, -1.0]
    endless = edges.astype(float)
    endless[2] = math.inf
    return {
        "no edges": (edges[:0], translations[:0], packed[:0]),
        "two edges": (edges[:2], translations[:2], packed[:2]),
        "one place": (np.tile(edges[:1], (20, 1)), translations, packed),
        "one line": (line, translations, packed),
        "one upright line": (line * [0, 1] + [7, 0], translations, packed),
        "unknown translation": (edges, unknown, packed),
        "flat covariance": (edges, translations, flat),
        "negative covariance": (edges, translations, negative),
        "infinite edge": (endless, translations, packed),
    }


@both_forms
@pytest.mark.parametrize("case", degenerate())
def test_degenerate_edges_give_no_model(case: str, use_numba: bool) -> None:
    edges, translations, packed = degenerate()[case]
    with np.errstate(invalid="ignore"):
        assert fit_affine(edges, translations, packed) is None
        assert fit_background(edges, translations, packed, use_numba=use_numba) is None


@both_forms
def test_three_edges_off_a_line_are_enough(use_numba: bool) -> None:
    edges = np.array([[600, 470], [601, 470], [600, 471]], np.int32)
    steps = edges @ (TURN[:, :2] - np.eye(2)).T + TURN[:, 2]
    packed = np.tile([0.25, 0.0, 0.25], (3, 1))
    fit = found(fit_background(edges, steps, packed, use_numba=use_numba))
    np.testing.assert_allclose(fit.model, TURN, rtol=1e-9, atol=1e-9)


@both_forms
def test_one_pixel_off_a_line_is_enough(use_numba: bool) -> None:
    edges = np.array([[3 * i, 2 * i] for i in range(200)] + [[301, 200]], np.int32)
    steps = edges @ (TURN[:, :2] - np.eye(2)).T + TURN[:, 2]
    packed = np.tile([0.25, 0.0, 0.25], (201, 1))
    fit = found(fit_background(edges, steps, packed, start=None, use_numba=use_numba))
    np.testing.assert_allclose(fit.model, TURN, atol=1e-8)


@both_forms
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"edges": np.zeros((5, 3))}, "edges has shape"),
        ({"translations": np.zeros((4, 2))}, "translations has shape"),
        ({"covariances": np.zeros((5, 2, 2))}, "covariances has shape"),
        ({"start": np.eye(3)}, "start"),
        ({"start": np.full((2, 3), math.nan)}, "start"),
        ({"iterations": -1}, "iterations"),
        ({"drop_fraction": 1.0}, "drop_fraction"),
        ({"drop_fraction": math.nan}, "drop_fraction"),
        ({"keep_within": -1.0}, "keep_within"),
    ],
)
def test_wrong_arguments_are_refused(
    changes: dict[str, Any], message: str, use_numba: bool
) -> None:
    arguments: dict[str, Any] = {
        "edges": np.zeros((5, 2)),
        "translations": np.zeros((5, 2)),
        "covariances": np.ones((5, 3)),
        **changes,
    }
    with pytest.raises(ValueError, match=message):
        fit_background(**arguments, use_numba=use_numba)
