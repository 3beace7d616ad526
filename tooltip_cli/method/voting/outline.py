"""An end put right by the outlines of silhouettes: many starts, and the one that explains most.

The equations are those of ``equations.py``. An outline has no edges inside it and hardly any gaps,
so more images agree, and a start may be far off: all starts are tried on some of the images, and
the best of them on all.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tooltip_cli.method.types import Array
from tooltip_cli.method.voting.end import ToolEnd, unit_vector
from tooltip_cli.method.voting.hull import missing
from tooltip_cli.method.voting.params import OutlineParams, RefineParams
from tooltip_cli.method.voting.refine import Fit, first_as_good, fit_end, looked_at, turned_axes
from tooltip_cli.method.voting.sight import NearEdges, near_outlines, point_of
from tooltip_cli.method.voting.silhouette import HandSilhouettes

_STEPS_AT_FIRST, _STEPS = 2, 8  # of the solver in each round
_NEXT_TO, _PARALLEL, _AS_WIDE = 0.002, 0.99, 0.1  # of starts: metres, cosine, logarithm of width
_OUTWARDS = 0.978  # cosine: within 12 degrees of the way from the grip
_UNLIKE_WIDTH = 0.3  # of the logarithm of the radius
_CLOSE = 4  # the first round that looks as closely as the last


@dataclass(frozen=True)
class _Start:
    position: Array  # (3,) metres, hand frame
    axis: Array  # (3,) unit vector
    radius: float  # metres

    def resembles(self, other: _Start) -> bool:
        """Return whether the fit from there is the same, as far as can be foreseen."""
        return bool(
            np.linalg.norm(self.position - other.position) < _NEXT_TO
            and self.axis @ other.axis > _PARALLEL
            and abs(np.log(self.radius / other.radius)) < _AS_WIDE
        )


def fit_outlines(
    silhouettes: HandSilhouettes,
    ends: Sequence[ToolEnd],
    grip: Array,
    refine: RefineParams,
    params: OutlineParams,
) -> tuple[Fit, float] | None:
    """Return the end that explains most of what the outlines show about some rough ends.

    Args:
        ends: rough ends, within a few centimetres of one another.
        grip: (3,) metres, hand frame; the tool leads away from it.

    Returns:
        the end, and the variance along each axis, m^2, of others that explain nearly as much; None:
        there are too few outlines.
    """
    refine = replace(refine, max_move=params.max_move, point_share=params.point_share)
    centre = np.mean([end.position for end in ends], axis=0)
    near = near_outlines(silhouettes, centre, refine)
    every = max(1, len(near.camera_from_hand) // params.frames_at_first)
    few = replace(
        refine,
        rounds=params.rounds_at_first,
        min_frames=max(refine.min_frames // every, params.least_frames),
    )
    starts = _starts(ends, grip, refine, params)
    tried = _fits(near.thinned(every), starts, few, _STEPS_AT_FIRST)
    rough = _as_good(tried, grip, refine, params)
    fits = _fits(near, _unlike([*rough[:1], *tried], params), refine, first_round=_CLOSE)
    if not fits:
        return None
    widest = max(start.radius for start, _ in fits)
    good = _as_good(fits, grip, refine, params)
    best = good[0][1]
    doubt = max(_scatter(best, some, grip) for some in (rough, good))
    return _at_point(silhouettes, near, best, widest, refine, params), doubt


def _starts(
    ends: Sequence[ToolEnd], grip: Array, refine: RefineParams, params: OutlineParams
) -> list[_Start]:
    starts: list[_Start] = []
    for end in ends:
        axes = [
            end.axis,
            *turned_axes(end.axis, refine.start_turn_deg),
            unit_vector(end.position - grip),
        ]
        factors = [it for it in params.radius_factors if it >= 1 or not end.wide]
        for factor in factors:
            for axis in axes:
                start = _Start(end.position, axis, factor * end.radius)
                if not any(start.resembles(other) for other in starts):
                    starts.append(start)
    return starts


def _fits(
    near: NearEdges,
    starts: Iterable[_Start],
    refine: RefineParams,
    steps: int = _STEPS,
    first_round: int = 0,
) -> list[tuple[_Start, Fit]]:
    """Return the fits from all starts that lead somewhere, the one with most support first."""
    fits = [
        (
            start,
            fit_end(
                near,
                start.position,
                start.axis,
                start.radius,
                refine,
                steps=steps,
                first_round=first_round,
            ),
        )
        for start in starts
    ]
    found = [(start, fit) for start, fit in fits if fit is not None]
    return sorted(found, key=lambda item: -item[1].support(refine))


def _as_good(
    fits: Sequence[tuple[_Start, Fit]], grip: Array, refine: RefineParams, params: OutlineParams
) -> list[tuple[_Start, Fit]]:
    """Return those that explain nearly as much as the first, whose axis leads outwards first.

    A ball looks the same about any axis, and the side of a jaw stops as sharply as its end. Of axes
    that lead nearly outwards none is better than another.
    """
    if not fits:
        return []
    support = params.as_good * fits[0][1].support(refine)
    agreement = params.as_good * fits[0][1].agreement(refine)
    good = [
        item
        for item in fits
        if item[1].support(refine) >= support and item[1].agreement(refine) >= agreement
    ]
    return sorted(good, key=lambda item: -min(_outwards(item[1], grip), _OUTWARDS))


def _scatter(best: Fit, fits: Sequence[tuple[_Start, Fit]], grip: Array) -> float:
    """Return the mean variance along each axis, m^2, of fits about the best one.

    What leads back to the grip is no end, and does not count.
    """
    squares = [
        float(np.sum(np.square(fit.position - best.position)))
        for _, fit in fits
        if _outwards(fit, grip) > 0
    ]
    return float(np.mean(squares)) / 3 if squares else 0.0


def _outwards(fit: Fit, grip: Array) -> float:
    """Return the cosine of the angle between the end's axis and the way to it from the grip."""
    return float(unit_vector(fit.position - grip) @ fit.axis)


