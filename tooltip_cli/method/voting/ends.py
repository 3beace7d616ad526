"""All ends that the tool may have, each put right by what the images show of it.

Rough ends come from the voted voxels and from the visual hull, which err in different ways: votes
are smeared along rays and miss what has no edges; the hull bulges where no image looks along its
side. So the hull is trusted where votes confirm it, and several starts are tried.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tooltip_cli.method.types import Array, Candidate
from tooltip_cli.method.voting.end import (
    Shape,
    ToolEnd,
    far_voxels,
    grip_of,
    locate_end,
    locate_far_side,
    locate_hull_end,
    may_be_meant,
    tool_shape,
)
from tooltip_cli.method.voting.hull import visual_hull
from tooltip_cli.method.voting.outline import fit_outlines
from tooltip_cli.method.voting.params import (
    EndParams,
    RefineParams,
    TrustParams,
    VotingSettings,
)
from tooltip_cli.method.voting.refine import Fit, RefinedEnd, refine_end, resampled
from tooltip_cli.method.voting.sight import NearEdges, near_edges, near_outlines
from tooltip_cli.method.voting.volume import Cloud, HandEdges, reconstruct


@dataclass(frozen=True)
class FoundEnd:
    """One end of the tool, and how far to trust it."""

    candidate: Candidate
    agreement: float  # share of what the images show of it that fits; 0: too few images do
    radius: float  # metres, roughly
    by_grip: bool = False  # whether only its distance from the grip makes it an end
    by_outlines: bool = False  # whether silhouettes say where it is, rather than moving edges


@dataclass(frozen=True)
class _Rough:
    """Where an end may be."""

    far: Array  # (3,) metres, hand frame: the voxel of it that is farthest from wrist or grip
    voted: ToolEnd | None
    solid: tuple[ToolEnd, ...]  # as the hull has it
    by_grip: bool = False  # whether it is the farthest from the grip alone


def find_ends(
    edges: HandEdges, cloud: Cloud, shape: Shape, spheres: Array, settings: VotingSettings
) -> list[FoundEnd]:
    """Return the tool's ends, the farthest from the wrist first; at least one.

    Others are there if they `may_be_meant`. Where a direction says which end is, ends that are
    nearer to wrist and grip are looked at besides.

    Args:
        shape: where the votes say that hand or tool is; not empty.
        spheres: (S, 4) centre and radius of hand and wrist, metres.
    """
    end = settings.end
    if settings.prefer is not None:
        end = replace(
            end,
            far_share=end.wanted_share,
            other_end_support=end.wanted_support,
            other_end_share=end.wanted_share**2,
        )
    ends = _put_right(edges, cloud, shape, spheres, replace(settings, end=end))
    return _apart(ends, shape, grip_of(spheres), end)


def _put_right(
    edges: HandEdges, cloud: Cloud, shape: Shape, spheres: Array, settings: VotingSettings
) -> list[FoundEnd]:
    """Return all rough ends as the images show them."""
    ends: list[FoundEnd] = []
    for rough in _rough_ends(edges, cloud, shape, spheres, settings):
        end = _by_outlines(edges, rough, spheres, settings)
        if rough.voted is not None and (
            end is None or end.agreement < settings.outline.min_agreement
        ):
            by_edges = _by_edges(edges, cloud, rough.far, rough.voted, spheres, settings)
            end = by_edges if end is None or by_edges.agreement > end.agreement else end
        if end is not None:
            ends.append(replace(end, by_grip=rough.by_grip))
    return ends


def _apart(ends: list[FoundEnd], shape: Shape, grip: Array, params: EndParams) -> list[FoundEnd]:
    """Return ends that differ, the farthest first; of those at one place the best.

    One that far fewer images show, or agree on, than on another is no end that could be meant.
    """
    kept: list[FoundEnd] = []
    for end in sorted(ends, key=lambda item: (item.by_grip, -item.agreement)):
        apart = [end.candidate.position - other.candidate.position for other in kept]
        if all(np.linalg.norm(away) > 0.5 * params.end_separation for away in apart):
            kept.append(end)
    share = params.other_end_support
    best = [end for end in kept if not end.by_grip] or kept
    agreement = share * max(end.agreement for end in best)
    # votes alone may support what the images do not show: it is no measure of the others
    support = share * max(it.candidate.support for it in best if it.agreement >= agreement)
    kept = [
        end for end in kept if end.agreement >= agreement and end.candidate.support >= support
    ] or kept[:1]
    kept.sort(key=lambda end: (end.by_grip, -float(np.linalg.norm(end.candidate.position))))
    first, *others = kept
    place = (first.candidate.position, first.candidate.axis)
    return [
        first,
        *(
            end
            for end in others
            if may_be_meant(
                shape, place, (end.candidate.position, end.candidate.axis), grip, params
            )
        ),
    ]


def _rough_ends(
    edges: HandEdges, cloud: Cloud, shape: Shape, spheres: Array, settings: VotingSettings
) -> list[_Rough]:
    params, same, grip = settings.end, settings.outline.same_end, grip_of(spheres)
    votes = [
        (shape.voxels[far], locate_end(cloud, shape, shape.voxels[far], spheres, params), by_grip)
        for far, by_grip in _both_ways(shape, grip, settings)
    ]
    silhouettes = edges.silhouettes
    rough: list[_Rough] = []
    if silhouettes is not None:
        hull = visual_hull(silhouettes, spheres, edges.reach, settings.hull)
        sure, likely = _confirmed(hull, shape, settings.hull.confirmed, settings.hull.likely)
        beyond = [(hull, hull.voxels[row], 0.0) for row, _ in _both_ways(hull, grip, settings)]
        # as far out, what shows no edges, as a pale cap in noise; nearer it is what is sure
        beyond += [
            (likely, likely.voxels[row], settings.hull.likely / 2)
            for row, _ in _both_ways(likely, grip, settings)
        ]
        for row, by_grip in _both_ways(sure, grip, settings):
            far = sure.voxels[row]
            near = [end for at, end, _ in votes if np.linalg.norm(at - far) < same]
            solid = [
                locate_hull_end(sure, far, spheres, params),
                *(
                    locate_far_side(sure, far, spheres, replace(params, middle_slab=slab))
                    for slab in (params.middle_slab, params.slanted_slab)
                ),
            ]
            solid += [
                locate_hull_end(it, at, spheres, params)
                for it, at, least in beyond
                if least <= np.linalg.norm(at - far) < same
            ]
            rough.append(_Rough(far, near[0] if near else None, tuple(solid), by_grip))
    for far, end, by_grip in votes:
        if all(np.linalg.norm(far - other.far) >= same for other in rough):
            rough.append(_Rough(far, end, (), by_grip))
    return rough


def _both_ways(shape: Shape, grip: Array, settings: VotingSettings) -> list[tuple[int, bool]]:
    """Return voxels that are far from the wrist, and others that may be meant as well.

    Returns:
        rows, and whether each is far from the grip alone.
    """
    end = settings.end
    rows = [(int(row), False) for row in far_voxels(shape, end)]
    either_way = replace(end, far_share=min(end.far_share, end.opposite_share))
    for row in far_voxels(shape, either_way, grip):
        places = shape.voxels[[at for at, _ in rows]]
        apart = np.linalg.norm(places - shape.voxels[row], axis=1) >= settings.outline.same_end
        first, other = (places[0], None), (shape.voxels[row], None)
        if apart.all() and may_be_meant(shape, first, other, grip, end):
            rows.append((int(row), True))
    return rows


def _confirmed(hull: Shape, shape: Shape, *within: float) -> list[Shape]:
    """Return the hull's voxels that have a voted one nearer than each distance, metres."""
    from scipy.spatial import KDTree

    if not len(hull.voxels):
        return [hull for _ in within]
    distances, _ = KDTree(shape.voxels).query(hull.voxels, distance_upper_bound=max(within))
    near = [distances < limit for limit in within]
    return [Shape(hull.voxels[rows], hull.counts[rows]) for rows in near]


