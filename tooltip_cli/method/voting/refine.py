"""The end again, from the images: robust least squares over where it stops and where its sides are.

Voxels are some millimetres wide, and so is what they say. Here the end that was found in them is
put right by what each frame shows of it (`equations.py`). All is measured again from where the end
then is, until it stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tooltip_cli.method.types import Array
from tooltip_cli.method.voting.equations import (
    LINE,
    SIDE,
    System,
    equations,
    residuals_of,
    solve,
)
from tooltip_cli.method.voting.params import RefineParams
from tooltip_cli.method.voting.sight import (
    NearEdges,
    across_axis,
    measure,
    near_edges,
    point_of,
    see,
)
from tooltip_cli.method.voting.volume import Cloud, HandEdges

SLABS = ((-0.010, 0.0), (-0.018, -0.010), (-0.026, -0.018))  # metres, behind the end's own
BEYOND_END = 0.003  # metres that the end's own slab reaches beyond it
_FIRST_END_SLAB = 0.010  # metres, shrinking by
_END_SLAB_STEP = 0.002  # in each round
_LEAST_WIDTH = 0.010  # metres across, looked at about the thinnest tools
_WIDTH_PER_RADIUS, _WIDTH_MARGIN = 1.8, 0.004
_END_MARGIN = 0.002  # metres beyond the end's sides
_MAX_STEP, _MAX_TURN = 0.005, 0.2  # metres and radians in one round
_AS_GOOD = 0.9  # share of the most support that is nearly the most
_LOSS_FALLS = 0.6  # by this factor in each round, until it is the last
_WIDE_ROUNDS = 2  # before the width at the end follows what was measured
_SETTLED = 5e-5  # metres
_SOLVER_STEPS = 8


@dataclass(frozen=True)
class RefinedEnd:
    """Position and axis of an end, and how well the frames agree on them."""

    position: Array  # (3,) metres, hand frame
    axis: Array  # (3,) unit vector, hand frame
    position_covariance: Array  # (3, 3) m^2, of chance alone
    axis_variance: float  # rad^2 in each direction across it, of chance alone
    agreement: float  # share of the frames' stops and middles that fit
    pixels_per_metre: float  # at the end, median over the frames


def refine_end(
    edges: HandEdges,
    cloud: Cloud,
    position: Array,
    axis: Array,
    radius: float,
    params: RefineParams,
    seed: int,
) -> RefinedEnd | None:
    """Put a voted end right, or return None where too few frames agree.

    Where the voted axis leads nowhere, axes about it are tried, and what most frames agree on is
    taken. Once the axis is known, so is whether one thing beside it reaches farther.

    Args:
        position: (3,) metres, hand frame; ``axis``: (3,) unit vector; ``radius``: metres.
        seed: of the resampling.
    """
    found = best_fit(near_edges(edges, cloud, position, params), position, axis, radius, params)
    return None if found is None else resampled(found, params, seed)


def best_fit(
    near: NearEdges, position: Array, axis: Array, radius: float, params: RefineParams
) -> Fit | None:
    """Fit from the voted axis, from others where it leads nowhere, and at a point if it is one."""
    best = fit_end(near, position, axis, radius, params)
    if best is None or best.agreement(params) < params.good_agreement:
        turned = [
            fit_end(near, position, start, radius, params)
            for start in turned_axes(axis, params.start_turn_deg)
        ]
        fits = [fit for fit in (best, *turned) if fit is not None]
        best = max(fits, key=lambda fit: fit.agreement(params), default=None)
    if best is None or best.agreement(params) < params.min_agreement:
        return None
    point = point_of(near, best.position, best.axis, looked_at(radius), params)
    if point is None:
        return best
    at_point = best.position + point
    pointed = fit_end(near, at_point, best.axis, radius, params, params.point_width)
    return best if pointed is None or pointed.agreement(params) < params.min_agreement else pointed


def looked_at(radius: float) -> float:
    """Return how far across the axis edges are looked at, metres."""
    return max(_WIDTH_PER_RADIUS * radius + _WIDTH_MARGIN, _LEAST_WIDTH)


def turned_axes(axis: Array, degrees: float) -> Array:
    """Return (6, 3) unit vectors at an angle to an axis (3,), evenly round it."""
    turns = np.arange(6) * np.pi / 3
    basis = across_axis(axis)
    ring = np.cos(turns)[:, None] * basis[:, 0] + np.sin(turns)[:, None] * basis[:, 1]
    angle = np.radians(degrees)
    return np.asarray(np.cos(angle) * axis + np.sin(angle) * ring)


@dataclass(frozen=True)
class Fit:
    """The equations where the end stays, and their solution."""

    system: System
    unknowns: Array
    loss: float  # metres, scale of the robust loss
    position: Array  # (3,) metres, hand frame
    axis: Array  # (3,) unit vector, hand frame
    pixels_per_metre: float
    radius: float  # metres, the rough one that it began with
    end_width: float  # metres across, that was looked at
    pointed: bool  # whether that is one thing beside others

    frames: int  # that were looked at

    def agreement(self, params: RefineParams) -> float:
        """Return the share of the frames' stops and middles that fit."""
        return float(np.mean(self._told(params) < 2.0))

    def support(self, params: RefineParams) -> float:
        """Return how well they fit, over how many there could be: little shown supports little."""
        close = 1.0 / (1.0 + np.square(self._told(params)))
        return float(close.sum() / (self.frames * (len(SLABS) + 2)))

    def _told(self, params: RefineParams) -> Array:
        """Return the stops' and middles' residuals in units of the robust loss."""
        residuals, _ = residuals_of(self.system, self.unknowns)
        told = np.abs(residuals[self.system.kinds != SIDE])
        return np.asarray(told * self.pixels_per_metre / params.loss_px)