def _unlike(tried: Sequence[tuple[_Start, Fit]], params: OutlineParams) -> list[_Start]:
    """Return the first fits of each kind, to go on from: place, or how widely it was looked at."""
    kept: list[_Start] = []
    for start, fit in tried:
        if all(
            np.linalg.norm(fit.position - other.position) > params.same_place
            or abs(np.log(start.radius / other.radius)) > _UNLIKE_WIDTH
            for other in kept
        ):
            kept.append(_Start(fit.position, fit.axis, start.radius))
    return kept[: params.starts_kept]


def _at_point(
    silhouettes: HandSilhouettes,
    near: NearEdges,
    fit: Fit,
    radius: float,
    refine: RefineParams,
    params: OutlineParams,
) -> Fit:
    """Go to the one thing that reaches farthest, if it stands alone: a plug's longest pin.

    A flat end's corner reaches farthest as well, but the background does not show beside it. How
    thick the thing is is not known: looked at too widely its neighbours draw the end towards them,
    too narrowly it shows no sides, so the narrowest width with nearly the most support is taken.
    """
    step = point_of(near, fit.position, fit.axis, looked_at(radius), refine)
    if step is None:
        return fit
    at = fit.position + step
    tried = [
        fit_end(near, at, fit.axis, radius, refine, width, widens=False)
        for width in params.point_widths
    ]
    pointed = first_as_good([(item.support(refine), item) for item in tried if item is not None])
    if pointed is None or pointed.agreement(refine) < refine.min_agreement:
        return fit
    aside = fit.position - pointed.position
    aside = aside - (aside @ fit.axis) * fit.axis  # at a corner the other axis leads outwards
    if np.linalg.norm(aside) < params.same_place:
        return fit
    behind = pointed.position - params.beside_depth * fit.axis
    beside = missing(silhouettes, behind + np.outer([0.5, 1.0], aside))
    return pointed if beside.max() > params.min_missing_beside else fit