@dataclass(frozen=True)
class ClosePart:
    """An end of the tool, roughly, with all edges about it."""

    near: NearEdges
    position: Array  # (3,) metres, hand frame
    axis: Array  # (3,) unit vector, hand frame
    radius: float  # metres


def close_part(
    edges: HandEdges, cloud: Cloud, end: FoundEnd, params: RefineParams
) -> ClosePart | None:
    """Return an end with what it was found from; None: it has no axis."""
    position, axis = end.candidate.position, end.candidate.axis
    if axis is None:
        return None
    if end.by_outlines and edges.silhouettes is not None:
        near = near_outlines(edges.silhouettes, position, params)
    else:
        near = near_edges(edges, cloud, position, params)
    return ClosePart(near, position, axis, end.radius)


def first_end(edges: HandEdges, spheres: Array, settings: VotingSettings) -> ClosePart | None:
    """Return the first end as well as it can be told with wrong clocks or cameras; None: none.

    Args:
        spheres: (S, 4) centre and radius of hand and wrist, metres.
    """
    cloud = reconstruct(edges, settings.voting)
    shape = tool_shape(cloud, spheres, edges.reach, settings.end)
    if not len(shape.voxels):
        return None
    rough, *others = _rough_ends(edges, cloud, shape, spheres, settings)
    refine = settings.refine
    # with such a loss many ends explain the images as well: the best is taken
    alone = replace(settings, outline=replace(settings.outline, as_good=1.0))
    found = _outline_fit(
        edges, rough, spheres, alone, replace(refine, loss_px=refine.first_loss_px)
    )
    if found is not None and edges.silhouettes is not None:
        fit, _ = found
        near = near_outlines(edges.silhouettes, fit.position, refine)
        return ClosePart(near, fit.position, fit.axis, fit.radius)
    voted = next((item.voted for item in (rough, *others) if item.voted is not None), None)
    if voted is None:
        return None
    near = near_edges(edges, cloud, voted.position, refine)
    return ClosePart(near, voted.position, voted.axis, voted.radius)


