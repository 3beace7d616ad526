"""What the frames show of an end as equations, and their robust least squares.

With D and T the directions in the hand frame that move the end's image along and across the image
of its axis, u = B^T D and w = B^T T their parts across the axis, d the step from the end as it was
looked at to the tip, and A, A_s 2x2 matrices that stand for elliptic outlines of the end and of
each slab s behind it:

    stop       = D d + |A^T u|
    side       = +-T (d or the midline at s) + |A_s^T w|
    middle     =   T (d or the midline at s)

The midline (an offset and a turn of the axis) is free of d: a plug's longest pin is not in line
with its body.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tooltip_cli import machine_code
from tooltip_cli.method.types import Array, Indices
from tooltip_cli.method.voting.loops import ENDS
from tooltip_cli.method.voting.params import RefineParams
from tooltip_cli.method.voting.sight import Measured, Sight, across_axis

_STOP, _MIDDLE, SIDE = 0, 1, 2  # kinds of equations
LINE = 7  # unknowns before the outlines: step (3), offset (2) and turn (2) of the midline
_TINY = 1e-8  # m^2, keeps the root of no width differentiable
# metres and radians, standard deviations of what is expected before the frames are looked at
_STEP_PRIOR, _OFFSET_PRIOR, _TURN_PRIOR, _RADIUS_PRIOR, _TAPER_PRIOR = (
    0.004, 0.010, 0.15, 0.006, 0.004,
)  # fmt: skip
_SUMMER = "f64* f64* f64* i64* i64* i64* i64 i64 f64* i64 f64 f64 f64 f64 f64* f64* f64* f64* f64*"


@dataclass(frozen=True)
class System:
    """What was measured, as equations: linear in all unknowns but the outlines."""

    basis: Array  # (3, 2) across the axis
    targets: Array  # (R,) metres
    linear: Array  # (R, 7) derivatives by step, offset and turn
    seen_along: Array  # (R, 2) direction that an outline is seen along
    outline: Indices  # (R,) which one, or -1
    kinds: Indices  # (R,)
    frames: Indices  # (R,)
    towards: Array  # (R, 3) hand frame: moving what is seen along it raises the target
    places: Array  # (R,) metres along the axis from the end, of what is seen
    prior: Array  # (P, unknowns)
    prior_targets: Array  # (P,)

    @property
    def sides(self) -> int:
        """How many equations each side has: the last ones, one side after the other."""
        return int(np.count_nonzero(self.kinds == SIDE)) // 2


def equations(
    sight: Sight,
    measured: Measured,
    slabs: Array,
    axis: Array,
    radius: float,
    params: RefineParams,
) -> System:
    basis = across_axis(axis)
    stopped = np.flatnonzero(np.isfinite(measured.stops))
    frame, slab = np.nonzero(np.isfinite(measured.middles))
    stop_rows = sight.stop_direction[stopped]
    side_rows = sight.side_direction[frame]
    across = side_rows @ basis
    own = (slab == 0)[:, None]  # the end itself is where the step leads; the rest is the midline
    place = np.minimum(slabs, 0.0).mean(axis=1)[slab][:, None]
    midline = np.where(own, 0.0, np.hstack([across, place * across]))
    lines = np.hstack([np.where(own, side_rows, 0.0), midline])
    middle, half = measured.middles[frame, slab], measured.halves[frame, slab]
    outlines = len(slabs) + 1
    prior, prior_targets = _prior(outlines, radius, len(stopped) + len(frame), params)
    return System(
        basis,
        np.concatenate([measured.stops[stopped], middle, half + middle, half - middle]),
        np.concatenate([np.pad(stop_rows, ((0, 0), (0, 4))), lines, lines, -lines]),
        np.concatenate([stop_rows @ basis, across, across, across]),
        np.concatenate([np.zeros_like(stopped), np.full_like(slab, -1), 1 + slab, 1 + slab]),
        np.repeat([_STOP, _MIDDLE, SIDE], [len(stopped), len(frame), 2 * len(frame)]),
        np.concatenate([stopped, frame, frame, frame]),
        np.concatenate([stop_rows, side_rows, side_rows, -side_rows]),
        np.concatenate([np.zeros(len(stopped)), *[np.where(own, 0.0, place)[:, 0]] * 3]),
        prior,
        prior_targets,
    )


def _prior(outlines: int, radius: float, count: int, params: RefineParams) -> tuple[Array, Array]:
    """Return weak equations that decide what frames leave open: rows, and what they should give."""
    unknowns = LINE + 3 * outlines
    sigmas = np.repeat(
        [_STEP_PRIOR, _OFFSET_PRIOR, _TURN_PRIOR, _RADIUS_PRIOR, _TAPER_PRIOR],
        [3, 2, 2, 3, 3 * (outlines - 1)],
    )
    rows = np.eye(unknowns)
    for column in range(LINE + 3, unknowns):  # neighbouring outlines are alike
        rows[column, column - 3] = -1.0
    targets = np.zeros(unknowns)
    targets[[LINE, LINE + 2]] = radius
    weights = params.prior_weight * np.sqrt(count) / sigmas
    return rows * weights[:, None], targets * weights


def residuals_of(system: System, unknowns: Array) -> tuple[Array, Array]:
    """Return (R,) residuals, metres, and (R, unknowns) the model's derivatives."""
    root = unknowns[LINE:].reshape(-1, 3)[system.outline]  # lower triangles
    u, w = system.seen_along.T
    first, second = root[:, 0] * u + root[:, 1] * w, root[:, 2] * w
    width = np.sqrt(first * first + second * second + _TINY)
    has = system.outline >= 0
    derivatives = np.zeros((len(u), len(unknowns)))
    derivatives[:, :LINE] = system.linear
    rows = np.flatnonzero(has)
    for offset, part in enumerate((first * u, first * w, second * w)):
        derivatives[rows, LINE + 3 * system.outline[rows] + offset] = (part / width)[rows]
    residuals = system.targets.copy()
    for column, unknown in zip(system.linear.T, unknowns, strict=False):  # in the kernel's order
        residuals -= column * unknown
    return residuals - np.where(has, width, 0.0), derivatives


