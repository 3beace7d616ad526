"""From moving edges to points in the hand frame, by voting in a volume fixed to the hand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tooltip_cli.method.types import Array, Indices
from tooltip_cli.method.voting.loops import run
from tooltip_cli.method.voting.moving import MovingEdges
from tooltip_cli.method.voting.params import VotingParams
from tooltip_cli.method.voting.silhouette import HandSilhouettes

Volume = npt.NDArray[np.float32]

_LEAST_MOTION_PX = 1.5  # a voxel that moves less is not expected to show
_FULL_RATIO = 3.0  # a log-likelihood ratio of this and above counts as one whole vote
_FEWEST_EXPECTED = 20.0  # frames; keeps voxels that few frames could show from scoring high
_VOTING_FRAMES = 100  # of the chosen ones take part in the first vote; more change little
_EDGES_AT_ONCE = 1 << 15  # whose profiles are 8 MB
_BLOCK = 8  # voxels, as in _voting_numba.py
_KEEP_RATIO = 1.0  # edges that never reach this are neither hand nor tool
_CELL_PX = 2.0  # pixels a side of the cells in which the edge nearest to a voxel is looked up
_SMEAR = 1  # cells around an edge within which a voxel counts as near it
_SUBSTEPS = 3  # depths tried between two samples of a profile, once the volume is fine
_FINE_SCORE = 0.02  # share of expected frames, in the fine volume

_PROFILER = "f64* f64* f32* f64* i64* i64 f64* f64* i64 f64 f64 f32*"
_VOTER = (
    "f64* i64 f64 f64* f64* i64 f64 f64 f64 i64 i64 i32* f32* i64 f64* f64 f64 "
    "f64* i64* f64* f32* f32*"
)
_PLACER = "f64* i64* f32* i64 i64 f64* f64* f32* i64 f64 f64 f64 i64 u8* f64* f64*"


@dataclass(frozen=True)
class HandEdges:
    """Moving edges with all that is needed to see them in the hand frame."""

    moving: MovingEdges
    points: Array  # (E, 2) normalized coordinates x/z, y/z of the edges, distortion undone
    moved: Array  # (E, 2, 2) the same of their matches in the partners
    background: Array  # (E, 2, 2) the same of where the background model puts them
    camera_from_hand: Array  # (N, 4, 4) of all images
    focal_px: float  # ideal pixels per unit of normalized coordinates
    extent: Array  # (2, 2) smallest and largest normalized coordinates in the image
    reach: float  # metres from the hand's origin
    silhouettes: HandSilhouettes | None = None  # of the same images; None: nothing is known


@dataclass(frozen=True)
class Cloud:
    """Points of hand and tool in the hand frame, one for each edge that belongs to them."""

    points: Array  # (P, 3) metres
    frames: Indices  # (P,) row of the chosen frames
    frame_count: int  # chosen frames
    expected: Volume  # (n, n, n) frames that should show each coarse voxel
    step: float  # metres, of ``expected``
    score: float  # best share of expected frames that any coarse voxel was seen in
    consistent: float  # share of the moving edges that belong to something fixed to the hand
    edges: Array  # (K, 2) normalized coordinates of all edges that may be fixed to the hand
    edge_rows: Indices  # (K,) row of the chosen frames, ascending
    profiles: npt.NDArray[np.float32]  # (K, depths) their log-likelihood ratios over depth
    depths: Array  # (F, 3) first depth and step of each frame's profiles, metres; focal length


def reconstruct(edges: HandEdges, params: VotingParams) -> Cloud:
    """Give every consistent edge a depth.

    First each voxel collects, over the frames in which it should have moved, whether it projects
    near a moving edge whose motion fits that depth. Then every edge goes to the one depth that the
    volume and its own motion agree on, which removes the smear along rays; the volume is voted
    anew from these points, finer, and so on.
    """
    moving = edges.moving
    rows = moving.frame_of_edge
    depths = _depth_ranges(edges, params)
    kept, profiles = _depth_profiles(edges, rows, depths, params)
    points, rows = edges.points[kept], rows[kept]
    hits, expected = _vote(edges, points, rows, profiles, depths, params)
    volume = (hits / np.maximum(expected, _FEWEST_EXPECTED)).astype(np.float32)
    score = float(volume.max(initial=0.0))
    positions, scores = _place(edges, points, rows, profiles, depths, volume, params.coarse, params)
    good = scores > params.min_score
    for _ in range(params.rounds):
        del volume  # 50 MB, before the next one is made
        volume = _recount(positions[good], rows[good], expected, edges.reach, params)
        positions, scores = _place(
            edges, points, rows, profiles, depths, volume, params.fine, params, _SUBSTEPS
        )
        good = scores > _FINE_SCORE
    consistent = float(good.sum() / max(len(edges.points), 1))
    return Cloud(
        positions[good],
        rows[good],
        len(moving.frames),
        expected,
        params.coarse,
        score,
        consistent,
        points,
        rows,
        profiles,
        depths,
    )


def grid_axis(reach: float, step: float) -> Array:
    """Return the coordinates of voxel centres along each axis, metres."""
    half = int(np.ceil(reach / step))
    return np.arange(-half, half + 1, dtype=float) * step


def _depth_ranges(edges: HandEdges, params: VotingParams) -> Array:
    """Return (F, 3): first depth, step and focal length of each frame's depth samples."""
    centre = edges.camera_from_hand[edges.moving.frames, 2, 3]
    near = np.maximum(centre - edges.reach, 0.05)
    step = (centre + edges.reach - near) / (params.depths - 1)
    return np.stack([near, step, np.full(len(near), edges.focal_px)], axis=1)


