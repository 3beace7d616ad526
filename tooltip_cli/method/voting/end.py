"""The far end of what appears in the volume, and the tool's axis there.

The farthest voxel from the wrist lies on the rim of a blunt end, so it only says where the end is.
The axis is the direction in which the end is slender: the last three and the last five centimetres
scatter least across it, and the tool stops sharply along it. The tip is the middle of the end
across the axis, and the place where the density of points stops along it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import erf

import numpy as np

from tooltip_cli.method.rays import plausible
from tooltip_cli.method.types import Array, Indices
from tooltip_cli.method.voting.params import EndParams
from tooltip_cli.method.voting.volume import Cloud, agreed_points, count_frames

_BIN = 0.001  # metres, of the density along the axis
_BLURS = (1.5, 2.0, 2.5, 3.0)  # bins, standard deviations tried for how blurred the end is
_NO_SCORE = np.inf
_BESIDE = 27  # voxels about one, itself among them
_OPPOSITE = -0.7  # cosine: within 45 degrees of straight through the hand
_SOLID_VOXELS = 2000  # of a solid, whose axis is looked for
_FAR_SIDE_ROUNDS = 3  # of finding its middle and the axis through it
_LEAST_RADIUS = 0.001  # metres, of an end
_MARGIN = 4  # voxels around the points, so that smoothing does not meet the box


@dataclass(frozen=True)
class Shape:
    """Where enough frames agree that hand or tool is, outside the hand's spheres."""

    voxels: Array  # (V, 3) centres, metres, hand frame
    counts: Array  # (V,) frames, smoothed over neighbours


@dataclass(frozen=True)
class ToolEnd:
    """One end of the tool."""

    position: Array  # (3,) metres, hand frame
    axis: Array  # (3,) unit vector, hand frame, out of the tool's end
    radius: float  # metres, root mean square distance of its last 3 cm from the axis
    support: float  # frames that show the end's densest voxel over all chosen frames
    wide: bool = False  # whether it is the middle of all that is there, not of what is slender


def tool_shape(cloud: Cloud, spheres: Array, reach: float, params: EndParams) -> Shape:
    """Return the voxels outside the hand that enough frames agree on.

    "Enough" is a share of what the clearest voxels of the tool have; specks are left out.

    Args:
        spheres: (S, 4) centre and radius of hand and wrist, metres.
    """
    from scipy import ndimage

    inside = np.linalg.norm(cloud.points, axis=1) < reach
    points, frames = cloud.points[inside], cloud.frames[inside]
    if not len(points):
        return Shape(np.zeros((0, 3)), np.zeros(0))
    corner = (np.floor(points.min(axis=0) / params.voxel) - _MARGIN) * params.voxel
    size = np.ceil((points.max(axis=0) - corner) / params.voxel).astype(int) + _MARGIN
    counts = count_frames(points, frames, corner, params.voxel, tuple(size))
    # scaled so that a voxel at the middle of a line of points keeps its own count
    smooth = ndimage.gaussian_filter(counts, 1.0) * (2 * np.pi)
    index = np.argwhere(smooth > params.min_frames)
    voxels, values = corner + index * params.voxel, smooth[tuple(index.T)].astype(float)
    outside = plausible(voxels, spheres, np.inf)
    if not outside.any():
        return Shape(np.zeros((0, 3)), np.zeros(0))
    clear = np.quantile(values[outside], 0.95)
    kept = values > max(params.min_frames, params.min_share * clear)
    occupied = np.zeros(smooth.shape, dtype=bool)
    occupied[tuple(index[kept].T)] = True
    parts, count = ndimage.label(ndimage.binary_dilation(occupied, iterations=2))
    part = parts[tuple(index.T)]
    sizes = np.bincount(part[kept & outside], minlength=count + 1)
    kept &= outside & (sizes[part] >= params.min_voxels)
    return Shape(voxels[kept], values[kept])


