"""Splits and errors of section 4."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tooltip_cli.errors import TooltipError, one_of
from tooltip_cli.method.types import Array, Indices

SPLIT_KINDS = ("random", "blocks")
BOOTSTRAP_DRAWS = 2000
_TEST_BLOCKS = 5
_LEAST_BLOCKS = 5  # that an interval is drawn from, where there are as many errors
_NORMAL_95 = 1.959963984540054  # 97.5 % quantile of the normal distribution


@dataclass(frozen=True)
class Split:
    """Which frames train and which test (paper, 4.1: 400 and 100 at random)."""

    train: Indices  # ascending image indices
    test: Indices  # ascending image indices
    kind: str  # random, blocks, or labels where the labelled frames are the test set
    seed: int
    notes: tuple[str, ...] = ()  # what differs from what was asked for


def split_frames(
    count: int, train: int = 400, test: int = 100, seed: int = 0, kind: str = "random"
) -> Split:
    """Split ``count`` frames by a seeded permutation, or into contiguous test blocks.

    With fewer frames than asked for, both parts shrink in proportion, and a note says so.

    Args:
        kind: ``random`` as in the paper, or ``blocks``: five contiguous test blocks at seeded
            places, because neighbouring frames resemble one another.

    Raises:
        TooltipError: an unknown kind, or sizes that are not positive.
    """
    if kind not in SPLIT_KINDS:
        raise TooltipError(one_of("split", kind, SPLIT_KINDS))
    if train < 1 or test < 1:
        raise TooltipError(f"a split needs at least one frame on each side, found {train}/{test}")
    wanted = (train, test)
    if count < train + test:
        test = max(1, round(count * test / (train + test)))
        train = max(0, count - test)
    notes = _shortage(wanted, (train, test), count)
    rng = np.random.default_rng(seed)
    if kind == "random":
        order = rng.permutation(count)
        chosen, rest = order[:test], order[test:]
    else:
        chosen = _blocks(count, test, rng)
        rest = rng.permutation(np.setdiff1d(np.arange(count), chosen))
    return Split(np.sort(rest[:train]), np.sort(chosen), kind, seed, notes)


def split_by_labels(count: int, labelled: Indices, train: int = 400, seed: int = 0) -> Split:
    """Make the labelled frames the test set; training is drawn from the rest by the seed.

    A labelled frame is never trained on, also where its label says that the tip is hidden.
    """
    test = np.unique(labelled).astype(np.intp)
    rest = np.setdiff1d(np.arange(count), test)
    chosen = np.random.default_rng(seed).permutation(rest)[:train]
    notes = _shortage((train, len(test)), (len(chosen), len(test)), count)
    return Split(np.sort(chosen), test, "labels", seed, notes)


def _blocks(count: int, test: int, rng: np.random.Generator) -> Indices:
    blocks = min(_TEST_BLOCKS, test)
    lengths = [len(part) for part in np.array_split(np.arange(test), blocks)]
    gaps = np.sort(rng.integers(0, count - test + 1, size=blocks))
    starts = gaps + np.concatenate([[0], np.cumsum(lengths)[:-1]])
    return np.concatenate(
        [np.arange(start, start + length) for start, length in zip(starts, lengths, strict=True)]
    )


def _shortage(wanted: tuple[int, int], got: tuple[int, int], count: int) -> tuple[str, ...]:
    if wanted == got:
        return ()
    return (
        f"asked for {wanted[0]} training and {wanted[1]} test frames; the {count} frames of the "
        f"recording give {got[0]} and {got[1]}",
    )


@dataclass(frozen=True)
class ErrorSummary:
    """Statistics of errors, in the errors' unit."""

    count: int
    mean: float
    median: float
    rms: float
    p95: float  # 95th percentile
    maximum: float
    low: float | None = None  # 95 % bootstrap interval of the mean; None below two errors
    high: float | None = None


def summarize(errors: Array, seed: int = 0) -> ErrorSummary | None:
    """Return the statistics of (N,) errors in the order of their frames; None without any.

    Errors that are not a number are left out.
    """
    finite = errors[np.isfinite(errors)]
    if not len(finite):
        return None
    low, high = bootstrap_interval(finite, seed) or (None, None)
    return ErrorSummary(
        len(finite),
        float(finite.mean()),
        float(np.median(finite)),
        float(np.sqrt(np.square(finite).mean())),
        float(np.percentile(finite, 95)),
        float(finite.max()),
        low,
        high,
    )