def fit_end(
    near: NearEdges,
    start: Array,
    axis: Array,
    radius: float,
    params: RefineParams,
    end_width: float | None = None,
    steps: int = _SOLVER_STEPS,
    first_round: int = 0,
    widens: bool = True,
) -> Fit | None:
    """Measure and solve until the end stays; None: too few frames, or it went elsewhere.

    Measuring anew may lead away from what was found: the last round is returned that has nearly as
    much support as any.

    Args:
        end_width: across, that is looked at about a pointed end; None: an end as any.
        steps: of the solver in each round.
        first_round: later ones look more closely, from a start that is nearly right.
        widens: whether a pointed end is looked at as far across as what is seen there reaches.
    """
    pixels = near.scale_at(start)
    pointed, width, at = end_width is not None, looked_at(radius), start
    end_width = width if end_width is None else end_width
    thinnest = max(params.end_slab, params.end_slab_px / pixels)
    last_loss = params.loss_px / pixels
    outlines = np.tile([0.8 * radius, 0.0, 0.8 * radius], len(SLABS) + 2)
    fits: list[tuple[float, Fit]] = []
    for index in range(first_round, params.rounds):
        loss = max(_LOSS_FALLS**index * params.first_loss_px / pixels, last_loss)
        last = thinnest if pointed else _FIRST_END_SLAB - _END_SLAB_STEP * index
        slabs = np.array([(-max(last, thinnest), BEYOND_END), *SLABS])
        sight = see(near, at, axis)
        measured = measure(near, sight, slabs, width, end_width, params)
        if np.isfinite(measured.stops).sum() < params.min_frames:
            break
        system = equations(sight, measured, slabs, axis, radius, params)
        unknowns = solve(system, np.concatenate([np.zeros(LINE), outlines]), loss, params, steps)
        step, turn, outlines = unknowns[:3], system.basis @ unknowns[5:LINE], unknowns[LINE:]
        at = at + _at_most(step, _MAX_STEP)
        axis = axis + _at_most(turn, _MAX_TURN)
        axis = axis / np.linalg.norm(axis)
        if widens:
            end_width = _next_width(measured.halves[:, 0], end_width, width, pointed, index, params)
        if loss > last_loss:
            continue
        fit = Fit(
            system, unknowns, loss, at, axis, pixels, radius, end_width, pointed, len(sight.scale)
        )
        if np.linalg.norm(at - start) < params.max_move:
            fits.append((fit.support(params), fit))
        if np.linalg.norm(step) < _SETTLED:
            break
    return first_as_good(fits[::-1])


def first_as_good(fits: Sequence[tuple[float, Fit]]) -> Fit | None:
    """Return the first fit that has nearly the most support, given before each; None: no fits."""
    most = max((support for support, _ in fits), default=0.0)
    return next((fit for support, fit in fits if support >= _AS_GOOD * most), None)


def _next_width(
    halves: Array, now: float, width: float, pointed: bool, index: int, params: RefineParams
) -> float:
    """Return how far across the end's own slab is looked at in the next round, metres."""
    if not np.isfinite(halves).any():
        return now
    if pointed:  # as far as one thing goes: what stands beside a pin is left out
        return min(width, max(float(np.nanmedian(halves)) + _END_MARGIN, params.point_width))
    if index < _WIDE_ROUNDS:
        return now
    return min(width, 2.0 * float(np.nanquantile(halves, 0.9)) + _END_MARGIN)


def _at_most(vector: Array, length: float) -> Array:
    return vector * min(1.0, length / max(float(np.linalg.norm(vector)), 1e-12))


def resampled(fit: Fit, params: RefineParams, seed: int) -> RefinedEnd:
    """Resample the frames (bootstrap) for the uncertainty."""
    system, unknowns = fit.system, fit.unknowns
    rng = np.random.default_rng(seed)
    frames = int(system.frames.max()) + 1
    samples = np.empty((params.resamplings, LINE))
    for row in samples:
        drawn = np.bincount(rng.integers(0, frames, frames), minlength=frames).astype(float)
        row[:] = (solve(system, unknowns, fit.loss, params, 2, drawn) - unknowns)[:LINE]
    return RefinedEnd(
        fit.position,
        fit.axis,
        samples[:, :3].T @ samples[:, :3] / len(samples),
        float(np.square(samples[:, 5:]).mean()),
        fit.agreement(params),
        fit.pixels_per_metre,
    )