def grip_of(spheres: Array) -> Array:
    """Return (3,) the middle of the hand's spheres (S, 4), else the hand's origin."""
    if not len(spheres):
        return np.zeros(3)
    return np.asarray(np.average(spheres[:, :3], axis=0, weights=spheres[:, 3] ** 3))


def far_voxels(shape: Shape, params: EndParams, grip: Array | None = None) -> Indices:
    """Return voxels that are farthest from the grip in their surroundings, farthest first.

    Args:
        grip: (3,) metres, hand frame; default: the hand's origin.
    """
    if not len(shape.voxels):
        return np.zeros(0, dtype=np.intp)
    from scipy.spatial import KDTree

    distances = np.linalg.norm(shape.voxels - (0.0 if grip is None else grip), axis=1)
    order = np.argsort(-distances, kind="stable")
    order = order[distances[order] >= params.far_share * distances.max()]
    # most have a farther one right beside them, which is soon seen
    beside = min(len(shape.voxels), _BESIDE)
    _, neighbours = KDTree(shape.voxels).query(
        shape.voxels[order], k=beside, distance_upper_bound=params.end_separation
    )
    beside_distances = np.append(distances, 0.0)[neighbours.reshape(len(order), beside)]
    ends: list[int] = []
    for candidate in order[beside_distances.max(axis=1) <= distances[order]]:
        apart = np.linalg.norm(shape.voxels - shape.voxels[candidate], axis=1)
        near = apart < params.end_separation
        # voxels of one end may be equally far: the first stands for it
        if distances[near].max() <= distances[candidate] and not near[ends].any():
            ends.append(int(candidate))
    return np.array(ends, dtype=np.intp)


Place = tuple[Array, Array | None]
"""Position, metres, and axis of an end, (3,), hand frame; None: straight out from the grip."""


def may_be_meant(
    shape: Shape,
    first: Place,
    other: Place,
    grip: Array,
    params: EndParams,
) -> bool:
    """Return whether another end than the first may be the tool's tip as well.

    It may if it is as far out, by wrist and grip together: a tool that is held tilted towards the
    wrist has its handle's end farther from that than its tip. So may what is thicker, on the other
    side of the hand: there is no telling a cord with a plug from a handle with a shaft.

    Args:
        first: the end farthest from the wrist.
        other: another one.
        grip: (3,) metres, hand frame.
    """
    here, there = first[0] - grip, other[0] - grip
    from_wrist = float(np.linalg.norm(other[0]) / np.linalg.norm(first[0]))
    from_grip = float(np.linalg.norm(there) / np.linalg.norm(here))
    if from_wrist * from_grip >= params.other_end_share:
        return True
    opposite = float(unit_vector(there) @ unit_vector(here)) < _OPPOSITE
    if not opposite or from_grip < params.opposite_share:
        return False
    thickness, thickness_there = (
        _thickness(shape, end, unit_vector(end - grip) if axis is None else axis, params)
        for end, axis in (first, other)
    )
    return 0 < params.thicker * thickness <= thickness_there


def _thickness(shape: Shape, end: Array, axis: Array, params: EndParams) -> float:
    """Return how far what is near an end scatters across its axis, metres, root mean square."""
    near = shape.voxels[np.linalg.norm(shape.voxels - end, axis=1) < params.end_separation]
    if len(near) < params.min_voxels:
        return 0.0
    scatter = np.cov(near.T)
    return float(np.sqrt(np.trace(scatter) - axis @ scatter @ axis))