def solve(
    system: System,
    unknowns: Array,
    loss: float,
    params: RefineParams,
    steps: int,
    frame_weights: Array | None = None,
) -> Array:
    """Return the unknowns after Gauss-Newton steps with Cauchy weights.

    Args:
        loss: scale of the robust loss, metres.
        frame_weights: (F,) how often each frame counts.
    """
    prior = system.prior.T @ system.prior + 1e-9 * np.eye(len(unknowns))
    for _ in range(steps):
        normal, right = _normal_equations(system, unknowns, loss, params, frame_weights)
        right += system.prior.T @ (system.prior_targets - system.prior @ unknowns)
        unknowns = unknowns + np.linalg.solve(normal + prior, right)
    return unknowns


def _normal_equations(
    system: System,
    unknowns: Array,
    loss: float,
    params: RefineParams,
    frame_weights: Array | None,
) -> tuple[Array, Array]:
    """Return (U, U) and (U,) of one step, without the prior."""

    def compiled() -> tuple[Array, Array]:
        count, size = len(system.targets), len(unknowns)
        normal, right = np.zeros((size, size)), np.zeros(size)
        machine_code.kernel(ENDS, "summer", _SUMMER)(
            system.targets,
            system.linear,
            system.seen_along,
            system.outline,
            system.kinds,
            system.frames,
            count,
            system.sides,
            unknowns,
            size,
            loss,
            params.side_weight,
            params.missed_weight,
            params.odd_width,
            np.ones(system.frames.max(initial=-1) + 1) if frame_weights is None else frame_weights,
            np.empty(count),
            np.empty(size),
            normal,
            right,
        )
        return normal + np.tril(normal, -1).T, right

    def plain() -> tuple[Array, Array]:
        residuals, derivatives = residuals_of(system, unknowns)
        weights = robust_weights(system, residuals, loss, params, frame_weights)
        weighted = derivatives * weights[:, None]
        # row after row, as the kernel does: where ends disagree, rounding errors grow
        rows = [np.add.reduce(column[:, None] * derivatives, axis=0) for column in weighted.T]
        normal = np.tril(rows)
        return normal + np.tril(normal, -1).T, np.add.reduce(weighted * residuals[:, None], axis=0)

    return machine_code.fast_or_slow(compiled, plain, None)


def robust_weights(
    system: System,
    residuals: Array,
    loss: float,
    params: RefineParams,
    frame_weights: Array | None = None,
) -> Array:
    """Return (R,) Cauchy weights of residuals (R,), metres."""
    side, middle = system.kinds == SIDE, system.kinds == _MIDDLE
    counted = 1.0 if frame_weights is None else frame_weights[system.frames]
    weights = counted / (loss * loss + residuals * residuals)
    weights[side] *= params.side_weight
    weights[side & (residuals < 0)] *= params.missed_weight
    # where one side was missed, half the width is too small and the middle says nothing
    left, right = residuals[side].reshape(2, -1)
    odd = (left + right) / 2 / params.odd_width
    weights[middle] /= (1.0 + odd * odd) * (1.0 + odd * odd)
    return np.asarray(weights)
