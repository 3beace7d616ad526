"""The global motion model: an affine map fitted to the background (paper, 3.1 and appendix A)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tooltip_cli import machine_code

Floats = npt.NDArray[np.float64]
Pairs = npt.NDArray[np.integer] | npt.NDArray[np.floating]

# A parameter counts as undetermined when the others explain all but this part of its variance.
_SINGULAR = 1e-12

# Of `_affine_numba.background_fitter`; pixels are whole numbers or not.
_ARGUMENTS = "{0}* {0}* f64* i64 f64* i64 i64 f64 f64 f64 f64* i32* i32* f64* f64* f64* f64* u8*"

_SCRATCH = machine_code.Scratch()

STILL: Floats = np.eye(2, 3)  # the model of a background that does not move
STILL.flags.writeable = False


@dataclass(frozen=True)
class AffineFit:
    """The motion of the background, and how badly each edge fits it.

    Attributes:
        model: (2, 3) float64, A, takes (u, v, 1) in the first image to the second, pixels.
        distances: (N,) float64, Mahalanobis distance of every edge from the model; no unit.
        inliers: (N,) bool, the edges that the model was fitted to.
    """

    model: Floats
    distances: Floats
    inliers: npt.NDArray[np.bool_]


def fit_affine(
    edges: Pairs, translations: Pairs, covariances: Floats, weights: Floats | None = None
) -> Floats | None:
    """Fit the affine motion model by weighted linear least squares (paper, appendix A).

    Args:
        edges: (N, 2), (u, v) in the first image, pixels.
        translations: (N, 2), (du, dv) of their matches, pixels.
        covariances: (N, 3), C_uu, C_uv, C_vv of the matches' errors, pixels squared.
        weights: (N,), factors of the edges' information C^-1, or a mask; all 1 if None.

    Returns:
        (2, 3) float64, A, which takes (u, v, 1) to (u + du, v + dv); None if the edges do not
        determine it: fewer than three, all on one line, or a covariance that is not positive
        definite.
    """
    if len(edges) < 3:
        return None
    # A = [I 0] + D with the translations as D p: the same solution, better conditioned. So are
    # centred coordinates of about 1; the power of two and the whole pixels convert back exactly.
    centre = np.round(edges.mean(axis=0))
    spread = float(np.abs(edges - centre).max())
    scale = 2.0 ** -math.frexp(spread)[1] if math.isfinite(spread) else math.nan
    # The constant comes first: the pivots then show edges on a line clear of rounding errors.
    p = np.column_stack([np.ones(len(edges)), (edges - centre) * scale])
    c1, c3, c4 = _inverses(covariances) * (1.0 if weights is None else weights)
    tu, tv = translations.T
    block_1, block_3, block_4 = (p.T @ (c[:, None] * p) for c in (c1, c3, c4))
    normal = np.block([[block_1, block_3], [block_3, block_4]])
    right = np.concatenate([p.T @ (c1 * tu + c3 * tv), p.T @ (c3 * tu + c4 * tv)])
    if not (np.isfinite(right).all() and _solvable(normal)):
        return None
    constant, slopes = np.split(np.linalg.solve(normal, right).reshape(2, 3), [1], axis=1)
    slopes *= scale
    return np.column_stack([np.eye(2) + slopes, constant[:, 0] - slopes @ centre])


def mahalanobis(model: Floats, edges: Pairs, translations: Pairs, covariances: Floats) -> Floats:
    """Return how far each match is from where the model predicts it (paper, 3.1, d_i).

    Args:
        model: (2, 3), A.
        edges: (N, 2), (u, v) in the first image, pixels.
        translations: (N, 2), (du, dv) of their matches, pixels.
        covariances: (N, 3), C_uu, C_uv, C_vv of the matches' errors, pixels squared.

    Returns:
        (N,) float64, in standard deviations of the match's error: a pure number, although the
        paper speaks of pixels.
    """
    x, y = ((model[:, :2] - np.eye(2)) @ edges.T + model[:, 2:]) - translations.T
    c1, c3, c4 = _inverses(covariances)
    distances: Floats = np.sqrt(np.maximum(c1 * x * x + 2.0 * c3 * x * y + c4 * y * y, 0.0))
    return distances


def fit_background(
    edges: Pairs,
    translations: Pairs,
    covariances: Floats,
    *,
    start: Floats | None = STILL,
    iterations: int = 6,
    drop_fraction: float = 0.2,
    keep_within: float = 1.0,
    use_numba: bool | None = None,
) -> AffineFit | None:
    """Fit the motion model to the background by dropping what fits worst (paper, section 3.1).

    After each fit the worst fitting edges are dropped and the model is fitted again. How is not in
    the paper. Here `drop_fraction` of the remaining edges are dropped at a time, never one that the
    model explains to within `keep_within`; edges of equal distance, to one part in a hundred, share
    their fate. It ends early when nothing is left to drop, or when what would remain would no
    longer determine a model. Whom to drop first is decided by the distances from `start`: a fit to
    everything that moves is further from the background than a camera that stands still.

    Args:
        edges: (N, 2), (u, v) in the first image, pixels.
        translations: (N, 2), (du, dv) of their matches, pixels.
        covariances: (N, 3), C_uu, C_uv, C_vv of the matches' errors, pixels squared.
        start: (2, 3), the model that decides which edges are dropped first; None takes the fit to
            all edges.
        iterations: how often edges are dropped at most.
        drop_fraction: part of the remaining edges that is dropped each time, 0 to less than 1.
        keep_within: Mahalanobis distance up to which edges are never dropped.
        use_numba: whether to run the compiled form; None takes it where numba can be imported.

    Returns:
        The fit, with the distances of all edges to the final model; None if the edges do not
        determine a model, see `fit_affine`.

    Raises:
        ValueError: an argument has the wrong shape or range.
        ImportError: `use_numba` is True and numba cannot be imported.
    """
    _check(edges, translations, covariances)
    if iterations < 0 or not 0.0 <= drop_fraction < 1.0 or not keep_within >= 0.0:
        raise ValueError(
            f"iterations, drop_fraction and keep_within are {iterations}, {drop_fraction} and "
            f"{keep_within}; expected at least 0, 0 to less than 1, and at least 0"
        )
    if (
        start is not None
        and start is not STILL  # looking takes as long as fitting to a hundred edges
        and not (start.shape == (2, 3) and np.isfinite(start).all())
    ):
        raise ValueError(f"start is {start}; expected a finite affine model of shape (2, 3)")
    if len(edges) < 3:
        return None
    schedule = (start, iterations, drop_fraction, keep_within**2)
    return machine_code.fast_or_slow(
        lambda: _fit_compiled(edges, translations, covariances, *schedule),
        lambda: _fit_numpy(edges, translations, covariances, *schedule),
        use_numba,
    )


def _fit_compiled(
    edges: Pairs,
    translations: Pairs,
    covariances: Floats,
    start: Floats | None,
    iterations: int,
    drop_fraction: float,
    keep_below: float,
) -> AffineFit | None:
    count, whole = len(edges), edges.dtype == translations.dtype == np.int32
    kind, pairs = ("i32", np.int32) if whole else ("f64", np.float64)
    background = machine_code.kernel(
        "tooltip_cli.method._affine_numba", "background_fitter", _ARGUMENTS.format(kind)
    )
    fit = AffineFit(np.empty((2, 3)), np.empty(count), np.empty(count, np.bool_))
    ranking, bins, sums, lower = _SCRATCH(None, _space)
    ranking.array[:] = STILL if start is None else start
    found = background(
        np.ascontiguousarray(edges, pairs),
        np.ascontiguousarray(translations, pairs),
        np.ascontiguousarray(covariances, np.float64),
        count,
        ranking,
        start is not None,
        iterations,
        drop_fraction,
        keep_below,
        _SINGULAR,
        np.empty((7, count)),
        np.empty(count, np.int32),
        bins,
        sums,
        lower,
        fit.model,
        fit.distances,
        fit.inliers.view(np.uint8),
    )
    return fit if found else None


def _space() -> tuple[Floats, npt.NDArray[np.int32], Floats, Floats]:
    """Return the part of the compiled form's scratch space that does not grow with the edges."""
    return np.empty((2, 3)), np.empty((4, 1024), np.int32), np.empty(24), np.empty(42)