def locate_end(
    cloud: Cloud, shape: Shape, far: Array, spheres: Array, params: EndParams
) -> ToolEnd:
    """Find axis and middle of the end that ``far`` (3,), metres, lies on."""
    outwards = unit_vector(far - grip_of(spheres))
    near = shape.voxels[np.linalg.norm(shape.voxels - far, axis=1) < params.neighbourhood] - far
    axis = _slender_axis(near, _cone(outwards, params.cone_deg), outwards, params)
    axis = _slender_axis(near, _cone(axis, params.refine_deg), outwards, params)
    middle = far + _middle(near, axis, params.slab_radius, params)
    radius = _radius(near, axis, params)
    close = np.linalg.norm(cloud.points - middle, axis=1) < params.neighbourhood
    surface, _ = agreed_points(
        cloud.points[close], cloud.frames[close], params.surface_voxel, params.surface_frames
    )
    axis = _sharp_axis(surface - middle, near, axis, radius, params)
    width = max(1.8 * radius, 0.5 * params.slab_radius)
    middle = middle + _middle(shape.voxels - middle, axis, width, params)
    position = middle + axis * end_along(cloud, middle, axis, radius)
    around = np.linalg.norm(shape.voxels - position, axis=1) < 2 * radius
    frames = np.quantile(shape.counts[around], 0.9) if around.any() else 0.0
    return ToolEnd(position, axis, radius, float(min(frames / cloud.frame_count, 1.0)))


