"""Block matching with an error model for every match (paper, section 3.1)."""

from __future__ import annotations

import enum
import functools
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tooltip_cli import machine_code

Bytes = npt.NDArray[np.uint8]
Pixels = npt.NDArray[np.int32]

# The compiled form works in 16-bit lanes: block^2 * 255 must stay below the 0xFFFF that marks
# lanes outside the window, and search (search + 1) (search + 2) / 6, a sum of counts, below 2^16.
MAX_BLOCK = 15
MAX_SEARCH = 71

_ARGUMENTS = (  # of `_blocks_numba.matcher`
    "u8* u8* i64 i64 i32* i64 i32* i64 i64 f64 i32* u16* i64 u8* u16* i32* i32* f64*"
)
_KERNELS = "tooltip_cli.method._blocks_numba"
_SCRATCH = machine_code.Scratch()
_SLOTS = 8  # edges that the compiled form compares before it looks at what came out
_EDGES_AT_ONCE = 256  # bounds the temporaries of the numpy form to a few megabytes


class Form(enum.IntEnum):
    """What the compiled form is made of, by what a processor must have for it."""

    PORTABLE = 0
    SSE41 = 1
    AVX2 = 2
    AVX512 = 3  # AVX-512 BW and VL

    @property
    def lanes(self) -> int:
        """Displacements that are looked at side by side."""
        return 8 if self is Form.SSE41 else 16


@dataclass(frozen=True)
class BlockMatches:
    """Where each block of the first image is found in the second, and how surely.

    Attributes:
        translations: (N, 2) int32, (du, dv) of the best match from the edge, pixels.
        sad: (N,) int32, sum of absolute differences of the best match, grey levels; s_b.
        covariances: (N, 3) float64, C_uu, C_uv, C_vv of the match's error, pixels squared.
    """

    translations: Pixels
    sad: npt.NDArray[np.int32]
    covariances: npt.NDArray[np.float64]