def _depth_profiles(
    edges: HandEdges,
    rows: Indices,
    depths: Array,
    params: VotingParams,
    least: float = _KEEP_RATIO,
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.float32]]:
    """Return (E,) which edges may be fixed to the hand, and their profiles (K, depths).

    The profiles are the largest arrays there are: no others are ever held.

    Args:
        least: ratio that an edge's profile must exceed somewhere.
    """
    moving = edges.moving
    camera = edges.camera_from_hand
    hand_from_camera = np.linalg.inv(camera[moving.frames])
    between = np.ascontiguousarray(camera[moving.partners] @ hand_from_camera[:, None])
    kept = np.zeros(len(rows), dtype=bool)
    profiles = np.empty((len(rows), params.depths), dtype=np.float32)  # no memory until written
    count = 0
    for start in range(0, len(rows), _EDGES_AT_ONCE):
        part = slice(start, start + _EDGES_AT_ONCE)
        some = np.zeros((len(rows[part]), params.depths), dtype=np.float32)
        run(
            "profiler",
            _PROFILER,
            edges.points[part],
            np.ascontiguousarray(edges.focal_px * edges.moved[part]),
            moving.covariances[part],
            np.ascontiguousarray(edges.focal_px * edges.background[part]),
            rows[part].astype(np.int64),
            len(some),
            between,
            depths,
            params.depths,
            params.clip,
            params.prediction_variance,
            some,
        )
        kept[part] = some.max(axis=1, initial=-np.inf) > least
        some = some[kept[part]]
        profiles[count : count + len(some)] = some
        count += len(some)
    return kept, profiles[:count]


def _vote(
    edges: HandEdges,
    points: Array,
    rows: Indices,
    profiles: npt.NDArray[np.float32],
    depths: Array,
    params: VotingParams,
) -> tuple[Volume, Volume]:
    axis = grid_axis(edges.reach, params.coarse)
    hits = np.zeros((len(axis),) * 3, dtype=np.float32)
    expected = np.zeros_like(hits)
    every = max(1, round(len(edges.moving.frames) / _VOTING_FRAMES))
    camera = edges.camera_from_hand[:, :3]
    frames, n = edges.moving.frames[::every], len(axis)
    raster, nearest = _nearest_edges(edges, points, rows, every)
    run(
        "voter",
        _VOTER,
        axis,
        n,
        edges.reach,
        np.ascontiguousarray(camera[frames]),
        np.ascontiguousarray(camera[edges.moving.partners[::every, 1]]),
        len(frames),
        *raster,
        *nearest.shape[1:],
        nearest,
        profiles,
        profiles.shape[1],
        np.ascontiguousarray(depths[::every]),
        _LEAST_MOTION_PX / _CELL_PX,
        _FULL_RATIO,
        np.empty(n),
        np.empty((n, 2), np.int64),
        np.empty((2, n, n)),
        hits,
        expected,
    )
    return hits * every, expected * every


def _nearest_edges(
    edges: HandEdges, points: Array, rows: Indices, every: int
) -> tuple[Array, npt.NDArray[np.int32]]:
    """Return the raster (focal, u0, v0) in cells and each cell's nearest edge, or -1.

    The latter is (F, H, W), of one in ``every`` frames.
    """
    focal = edges.focal_px / _CELL_PX
    low, high = focal * edges.extent
    width, height = (np.ceil(high - low) + 1).astype(int)
    frames = len(edges.moving.frames[::every])
    nearest = np.full((frames, height, width), -1, dtype=np.int32)
    edge = np.flatnonzero(rows % every == 0)
    frame = rows[edge] // every
    columns, lines = np.round(focal * points[edge] - low).astype(int).T
    reach = range(-_SMEAR, _SMEAR + 1)
    offsets = [(du, dv) for du in reach for dv in reach]
    for du, dv in sorted(offsets, key=lambda at: -(at[0] ** 2 + at[1] ** 2)):
        # the nearest are written last
        u, v = columns + du, lines + dv
        inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
        nearest[frame[inside], v[inside], u[inside]] = edge[inside]
    return np.array([focal, *low]), nearest