def locate_hull_end(shape: Shape, far: Array, spheres: Array, params: EndParams) -> ToolEnd:
    """Find axis and middle of the end of a solid that ``far`` (3,), metres, lies on, roughly."""
    outwards = unit_vector(far - grip_of(spheres))
    near = shape.voxels[np.linalg.norm(shape.voxels - far, axis=1) < params.neighbourhood] - far
    few = near[:: max(1, len(near) // _SOLID_VOXELS)]
    axis = _slender_axis(few, _cone(outwards, params.cone_deg), outwards, params)
    axis = _slender_axis(few, _cone(axis, params.refine_deg), outwards, params)
    middle = far + _middle(near, axis, params.slab_radius, params)
    radius = _radius(few, axis, params)
    along, across = _along_axis(shape.voxels - middle, axis)
    core = across <= max(radius, 1.5 * params.voxel) ** 2
    top = float(np.quantile(along[core], 0.98)) if core.any() else 0.0
    return ToolEnd(middle + axis * (top - 0.5 * params.voxel), axis, radius, 0.0)


def locate_far_side(shape: Shape, far: Array, spheres: Array, params: EndParams) -> ToolEnd:
    """Find the middle of all that a solid shows farthest from the grip, about ``far`` (3,), metres.

    The far voxel of a wide edge is its corner, from which the end as found by what is slender may
    be centimetres off: here the axis is taken to lead away from the grip.
    """
    grip = grip_of(spheres)
    near = shape.voxels[np.linalg.norm(shape.voxels - far, axis=1) < params.neighbourhood]
    position = far
    for _ in range(_FAR_SIDE_ROUNDS):
        axis = unit_vector(position - grip)
        position = position + _middle(near - position, axis, params.wide, params)
    axis = unit_vector(position - grip)
    along, across = _along_axis(near - position, axis)
    inside = across < params.wide**2
    top = float(np.quantile(along[inside], 0.98)) if inside.any() else 0.0
    last = inside & (along > top - params.middle_slab)
    radius = float(np.sqrt(across[last].mean())) if last.any() else 0.0
    position = position + axis * (top - 0.5 * params.voxel)
    return ToolEnd(position, axis, max(radius, _LEAST_RADIUS), 0.0, wide=True)


@dataclass(frozen=True)
class _Slab:
    """The last stretch of the tool along each of several directions."""

    rms: Array  # (D,) scatter across the direction, metres
    ends: Array  # (D,) where the tool stops along the direction, metres from the far voxel
    spans: Array  # (D,) length of what is in the slab, metres
    counts: Array  # (D,) voxels


def _scatter(points: Array, directions: Array, length: float, radius: float) -> _Slab:
    """Measure how slender the end is: (V, 3) points about the far voxel, (3, D) directions."""
    along = points @ directions
    squared = np.square(points).sum(axis=1)
    across = squared[:, None] - along * along
    ends = np.where(across < 0.045**2, along, -1.0).max(axis=0)
    inside = (across < radius * radius) & (along > ends - length) & (along < ends + 0.004)
    counts = inside.sum(axis=0)
    some = np.maximum(counts, 1)
    means = (inside.T @ points) / some[:, None]
    total = (inside.T @ squared) / some - np.square(means).sum(axis=1)
    first = (along * inside).sum(axis=0) / some
    second = (along * along * inside).sum(axis=0) / some
    variance = np.maximum(total - (second - first * first), 0.0)
    spans = ends - np.where(inside, along, np.inf).min(axis=0)
    return _Slab(np.sqrt(variance), ends, spans, counts)


def _radius(near: Array, axis: Array, params: EndParams) -> float:
    """Return how far the last stretch scatters from the axis, metres; not 0 for lone voxels."""
    rms = _scatter(near, axis[:, None], params.short_slab, params.wide).rms[0]
    return max(float(rms), _LEAST_RADIUS)


def _slender_axis(near: Array, directions: Array, outwards: Array, params: EndParams) -> Array:
    """Return the direction across which the end scatters least, if need be the one given first."""
    short = _scatter(near, directions, params.short_slab, params.wide)
    long = _scatter(near, directions, params.long_slab, params.slab_radius)
    # a slab that the hand cuts short says less about the direction: count it as wider
    stretch = params.long_slab / np.clip(long.spans, 0.02, None)
    score = (short.rms + long.rms * stretch) * (
        1 + params.outwards_weight * (1 - outwards @ directions)
    )
    fits = (short.ends <= params.far_tolerance) & (long.counts >= params.min_voxels)
    score = np.where(fits, score, _NO_SCORE)
    best = int(np.argmin(score))
    return directions[:, best] if np.isfinite(score[best]) else directions[:, 0]


def _sharp_axis(
    surface: Array, near: Array, axis: Array, radius: float, params: EndParams
) -> Array:
    """Turn the axis to where the tool stops most sharply: the normal of a flat end face.

    Stays within a few degrees unless another direction is much sharper.

    Args:
        surface: (Q, 3) evenly spread points of the tool about the middle of its end.
    """
    directions = _cone(axis, params.face_cone_deg)
    close = surface[np.linalg.norm(surface, axis=1) < 2.2 * radius + 0.01]
    along = close @ directions
    across = np.square(close).sum(axis=1)[:, None] - along * along
    along = np.where(across < (1.8 * radius) ** 2, along, -1.0)
    thick = params.face_thickness
    sharpness = np.zeros(directions.shape[1])
    for place in np.arange(-0.012, 0.012, _BIN):
        on_face = (np.abs(along - place) < thick).sum(axis=0)
        beyond = (along > place + 2 * thick).sum(axis=0)
        sharpness = np.maximum(sharpness, on_face - beyond)
    turned = directions.T @ axis
    rms = _scatter(near, directions, params.short_slab, params.wide).rms
    slender = np.square(radius / np.maximum(rms, 1e-4))
    score = sharpness * slender * (1 - params.face_turn_weight * (1 - turned))
    here = turned > np.cos(np.radians(params.refine_deg))
    best, best_here = int(np.argmax(score)), int(np.argmax(np.where(here, score, -np.inf)))
    if score[best_here] <= 0 and score[best] <= 0:
        return axis
    much_sharper = score[best] > params.face_gain * score[best_here]
    return directions[:, best if much_sharper else best_here]


def _middle(points: Array, axis: Array, radius: float, params: EndParams) -> Array:
    """Return the step (3,) from the points' origin to the middle of the end across the axis.

    Half way between the sides, not the mean: the near side of a tool shows more often.
    """
    across_axis = np.linalg.svd(axis[None])[2][1:].T
    centre = np.zeros(3)
    for _ in range(2):
        about = points - centre
        along, across = about @ axis, about @ across_axis
        inside = np.square(across).sum(axis=1) < radius * radius
        if not inside.any():
            break
        last = inside & (along > np.quantile(along[inside], 0.995) - params.middle_slab)
        if last.sum() < 4:
            break
        _, turn = np.linalg.eigh(np.cov(across[last].T))
        sides = across[last] @ turn
        low, high = np.quantile(sides, [params.side_quantile, 1 - params.side_quantile], axis=0)
        centre = centre + across_axis @ turn @ ((low + high) / 2)
    return centre - (centre @ axis) * axis


def end_along(cloud: Cloud, middle: Array, axis: Array, radius: float) -> float:
    """Return where the tool stops along its axis, metres from ``middle``.

    The density of points along the axis is a plateau that stops, with the end's rim upon it, both
    blurred: the place of the stop is fitted together with their heights and the blur.
    """
    along, across = _along_axis(cloud.points - middle, axis)
    inside = (across < max(0.02, 1.6 * radius) ** 2) & (along > -0.06) & (along < 0.04)
    bins = np.round(along[inside] / _BIN).astype(np.int64) + 60
    span = cloud.frame_count
    density = np.bincount(np.unique(bins * span + cloud.frames[inside]) // span, minlength=101)
    return _stop(density.astype(float)) * _BIN if density.any() else 0.0


def _stop(density: Array) -> float:
    """Return the bin, counted from the sixty-first, at which a density stops."""
    from scipy import ndimage

    smooth = ndimage.gaussian_filter1d(density, _BLURS[0])
    last = float(np.flatnonzero(smooth > 0.2 * smooth.max())[-1]) - 60
    place = np.arange(len(density)) - 60.0
    window = (place > last - 15) & (place < last + 10)
    measured, place = density[window], place[window]
    best, found = np.inf, last
    for blur in _BLURS:
        for stop in np.arange(last - 8, last + 3, 0.25):
            scaled = (place - stop) / blur
            step = np.array([0.5 * (1 - erf(value / 2**0.5)) for value in scaled])
            rim = np.exp(-0.5 * scaled * scaled)
            residual = _fit_residual(step, rim, measured)
            if residual < best:
                best, found = residual, float(stop)
    return found


def _fit_residual(step: Array, rim: Array, measured: Array) -> float:
    """Return the squared residual of the best non-negative heights of step and rim."""
    normal = np.array([[step @ step, step @ rim], [step @ rim, rim @ rim]]) + 1e-9 * np.eye(2)
    right = np.array([step @ measured, rim @ measured])
    plateau, height = np.linalg.solve(normal, right)
    if plateau < 0:
        plateau, height = 0.0, max(right[1] / normal[1, 1], 0.0)
    elif height < 0:
        plateau, height = max(right[0] / normal[0, 0], 0.0), 0.0
    return float(np.square(measured - plateau * step - height * rim).sum())


@cache
def _sphere_directions() -> Array:
    """Return (6000, 3) unit vectors spread evenly over the sphere (golden spiral)."""
    index = np.arange(6000) + 0.5
    polar = np.arccos(1 - 2 * index / 6000)
    turn = np.pi * (1 + 5**0.5) * index
    directions: Array = np.stack(
        [np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], axis=1
    )
    return directions


def _cone(axis: Array, degrees: float) -> Array:
    """Return (3, D) directions within an angle of an axis, the axis itself first."""
    directions = _sphere_directions()
    inside = directions[directions @ axis > np.cos(np.radians(degrees))]
    if len(inside) > 1500:  # a coarse search is refined anyway
        inside = inside[:: len(inside) // 750]
    cone: Array = np.concatenate([axis[None], inside]).T
    return cone


def _along_axis(about: Array, axis: Array) -> tuple[Array, Array]:
    """Return how far points (V, 3) lie along an axis (3,), metres, and from it, metres squared."""
    along = about @ axis
    return along, np.square(about).sum(axis=1) - along * along


def unit_vector(vector: Array) -> Array:
    """Return a vector (3,) of length 1; where it has none, that along z."""
    length = float(np.linalg.norm(vector))
    return vector / length if length > 0 else np.array([0.0, 0.0, 1.0])