def matchable(
    edges: npt.NDArray[np.integer],
    shape: tuple[int, int],
    block: int = 5,
    search: int = 11,
    offsets: npt.NDArray[np.integer] | None = None,
) -> npt.NDArray[np.bool_]:
    """Return which edges can be matched: their block and all of their search window are in view.

    Args:
        edges: (N, 2) integers, (u, v) of each edge, pixels.
        shape: rows and columns of both images.
        block: side of the blocks, pixels.
        search: side of the search window, pixels.
        offsets: (N, 2) integers, centre of each edge's search window relative to the edge, pixels.

    Returns:
        (N,) bool.
    """
    half = block // 2
    if offsets is None:
        return _inside(edges, shape, half + search // 2)
    centres = np.add(edges, offsets, dtype=np.int64)
    return _inside(edges, shape, half) & _inside(centres, shape, half + search // 2)


def window_margin(block: int, search: int) -> int:
    """Return how far from the border an edge must be for its block and window to be in view."""
    return block // 2 + search // 2


def match_blocks(
    first: Bytes,
    second: Bytes,
    edges: npt.NDArray[np.integer],
    *,
    block: int = 5,
    search: int = 11,
    tau: float = 200.0,
    alpha: float = 0.25,
    offsets: npt.NDArray[np.integer] | None = None,
    use_numba: bool | None = None,
) -> BlockMatches:
    """Find the block around each edge again in the second image (paper, section 3.1).

    Compared are sums of absolute differences s_j at all displacements of the search window. Of
    several lowest ones the displacement nearest to the window's centre is taken, then the first
    row by row, so that where nothing can be told apart nothing seems to move. The covariance is
    alpha I plus the scatter, around the best match, of all displacements with s_j < s_b + tau.

    Args:
        first: (H, W) uint8, the image that the edges were found in.
        second: (H, W) uint8, the image to search.
        edges: (N, 2) integers, (u, v) in the first image, pixels; see `matchable`.
        block: side of the blocks, pixels; odd, 3 to 15; 5 in the paper.
        search: side of the search window, pixels; odd, 3 to 71; 11 in the paper.
        tau: how much worse than the best a match may be and still be taken for possible, grey
            levels; 200 in the paper.
        alpha: variance added to both axes, pixels squared; 1/4 in the paper.
        offsets: (N, 2) integers, centre of each edge's search window relative to the edge, pixels;
            the edge itself if None. Translations include it.
        use_numba: whether to run the compiled form; None takes it where numba can be imported.
            Both forms give exactly the same.

    Raises:
        ValueError: an argument has the wrong type, shape or range, or a block or window leaves the
            image.
        ImportError: `use_numba` is True and numba cannot be imported.
    """
    first, second = _images(first, second)
    edges = _pairs("edges", edges)
    offsets = None if offsets is None else _pairs("offsets", offsets, len(edges))
    _check(block, search, tau, alpha)
    excess = math.ceil(min(tau, 1e6)) - 1  # SADs are integers: s_j - s_b < tau is at most this
    arguments = (first, second, edges, block, search, excess, alpha, offsets)
    return machine_code.fast_or_slow(
        lambda: _match_compiled(*arguments), lambda: _match_numpy(*arguments), use_numba
    )


def _match_compiled(
    first: Bytes,
    second: Bytes,
    edges: Pixels,
    block: int,
    search: int,
    excess: int,
    alpha: float,
    offsets: Pixels | None,
    form: Form | None = None,
) -> BlockMatches:
    form = best_form() if form is None else form
    constants = (block, search, int(form), _SLOTS)
    match = machine_code.kernel(_KERNELS, "matcher", _ARGUMENTS, *constants)
    matches = BlockMatches(
        translations=np.empty((len(edges), 2), np.int32),
        sad=np.empty(len(edges), np.int32),
        covariances=np.empty((len(edges), 3)),
    )
    reach = search + block + 32  # what the compiled form may read from the start of a window's row
    window, sads = _SCRATCH(constants, lambda: _space(block, search, form, reach))
    steps, ranks = _tables(search, form)
    outside = match(
        first,
        second,
        *first.shape,
        edges,
        len(edges),
        steps if offsets is None else offsets,
        0 if offsets is None else len(offsets),
        excess,
        alpha,
        steps,
        ranks,
        reach,
        window,
        sads,
        matches.translations,
        matches.sad,
        matches.covariances,
    )
    if outside >= 0:
        raise _outside(edges, outside)
    return matches


def _match_numpy(
    first: Bytes,
    second: Bytes,
    edges: Pixels,
    block: int,
    search: int,
    excess: int,
    alpha: float,
    offsets: Pixels | None,
) -> BlockMatches:
    inside = matchable(edges, first.shape, block, search, offsets)
    if not inside.all():
        raise _outside(edges, int(np.argmin(inside)))
    half, margin = block // 2, block // 2 + search // 2
    centres = edges if offsets is None else edges + offsets
    blocks = np.lib.stride_tricks.sliding_window_view(first, (block, block))
    windows = np.lib.stride_tricks.sliding_window_view(second, (2 * margin + 1,) * 2)
    steps = _displacements(search)
    best = np.empty(len(edges), np.intp)
    sad = np.empty(len(edges), np.int32)
    scatter = np.empty((len(edges), 3))
    for start in range(0, len(edges), _EDGES_AT_ONCE):
        part = slice(start, start + _EDGES_AT_ONCE)
        (u, v), (cu, cv) = edges[part].T - half, centres[part].T - margin
        sads = _sads(blocks[v, u], windows[cv, cu], steps + search // 2)
        best[part] = np.argmin(sads, axis=1)  # the first of several equal ones
        sad[part] = sads.min(axis=1)
        scatter[part] = _scatter(sads <= sad[part, None] + excess, best[part], steps)
    return BlockMatches(
        translations=steps[best] + (0 if offsets is None else offsets),
        sad=sad,
        covariances=scatter + np.array([alpha, 0.0, alpha]),
    )


def _inside(
    pixels: npt.NDArray[np.integer], shape: tuple[int, int], margin: int
) -> npt.NDArray[np.bool_]:
    u, v = pixels.T
    inside: npt.NDArray[np.bool_] = (
        (u >= margin) & (v >= margin) & (u < shape[1] - margin) & (v < shape[0] - margin)
    )
    return inside


def _sads(blocks: Bytes, windows: Bytes, corners: Pixels) -> npt.NDArray[np.int32]:
    """Return the (N, K) SADs of (N, B, B) blocks at K corners (column, row) of their windows."""
    wide, side = blocks.astype(np.int16), blocks.shape[1]
    sads = np.empty((len(blocks), len(corners)), np.int32)
    for index, (left, top) in enumerate(corners):
        difference = windows[:, top : top + side, left : left + side] - wide
        sads[:, index] = np.abs(difference).sum(axis=(1, 2))
    return sads


def _scatter(
    similar: npt.NDArray[np.bool_], best: npt.NDArray[np.intp], steps: Pixels
) -> npt.NDArray[np.float64]:
    """Return the (N, 3) mean of the uu, uv and vv of the similar steps' distance from the best."""
    du, dv = steps.T
    powers = np.stack([np.ones_like(du), du, dv, du * du, du * dv, dv * dv], axis=1)
    n, su, sv, suu, suv, svv = (similar.astype(np.int32) @ powers).T
    bu, bv = steps[best].T
    uu, vv = suu - 2 * bu * su + n * bu * bu, svv - 2 * bv * sv + n * bv * bv
    uv = suv - bu * sv - bv * su + n * bu * bv
    mean: npt.NDArray[np.float64] = np.stack([uu, uv, vv], axis=1) / n[:, None]
    return mean


@functools.cache
def _displacements(search: int) -> Pixels:
    """Return the (search^2, 2) displacements (du, dv) in the order in which ties are decided."""
    reach = search // 2
    dv, du = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
    order = np.argsort(du * du + dv * dv, kind="stable")
    steps = np.stack([du, dv], axis=1)[order].astype(np.int32)
    steps.flags.writeable = False
    return steps


@functools.cache
def best_form() -> Form:
    """Return the fastest form of the matcher that this processor can run.

    Raises:
        ImportError: llvmlite, which numba brings, cannot be imported.
    """
    features = machine_code.cpu_features()
    if {"avx512bw", "avx512vl"} <= features:
        return Form.AVX512
    if "avx2" in features:
        return Form.AVX2
    return Form.SSE41 if "sse4.1" in features else Form.PORTABLE


@functools.cache
def rank_table(search: int, form: Form) -> npt.NDArray[np.uint16]:
    """Return the (search, lanes) ranks of the displacements, filled up to whole vectors."""
    displacements = _displacements(search)
    table = np.full((search, -(-search // form.lanes) * form.lanes), 0xFFFF, np.uint16)
    column, row = displacements.T + search // 2
    table[row, column] = np.arange(len(displacements))
    table.flags.writeable = False
    return table


@functools.cache
def _tables(search: int, form: Form) -> tuple[machine_code.Kept, machine_code.Kept]:
    """Return the displacements and their ranks for the compiled form."""
    return machine_code.Kept(_displacements(search)), machine_code.Kept(rank_table(search, form))


def _space(block: int, search: int, form: Form, reach: int) -> tuple[Bytes, npt.NDArray[np.uint16]]:
    """Return room for a search window and for the SADs of a few edges."""
    window = np.zeros((search + block - 1, reach), np.uint8)
    return window, _at_cache_line(_SLOTS * rank_table(search, form).size)


def _at_cache_line(count: int) -> npt.NDArray[np.uint16]:
    """Return space for so many numbers that starts at a cache line: vectors then lie in one."""
    space = np.empty(count + 32, np.uint16)
    return space[-space.ctypes.data % 64 // 2 :][:count]


def _images(first: Bytes, second: Bytes) -> tuple[Bytes, Bytes]:
    for name, image in (("first", first), ("second", second)):
        if image.ndim != 2 or image.dtype != np.uint8:
            raise ValueError(
                f"{name} is a {image.dtype} array of shape {image.shape}; "
                "expected one grey-level image, uint8 (H, W)"
            )
    if first.shape != second.shape:
        raise ValueError(f"the images differ in size: {first.shape} and {second.shape}")
    return np.ascontiguousarray(first), np.ascontiguousarray(second)


def _pairs(name: str, values: npt.NDArray[np.integer], count: int | None = None) -> Pixels:
    shape = (len(values) if count is None else count, 2)
    if values.dtype.kind not in "iu" or values.shape != shape:
        raise ValueError(
            f"{name} is a {values.dtype} array of shape {values.shape}; expected integers {shape}"
        )
    if values.dtype != np.int32:  # what does not fit lies outside every image, and stays there
        values = np.clip(values, np.iinfo(np.int32).min, np.iinfo(np.int32).max)
    return np.ascontiguousarray(values, np.int32)


def _check(block: int, search: int, tau: float, alpha: float) -> None:
    for name, side, largest in (("block", block, MAX_BLOCK), ("search", search, MAX_SEARCH)):
        if not 3 <= side <= largest or side % 2 == 0:
            raise ValueError(f"{name} is {side}; expected an odd number from 3 to {largest}")
    if not tau > 0:
        raise ValueError(f"tau is {tau}; expected more than 0, or no displacement would be similar")
    if not (alpha >= 0 and math.isfinite(alpha)):
        raise ValueError(f"alpha is {alpha}; expected a finite variance, at least 0")


def _outside(edges: Pixels, index: int) -> ValueError:
    u, v = edges[index]
    return ValueError(
        f"the block or the search window of edge {index} at ({u}, {v}) leaves the image; "
        "leave out the edges that are not `matchable`"
    )