def pixel_errors(predicted: Array, labelled: Array) -> Array:
    """Return (N,) Euclidean distances in pixels; NaN where either is."""
    return np.asarray(np.linalg.norm(predicted - labelled, axis=1))


def block_length(count: int) -> int:
    """Return how many neighbouring frames are drawn together: they err alike."""
    return max(1, min(round(2.0 * float(np.cbrt(count))), count // _LEAST_BLOCKS))


def bootstrap_means(errors: Array, seed: int = 0, draws: int = BOOTSTRAP_DRAWS) -> Array:
    """Return (draws,) means of resampled (N,) errors, the errors in the order of their frames.

    Blocks of neighbours are drawn, around the end, because single draws would promise too narrow
    an interval (the moving-block bootstrap of Kunsch 1989, circular as in Politis and Romano 1992).
    """
    count = len(errors)
    length = block_length(count)
    rng = np.random.default_rng(seed)
    starts = rng.integers(0, count, size=(draws, -(-count // length)))
    chosen = (starts[:, :, None] + np.arange(length)).reshape(draws, -1)[:, :count] % count
    return np.asarray(errors[chosen].mean(axis=1))


def bootstrap_interval(
    errors: Array, seed: int = 0, draws: int = BOOTSTRAP_DRAWS
) -> tuple[float, float] | None:
    """Return the 95 % bootstrap interval of the mean of (N,) errors; None below two."""
    gathered = MeanInterval(draws)
    gathered.add(errors[np.isfinite(errors)], seed)
    return gathered.interval()


class MeanInterval:
    """The 95 % interval of a mean, or of the mean of several tools' means.

    Percentiles of bootstrap draws alone are too narrow where blocks are few: resampling K of them
    shows K - 1 of K parts of the variance, and that is itself uncertain. So the draws are spread by
    the first, and by Student's t against the normal for the second, with the degrees of freedom of
    Welch (1947) where several tools are averaged.
    """

    def __init__(self, draws: int = BOOTSTRAP_DRAWS) -> None:
        self._draws = np.zeros(draws)
        self._center, self._least, self._most = 0.0, 0.0, 0.0  # sums over the tools
        self._shown, self._variance, self._doubt = 0.0, 0.0, 0.0
        self._tools = 0
        self._narrow = True  # every tool has at least two errors

    def add(self, errors: Array, seed: int) -> None:
        """Add one tool's (N,) errors, finite and in the order of their frames."""
        self._narrow &= len(errors) > 1
        if not self._narrow:
            return
        means, blocks = bootstrap_means(errors, seed, len(self._draws)), _blocks_of(len(errors))
        shown = float(means.var())
        variance = shown * blocks / (blocks - 1)
        self._draws += means
        self._center += float(errors.mean())
        self._least += float(errors.min())
        self._most += float(errors.max())
        self._shown += shown
        self._variance += variance
        self._doubt += variance**2 / (blocks - 1)
        self._tools += 1

    def interval(self) -> tuple[float, float] | None:
        """Return the interval; None where a tool has fewer than two errors."""
        if not self._narrow or not self._tools:
            return None
        low, high = np.percentile(self._draws, [2.5, 97.5])
        if self._doubt > 0:
            spread = self._t() / _NORMAL_95 * np.sqrt(self._variance / self._shown)
            low, high = self._center + spread * (np.array([low, high]) - self._center)
        # no resampling leaves the range of the errors
        low, high = np.clip([low, high], self._least, self._most) / self._tools
        return float(low), float(high)

    def _t(self) -> float:
        from scipy.special import stdtrit

        return float(stdtrit(self._variance**2 / self._doubt, 0.975))


def _blocks_of(count: int) -> float:
    return count / block_length(count)


@dataclass(frozen=True)
class ClockFit:
    """The tip and the offset between the clocks that explain labels best."""

    position: Array  # (3,) metres, hand frame
    offset_s: float  # to add to the image stamps
    deviation_s: float  # standard deviation of the offset
    error_px: float  # mean distance between labels and projections with the offset
    error_without_px: float  # the same with the best tip for no offset

    @property
    def shown(self) -> bool:
        """Whether the labels show an offset: more than two standard deviations, and it helps."""
        helps = self.error_px < self.error_without_px
        return helps and abs(self.offset_s) > 2 * self.deviation_s


def fit_clock(
    project: Callable[[Array, float], Array],
    labelled: Array,
    start: Array,
    *,
    limit_s: float = 0.2,
    steps: int = 30,
) -> ClockFit | None:
    """Find the tip and the time offset with the least mean distance to labels.

    The mean distance, not its square, is what section 4.3 reports, and one wrong label hardly
    moves it. It is minimised by reweighted Gauss-Newton steps (Weiszfeld's algorithm).

    Args:
        project: (tip (3,), offset in seconds) -> (N, 2) pixels.
        labelled: (N, 2) pixels.
        start: (3,) metres, hand frame.
        limit_s: largest offset considered, seconds.

    Returns:
        The fit; None where too few labels can be projected, or they do not determine it.
    """
    without = _descend(project, labelled, np.append(start, 0.0), steps, limit_s, columns=3)
    fitted = None if without is None else _descend(project, labelled, without, steps, limit_s, 4)
    if without is None or fitted is None:
        return None
    residuals, jacobian = _linearise(project, labelled, fitted, 4)
    weights = _weights(residuals)
    normal = np.einsum("n,nki,nkj->ij", weights, jacobian, jacobian)
    scores = np.einsum("n,nki,nk->ni", weights, jacobian, residuals)
    try:
        bread = np.linalg.inv(normal)
    except np.linalg.LinAlgError:
        return None
    variance = float((bread @ (scores.T @ scores) @ bread)[3, 3])
    error = pixel_errors(project(fitted[:3], float(fitted[3])), labelled)
    error_without = pixel_errors(project(without[:3], 0.0), labelled)
    both = np.isfinite(error) & np.isfinite(error_without)  # a shift may leave the joints' stream
    return ClockFit(
        fitted[:3],
        float(fitted[3]),
        float(np.sqrt(variance)),
        float(error[both].mean()),
        float(error_without[both].mean()),
    )


_STEPS = (1e-5, 1e-5, 1e-5, 1e-3)  # metres and seconds, of the numerical derivative


def _linearise(
    project: Callable[[Array, float], Array], labelled: Array, at: Array, columns: int
) -> tuple[Array, Array]:
    """Return (M, 2) residuals and their (M, 2, columns) derivative, of the finite rows."""
    residuals = project(at[:3], float(at[3])) - labelled
    slopes = []
    for column in range(columns):
        step = np.zeros(4)
        step[column] = _STEPS[column]
        ahead, behind = at + step, at - step
        moved = project(ahead[:3], float(ahead[3])) - project(behind[:3], float(behind[3]))
        slopes.append(moved / (2 * _STEPS[column]))
    jacobian = np.stack(slopes, axis=2)
    finite = np.isfinite(residuals).all(axis=1) & np.isfinite(jacobian).all(axis=(1, 2))
    return residuals[finite], jacobian[finite]


def _weights(residuals: Array, floor_px: float = 0.1) -> Array:
    return np.asarray(1.0 / np.maximum(np.linalg.norm(residuals, axis=1), floor_px))


def _descend(
    project: Callable[[Array, float], Array],
    labelled: Array,
    start: Array,
    steps: int,
    limit_s: float,
    columns: int,
) -> Array | None:
    at, tolerance = np.array(start, dtype=float), np.array([1e-6, 1e-6, 1e-6, 1e-5])
    for _ in range(steps):
        residuals, jacobian = _linearise(project, labelled, at, columns)
        if len(residuals) < columns + 1:
            return None
        weights = _weights(residuals)
        normal = np.einsum("n,nki,nkj->ij", weights, jacobian, jacobian)
        gradient = np.einsum("n,nki,nk->i", weights, jacobian, residuals)
        step = np.zeros(4)
        step[:columns] = -np.linalg.lstsq(normal, gradient, rcond=None)[0]
        at += step
        at[3] = np.clip(at[3], -limit_s, limit_s)
        if not np.isfinite(at).all():
            return None
        if (np.abs(step) < tolerance).all():
            break
    return at
