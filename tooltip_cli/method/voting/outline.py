"""An end put right by the outlines of silhouettes: many starts, and the one that explains most.

The equations are those of ``refine.py``. An outline has no edges inside it and hardly any gaps, so
more images agree, and a start may be far off: all starts are tried on some of the images, and the
best of them on all.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tooltip_cli.method.types import Array
from tooltip_cli.method.voting.end import ToolEnd
from tooltip_cli.method.voting.hull import missing
from tooltip_cli.method.voting.params import OutlineParams, RefineParams
from tooltip_cli.method.voting.refine import Fit, first_as_good, fit_end, looked_at, turned_axes
from tooltip_cli.method.voting.sight import NearEdges, near_outlines, point_of
from tooltip_cli.method.voting.silhouette import HandSilhouettes

_STEPS_AT_FIRST, _STEPS = 2, 8  # of the solver in each round
_UNLIKE_WIDTH = 0.3  # of the logarithm of the radius
_CLOSE = 4  # the first round that looks as closely as the last


@dataclass(frozen=True)
class _Start:
    position: Array  # (3,) metres, hand frame
    axis: Array  # (3,) unit vector
    radius: float  # metres


def fit_outlines(
    silhouettes: HandSilhouettes,
    ends: Sequence[ToolEnd],
    grip: Array,
    refine: RefineParams,
    params: OutlineParams,
) -> Fit | None:
    """Return the end that explains most of what the outlines show about some rough ends.

    Args:
        ends: rough ends, within a few centimetres of one another.
        grip: (3,) metres, hand frame; the tool leads away from it.
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
    tried = _fits(near.thinned(every), _starts(ends, grip, refine, params), few, _STEPS_AT_FIRST)
    fits = _fits(near, _unlike(tried, params), refine, first_round=_CLOSE)
    if not fits:
        return None
    widest = max(start.radius for start, _ in fits)
    return _at_point(silhouettes, near, fits[0][1], widest, refine, params)


def _starts(
    ends: Sequence[ToolEnd], grip: Array, refine: RefineParams, params: OutlineParams
) -> list[_Start]:
    starts = []
    for end in ends:
        outwards = end.position - grip
        axes = [
            end.axis,
            *turned_axes(end.axis, refine.start_turn_deg),
            outwards / max(float(np.linalg.norm(outwards)), 1e-9),
        ]
        starts += [
            _Start(end.position, axis, factor * end.radius)
            for factor in params.radius_factors
            for axis in axes
        ]
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