def _fit_numpy(
    edges: Pairs,
    translations: Pairs,
    covariances: Floats,
    start: Floats | None,
    iterations: int,
    drop_fraction: float,
    keep_below: float,
) -> AffineFit | None:
    inliers = np.ones(len(edges), np.bool_)
    model = fit_affine(edges, translations, covariances)
    if model is None:
        return None
    ranking = model if start is None else start
    for _ in range(iterations):
        squared = mahalanobis(ranking, edges, translations, covariances) ** 2
        count = int(inliers.sum())
        keep = count - math.ceil(drop_fraction * count)
        better = inliers & (squared <= max(_limit(squared[inliers], keep), keep_below))
        if np.array_equal(better, inliers):
            if ranking is model:
                break
            ranking = model
            continue
        refined = fit_affine(edges[better], translations[better], covariances[better])
        if refined is None:
            break
        inliers, model = better, refined
        ranking = model
    return AffineFit(model, mahalanobis(model, edges, translations, covariances), inliers)


def _limit(squared: Floats, keep: int) -> float:
    """Return the squared distance up to which `keep` edges or, with their ties, more lie.

    Distances tie when they agree in the five leading bits of their square's mantissa, rounded, or
    when both are below 1/16: rounding errors of the fit must not decide which edges stay.
    """
    keys = (squared.view(np.int64) + (1 << 46)) >> 47
    ranked = np.clip(keys - ((1023 - 8) << 5), 0, 1023)
    key = int(np.partition(ranked, keep - 1)[keep - 1]) if keep > 0 else 0
    return math.inf if key == 1023 else math.ldexp(1.0 + (key % 32 + 0.5) / 32.0, key // 32 - 8)


def _inverses(covariances: Floats) -> Floats:
    """Return (3, N): c1, c3 and c4 of C^-1; nan where C is not positive definite."""
    uu, uv, vv = np.asarray(covariances, np.float64).T
    determinant = uu * vv - uv * uv
    valid = (determinant > 0.0) & (uu > 0.0)
    inverse = np.divide(1.0, determinant, out=np.full(len(valid), math.nan), where=valid)
    terms: Floats = np.stack([vv * inverse, -uv * inverse, uu * inverse])
    return terms


def _solvable(normal: Floats) -> bool:
    """Return whether the (6, 6) normal equations determine all parameters."""
    if not np.isfinite(normal).all():
        return False
    try:
        pivots = np.diag(np.linalg.cholesky(normal)) ** 2
    except np.linalg.LinAlgError:
        return False
    return bool((pivots > _SINGULAR * np.diag(normal)).all())


def _check(edges: Pairs, translations: Pairs, covariances: Floats) -> None:
    count = len(edges)
    for name, values, width in (
        ("edges", edges, 2),
        ("translations", translations, 2),
        ("covariances", covariances, 3),
    ):
        if values.shape != (count, width):
            raise ValueError(f"{name} has shape {values.shape}; expected ({count}, {width})")