def _outline_fit(
    edges: HandEdges,
    rough: _Rough,
    spheres: Array,
    settings: VotingSettings,
    refine: RefineParams,
) -> tuple[Fit, float] | None:
    """Return what the outlines say of an end, and how far others lie; see `fit_outlines`.

    None: there are no silhouettes, or they say nothing.
    """
    if edges.silhouettes is None:
        return None
    starts = [*rough.solid, *([] if rough.voted is None else [rough.voted])]
    found = fit_outlines(edges.silhouettes, starts, grip_of(spheres), refine, settings.outline)
    return None if found is None or found[0].agreement(refine) < refine.min_agreement else found


def _by_outlines(
    edges: HandEdges, rough: _Rough, spheres: Array, settings: VotingSettings
) -> FoundEnd | None:
    """Put an end right by the silhouettes' outlines; None: there are none, or too few agree."""
    found = _outline_fit(edges, rough, spheres, settings, settings.refine)
    if found is None:
        return None
    fit, doubt = found
    refined = resampled(fit, settings.refine, settings.trust.seed)
    covariance = refined.position_covariance + doubt * np.eye(3)
    refined = replace(refined, position_covariance=covariance)
    end = _refined(refined, fit.radius, fit.support(settings.refine), settings)
    return replace(end, by_outlines=True)


def _by_edges(
    edges: HandEdges,
    cloud: Cloud,
    far: Array,
    end: ToolEnd,
    spheres: Array,
    settings: VotingSettings,
) -> FoundEnd:
    """Put a voted end right by the moving edges of all images, where they agree."""
    refined = refine_end(
        edges, cloud, end.position, end.axis, end.radius, settings.refine, settings.trust.seed
    )
    if refined is None:
        covariance = _voted_covariance(cloud, end, far, spheres, edges.reach, settings)
        candidate = Candidate(end.position, end.support, covariance, end.axis)
        return FoundEnd(candidate, 0.0, end.radius)
    return _refined(refined, end.radius, end.support, settings)


def _refined(end: RefinedEnd, radius: float, support: float, settings: VotingSettings) -> FoundEnd:
    covariance, axis_variance = _uncertainty(end, settings.trust)
    candidate = Candidate(
        end.position, support, covariance, end.axis, axis_variance**0.5, end.agreement
    )
    return FoundEnd(candidate, end.agreement, radius)


def _uncertainty(end: RefinedEnd, trust: TrustParams) -> tuple[Array, float]:
    """Return (3, 3) m^2 and rad^2: chance, and a floor for what all frames have in common.

    Calibration, motion blur and a shape that is not quite what the equations say are in every
    frame. The last shows: fewer frames agree.
    """
    floor = max(trust.floor, trust.floor_px / end.pixels_per_metre)
    doubt = 1.0 + trust.disagreement * max(trust.full_agreement - end.agreement, 0.0)
    covariance: Array = end.position_covariance + (floor * doubt) ** 2 * np.eye(3)
    return covariance, end.axis_variance + np.radians(trust.axis_floor_deg * doubt) ** 2


def _voted_covariance(
    cloud: Cloud,
    end: ToolEnd,
    far: Array,
    spheres: Array,
    reach: float,
    settings: VotingSettings,
) -> Array:
    """Return (3, 3) m^2: the scatter over random halves of the frames, and a floor.

    The end found from half the frames differs from that of all by as much as that of all differs
    from the truth, as far as chance goes. What frames have in common (calibration, the shape of
    the end, the voxels) is the floor.
    """
    trust = settings.trust
    rng = np.random.default_rng(trust.seed)
    deviations = []
    for _ in range(trust.halves):
        half = rng.permutation(cloud.frame_count)[: cloud.frame_count // 2]
        kept = np.isin(cloud.frames, half)
        part = replace(cloud, points=cloud.points[kept], frames=cloud.frames[kept])
        found = _end_near(part, far, spheres, reach, settings.end)
        if found is not None:
            deviations.append(found - end.position)
    floor = (trust.voted_floor + trust.voted_floor_per_radius * end.radius) ** 2 * np.eye(3)
    if not deviations:
        return floor
    scatter = np.array(deviations)
    covariance: Array = scatter.T @ scatter / len(scatter) + floor
    return covariance


def _end_near(
    cloud: Cloud, far: Array, spheres: Array, reach: float, params: EndParams
) -> Array | None:
    """Return the (3,) end of a thinner cloud on the same side of the tool; None: not there."""
    shape = tool_shape(cloud, spheres, reach, params)
    near = np.linalg.norm(shape.voxels - far, axis=1) < params.end_separation
    if not near.any():
        return None
    voxels = shape.voxels[near]
    start = voxels[int(np.argmin(np.linalg.norm(voxels - far, axis=1)))]
    return locate_end(cloud, shape, start, spheres, params).position