def _place(
    edges: HandEdges,
    points: Array,
    rows: Indices,
    profiles: npt.NDArray[np.float32],
    depths: Array,
    volume: Volume,
    step: float,
    params: VotingParams,
    substeps: int = 1,
) -> tuple[Array, Array]:
    """Return (E, 3) positions in the hand frame and (E,) the volume's score there; 0: nowhere."""
    positions = np.zeros((len(points), 3))
    scores = np.zeros(len(points))
    hand_from_camera = np.linalg.inv(edges.camera_from_hand[edges.moving.frames])
    run(
        "placer",
        _PLACER,
        np.ascontiguousarray(points),
        rows.astype(np.int64),
        np.ascontiguousarray(profiles),
        *profiles.shape,
        np.ascontiguousarray(hand_from_camera),
        depths,
        volume,
        len(volume),
        float(grid_axis(edges.reach, step)[0]),
        step,
        params.volume_weight,
        substeps,
        np.zeros((len(volume) // _BLOCK + 1,) * 3, np.uint8),
        positions,
        scores,
    )
    return positions, scores


def _recount(
    positions: Array, rows: Indices, expected: Volume, reach: float, params: VotingParams
) -> Volume:
    """Vote again with points instead of rays: frames in each fine voxel over frames expected."""
    from scipy import ndimage

    axis = grid_axis(reach, params.fine)
    counts = frames_per_voxel(positions, rows, axis)
    ndimage.gaussian_filter(counts, 1.0, truncate=3.0, output=counts)  # in place: it is large
    coarse = grid_axis(reach, params.coarse)
    nearest = np.clip(np.round((axis - coarse[0]) / params.coarse), 0, len(coarse) - 1).astype(int)
    due = np.maximum(expected, _FEWEST_EXPECTED)
    for layer, row in zip(counts, nearest, strict=True):  # the whole would be as large as counts
        layer /= due[row][np.ix_(nearest, nearest)]
    return counts


def frames_per_voxel(positions: Array, rows: Indices, axis: Array) -> Volume:
    """Return (n, n, n) how many different frames have a point in each voxel of a cube."""
    return count_frames(positions, rows, np.full(3, axis[0]), axis[1] - axis[0], (len(axis),) * 3)


def count_frames(
    positions: Array, rows: Indices, corner: Array, step: float, shape: tuple[int, ...]
) -> Volume:
    """Return how many different frames have a point in each voxel of a box.

    Args:
        positions: (P, 3) metres; ``rows``: (P,) the frame of each.
        corner: (3,) centre of the first voxel.
    """
    index = np.round((positions - corner) / step).astype(np.int64)
    inside = np.asarray(((index >= 0) & (index < shape)).all(axis=1))
    flat = np.ravel_multi_index(tuple(index[inside].T), shape)
    frames = int(rows.max(initial=0)) + 1
    pairs = np.unique(flat * frames + rows[inside])
    voxels, numbers = np.unique(pairs // frames, return_counts=True)
    counts = np.zeros(shape, dtype=np.float32)
    counts.flat[voxels] = numbers
    return counts


def agreed_points(
    points: Array, frames: Indices, voxel: float, least: int
) -> tuple[Array, npt.NDArray[np.int64]]:
    """Return one point for each voxel that enough frames agree on.

    Args:
        points: (P, 3) metres; ``frames``: (P,) the frame of each.
        voxel: metres; ``least``: frames.

    Returns:
        (Q, 3) the mean of each voxel's points, and (Q,) how many frames have one there.
    """
    if not len(points):
        return points, np.zeros(0, dtype=np.int64)
    cells = np.floor(points / voxel).astype(np.int64)
    cells -= cells.min(axis=0)
    flat = np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1))
    _, cell = np.unique(flat, return_inverse=True)
    counts = np.bincount(cell)
    means = np.stack([np.bincount(cell, axis) / counts for axis in points.T], axis=1)
    span = int(frames.max()) + 1
    seen = np.bincount(np.unique(cell * span + frames) // span, minlength=len(counts))
    kept = seen >= least
    return means[kept], seen[kept]
