"""Block matching of one edge as vector instructions, and the loop over the edges around it.

The sums of absolute differences (SADs) of sixteen neighbouring displacements are formed side by
side in the 16-bit lanes of a vector. Numba's loops are not turned into such code by LLVM, so the
part that matters is handed to LLVM as vector code (`_EdgeCode`): portable vectors, which become
whatever the processor has, and on x86 the instructions ``mpsadbw`` and ``vdbpsadbw``, which form
the SADs of four pixels at eight (SSE4.1) or sixteen (AVX2, AVX-512) displacements at once.

This module imports numba; `machine_code` imports it where there is something to compile, and
notices changes in this file only.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from tooltip_cli.method.blocks import Form

_BLOCK_ROWS_AT_ONCE = 55  # rows of blocks, 11 displacements of 5, in code without a loop

# For `vdbpsadbw`, which lays pixels 0-3, 4-7, 4-7 and 8-11 of each half out before it compares.
_SLIDING = 0x94

_Image = tuple[Any, Any]  # address of a pixel, bytes from one row to the next
_Rows = Sequence[tuple[list[Any], list[Any]]]  # quads and spare columns of rows of pixels

_BYTE, _LANE, _WORD, _INDEX = (ir.IntType(bits) for bits in (8, 16, 32, 64))


class _EdgeCode:
    """Writes the vector code that matches one edge.

    Of the block's columns the instructions take four at a time (a quad). A single column that is
    left (blocks of 5, 9, 13) adds |a - b|. Where the last quad lacks a column (blocks of 3, 7, 11,
    15), zeros fill it, and what they add, the second image's pixels, is subtracted as -b of a spare
    column. In portable code all columns are spare and add |a - b| = 2 max(a, b) - a - b: one
    instruction fewer for every pixel than a difference and its magnitude.

    Attributes:
        lanes: displacements side by side in one vector, of type `vector`.
        pieces: vectors for one row of displacements.
        quads: first columns of the quads.
        spare: spare columns.
        single: whether one column is left beside the quads.
    """

    def __init__(self, builder: Any, block: int, search: int, form: Form) -> None:
        self.builder, self.block, self.search, self.form = builder, block, search, form
        self.lanes = form.lanes
        self.pieces = -(-search // self.lanes)
        self.quads = range(0) if form is Form.PORTABLE else range(0, block - 2, 4)
        taken = 4 * len(self.quads)
        self.spare = range(min(block, taken), max(block, taken))
        self.single = self.block == taken + 1
        self.vector = ir.VectorType(_LANE, self.lanes)

    def at(self, pointer: Any, offset: int) -> Any:
        return self.builder.gep(pointer, [_INDEX(offset)])

    def load(self, pointer: Any, kind: Any) -> Any:
        loaded = self.builder.load(self.builder.bitcast(pointer, kind.as_pointer()))
        loaded.align = 1
        return loaded

    def splat(self, scalar: Any, lanes: int) -> Any:
        kind = ir.VectorType(scalar.type, lanes)
        first = self.builder.insert_element(kind(ir.Undefined), scalar, _WORD(0))
        return self.builder.shuffle_vector(first, first, ir.VectorType(_WORD, lanes)([0] * lanes))

    def call(self, name: str, result: Any, *arguments: Any) -> Any:
        kind = ir.FunctionType(result, [argument.type for argument in arguments])
        function = cgutils.get_or_insert_function(self.builder.module, kind, name)
        return self.builder.call(function, arguments)

    def row(self, image: _Image, index: Any) -> Any:
        return self.builder.gep(image[0], [self.builder.mul(image[1], index)])

    def pick(self, extreme: str, left: Any, right: Any) -> Any:
        return self.call(f"llvm.{extreme}.v{self.lanes}i16", self.vector, left, right)

    def magnitude(self, lanes: Any) -> Any:
        return self.call(f"llvm.abs.v{self.lanes}i16", self.vector, lanes, ir.IntType(1)(0))

    def least_lane(self, lanes: Any) -> Any:
        return self.call(f"llvm.vector.reduce.umin.v{self.lanes}i16", _LANE, lanes)

    def constant(self, piece: int, values: Sequence[int], outside: int) -> Any:
        """A vector of the values of those of the window's columns that `piece` covers."""
        columns = range(piece * self.lanes, (piece + 1) * self.lanes)
        return self.vector([int(values[x]) if x < self.search else outside for x in columns])

    def block_row(self, pointer: Any) -> tuple[list[Any], list[Any]]:
        """The quads of one row of the block, and its spare pixels, each repeated over a vector."""
        builder, quads = self.builder, []
        for column in self.quads:
            start = self.at(pointer, column)
            if column + 4 <= self.block:
                pixels = self.load(start, _WORD)
            else:
                pair = builder.zext(self.load(start, _LANE), _WORD)
                third = builder.zext(self.load(self.at(start, 2), _BYTE), _WORD)
                pixels = builder.or_(pair, builder.shl(third, _WORD(16)))
            row = self.splat(pixels, self.lanes // 2)
            quads.append(builder.bitcast(row, ir.VectorType(_BYTE, 2 * self.lanes)))
        spare = [
            self.splat(builder.zext(self.load(self.at(pointer, column), _BYTE), _LANE), self.lanes)
            for column in self.spare
            if column < self.block
        ]
        return quads, spare

    def window_row(self, pointer: Any) -> tuple[list[Any], list[Any]]:
        """The pixels of one row of the window that meet the block's, displacement by lane."""
        quads, half = [], ir.VectorType(_BYTE, 16)
        for column in self.quads:
            row = self.load(self.at(pointer, column), half)
            if self.lanes == 16:
                upper = self.load(self.at(pointer, column + 8), half)
                both = ir.VectorType(_WORD, 32)(list(range(32)))
                row = self.builder.shuffle_vector(row, upper, both)
            quads.append(row)
        pixels = ir.VectorType(_BYTE, self.lanes)
        spare = [
            self.builder.zext(self.load(self.at(pointer, column), pixels), self.vector)
            for column in self.spare
        ]
        return quads, spare

    def quad_sads(self, row: Any, quad: Any) -> Any:
        """The SADs of a quad of the block at neighbouring displacements along a row of pixels."""
        if self.form is Form.AVX512:
            name = "llvm.x86.avx512.dbpsadbw.256"
            return self.call(name, self.vector, quad, row, _WORD(_SLIDING))
        name = "llvm.x86.avx2.mpsadbw" if self.form is Form.AVX2 else "llvm.x86.sse41.mpsadbw"
        return self.call(name, self.vector, row, quad, _BYTE(0))

    def sad_rows(self, block_rows: _Rows, window_rows: _Rows) -> list[Any]:
        """The SADs of neighbouring rows of displacements, from all rows of pixels they need."""
        builder, zero = self.builder, self.vector([0] * self.lanes)
        count = len(window_rows) - self.block + 1
        sums, maxima = [zero] * count, [zero] * count
        for y, (quads, spare) in enumerate(window_rows):
            for dv in range(max(0, y - self.block + 1), min(count, y + 1)):
                block_quads, block_spare = block_rows[y - dv]
                for theirs, ours in zip(quads, block_quads, strict=True):
                    sums[dv] = builder.add(sums[dv], self.quad_sads(theirs, ours))
                if self.single:
                    difference = builder.sub(spare[0], block_spare[0])
                    sums[dv] = builder.add(sums[dv], self.magnitude(difference))
                    continue
                for theirs, ours in zip(spare, block_spare, strict=False):
                    maxima[dv] = builder.add(maxima[dv], self.pick("smax", theirs, ours))
        if self.single:
            return sums
        totals = [functools.reduce(builder.add, spare) for _, spare in window_rows]
        taken_off = itertools.chain(*(spare for _, spare in block_rows), totals[: self.block - 1])
        below = functools.reduce(builder.add, taken_off)
        sads = []
        for dv in range(count):
            below = builder.add(below, totals[dv + self.block - 1])
            twice = builder.add(maxima[dv], maxima[dv])
            sads.append(builder.sub(builder.add(sums[dv], twice), below))
            below = builder.sub(below, totals[dv])
        return sads

    def write_sads(self, block: _Image, window: _Image, sads: Any) -> None:
        """Write the SADs of all displacements.

        They are search rows of `pieces` vectors; lanes outside the window hold 0xFFFF.
        """
        builder = self.builder
        rows = min(self.search, _BLOCK_ROWS_AT_ONCE // self.block)
        block_rows = [self.block_row(self.row(block, _INDEX(y))) for y in range(self.block)]
        with cgutils.for_range(builder, _INDEX(-(-self.search // rows))) as loop:
            # The last rows may overlap the ones before: the same numbers are written again.
            wanted, last = builder.mul(loop.index, _INDEX(rows)), _INDEX(self.search - rows)
            top = builder.select(builder.icmp_signed("<", wanted, last), wanted, last)
            starts = [
                self.row(window, builder.add(top, _INDEX(y))) for y in range(rows + self.block - 1)
            ]
            for piece in range(self.pieces):
                outside = self.constant(piece, [0] * self.search, -1)
                pixels = [self.window_row(self.at(start, piece * self.lanes)) for start in starts]
                for dv, sad in enumerate(self.sad_rows(block_rows, pixels)):
                    index = builder.mul(builder.add(top, _INDEX(dv)), _INDEX(self.pieces))
                    place = builder.gep(sads, [builder.add(index, _INDEX(piece))])
                    builder.store(builder.or_(sad, outside), place, align=2)

    def best(self, rows: list[list[Any]], ranks: Any) -> tuple[Any, Any]:
        """The lowest SAD and the lowest rank of the displacements that have it."""
        builder = self.builder
        pick_lower = functools.partial(self.pick, "umin")
        least = self.least_lane(functools.reduce(pick_lower, itertools.chain(*rows)))
        wanted = self.splat(least, self.lanes)
        worst = lowest = self.vector([-1] * self.lanes)
        for index, sad in enumerate(itertools.chain(*rows)):
            rank = self.load(self.at(ranks, 2 * self.lanes * index), self.vector)
            equal = builder.icmp_unsigned("==", sad, wanted)
            lowest = pick_lower(lowest, builder.select(equal, rank, worst))
        return least, self.least_lane(lowest)

    def moments(self, rows: list[list[Any]], highest: Any) -> list[Any]:
        """Sums over the displacements with a SAD of at most `highest`.

        With x the column counted from the window's centre and k = search - row: the sums of
        1, x, x^2, k, k x and k (k + 1) / 2. Those with k come from adding up running totals, so
        that a row of displacements costs a comparison and three additions.
        """
        builder, reach = self.builder, self.search // 2
        threshold = self.splat(highest, self.lanes)
        x = range(-reach, reach + 1)
        ones, squares = [1] * self.search, [value * value for value in x]
        parts: list[list[Any]] = [[] for _ in range(6)]
        for piece in range(self.pieces):
            count = once = twice = self.vector([0] * self.lanes)
            for row in rows:
                similar = builder.icmp_unsigned("<=", row[piece], threshold)
                count = builder.sub(count, builder.sext(similar, self.vector))
                once = builder.add(once, count)
                twice = builder.add(twice, once)
            weighted = [(count, ones), (count, x), (count, squares), (once, ones), (once, x)]
            for part, (lanes, values) in zip(parts, [*weighted, (twice, ones)], strict=True):
                part.append(self.weigh(lanes, self.constant(piece, values, 0)))
        return self.totals([functools.reduce(builder.add, part) for part in parts])

    @property
    def signed(self) -> bool:
        """Whether all running totals fit 15 bits, as x86's multiplication of lanes wants them."""
        return self.form is not Form.PORTABLE and self.search <= 55

    def weigh(self, lanes: Any, factors: Any) -> Any:
        """Products of lanes and constants as 32-bit lanes, neighbours added up where that is one
        instruction."""
        if self.signed:
            half = ir.VectorType(_WORD, self.lanes // 2)
            name = "llvm.x86.avx2.pmadd.wd" if self.lanes == 16 else "llvm.x86.sse2.pmadd.wd"
            return self.call(name, half, lanes, factors)
        wide = ir.VectorType(_WORD, self.lanes)
        return self.builder.mul(self.builder.zext(lanes, wide), self.builder.sext(factors, wide))

    def totals(self, vectors: list[Any]) -> list[Any]:
        """The sums over the lanes of six vectors of 32-bit lanes."""
        builder = self.builder
        if not self.signed:
            name = f"llvm.vector.reduce.add.v{self.lanes}i32"
            return [self.call(name, _WORD, vector) for vector in vectors]
        quarter = ir.VectorType(_WORD, 4)
        if self.lanes == 16:
            lower, upper = quarter(list(range(4))), quarter(list(range(4, 8)))
            vectors = [
                builder.add(
                    builder.shuffle_vector(vector, vector, lower),
                    builder.shuffle_vector(vector, vector, upper),
                )
                for vector in vectors
            ]

        def neighbours(left: Any, right: Any) -> Any:
            return self.call("llvm.x86.ssse3.phadd.d.128", quarter, left, right)

        a, b, c, d, e, f = vectors
        four, two = neighbours(neighbours(a, b), neighbours(c, d)), neighbours(e, f)
        two = neighbours(two, two)
        return [
            *(builder.extract_element(four, _WORD(lane)) for lane in range(4)),
            *(builder.extract_element(two, _WORD(lane)) for lane in range(2)),
        ]

    def summary(self, sads: Any, ranks: Any, excess: Any) -> list[Any]:
        """The eight numbers that `summarize` returns."""
        builder = self.builder
        rows = [
            [self.load(self.at(sads, y * self.pieces + p), self.vector) for p in range(self.pieces)]
            for y in range(self.search)
        ]
        least, rank = self.best(rows, ranks)
        room = builder.sub(_LANE(0xFFFE), least)
        enough = builder.icmp_unsigned("<", excess, builder.zext(room, _INDEX))
        highest = builder.add(least, builder.select(enough, builder.trunc(excess, _LANE), room))
        sums = [builder.sext(total, _INDEX) for total in self.moments(rows, highest)]
        return [builder.zext(least, _INDEX), builder.zext(rank, _INDEX), *sums]

    def slot(self, sads: Any, index: Any) -> Any:
        """The address of one edge's SADs among those of several."""
        rows = self.builder.bitcast(sads, self.vector.as_pointer())
        offset = self.builder.mul(index, _INDEX(self.search * self.pieces))
        return self.builder.gep(rows, [offset])


_PIXELS, _LANES = types.CPointer(types.uint8), types.CPointer(types.uint16)


def _compare(
    _typing: Any,
    first: Any,
    block_at: Any,
    first_stride: Any,
    second: Any,
    window_at: Any,
    second_stride: Any,
    sads: Any,
    slot: Any,
    block: Any,
    search: Any,
    form: Any,
) -> Any:
    """Write the SADs of one edge at all displacements, in numba code.

    Args:
        first: the first image, by its address.
        block_at: where in it the block's top left pixel is.
        first_stride: bytes from one row of it to the next.
        second: the second image, or the scratch copy of the window, likewise.
        window_at: where in it the search window's top left pixel is.
        second_stride: bytes from one row of it to the next.
        sads: space for the SADs of several edges, by its address.
        slot: which of them this edge is.
        block, search, form: the constants of `matcher`.
    """
    sides = block.literal_value, search.literal_value
    kind = Form(form.literal_value)

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        code = _EdgeCode(builder, *sides, kind)
        block_image = (builder.gep(values[0], [values[1]]), values[2])
        window_image = (builder.gep(values[3], [values[4]]), values[5])
        code.write_sads(block_image, window_image, code.slot(values[6], values[7]))
        return context.get_dummy_value()

    image = [_PIXELS, types.int64, types.int64]
    signature = types.void(*image, *image, _LANES, types.int64, block, search, form)
    return signature, generate


def _summarize(
    _typing: Any,
    sads: Any,
    slot: Any,
    ranks: Any,
    excess: Any,
    block: Any,
    search: Any,
    form: Any,
) -> Any:
    """Find the best of the SADs that `compare` wrote, and who is similar, in numba code.

    Args:
        sads: the SADs of several edges, by their address.
        slot: which of them.
        ranks: a `blocks.rank_table`, by its address.
        excess: how much a SAD may exceed the lowest one and still count as similar.
        block, search, form: the constants of `matcher`.

    Returns:
        The lowest SAD, its rank, and the six sums of `_EdgeCode.moments`.
    """
    sides = block.literal_value, search.literal_value
    kind = Form(form.literal_value)

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        code = _EdgeCode(builder, *sides, kind)
        ranks_at = builder.bitcast(values[2], _BYTE.as_pointer())
        numbers = code.summary(code.slot(values[0], values[1]), ranks_at, values[3])
        return context.make_tuple(builder, signature.return_type, numbers)

    signature = types.UniTuple(types.int64, 8)(
        _LANES, types.int64, _LANES, types.int64, block, search, form
    )
    return signature, generate


compare = intrinsic(prefer_literal=True)(_compare)
summarize = intrinsic(prefer_literal=True)(_summarize)


def matcher(block: int, search: int, form: int, slots: int) -> Callable[..., int]:
    """Return the loop over the edges for one size of block and search window, to be compiled.

    Its arguments are what `blocks._match_compiled` gives: the two images and their size; N edges
    and, unless ``moved`` is 0, as many offsets, all as u, v; how much a SAD may exceed the lowest
    one and still count as similar; alpha; the displacements in the order in which ties are decided,
    and their `blocks.rank_table`; how many bytes `compare` may read from the start of a window's
    row, and scratch space for a window of such rows; space for the SADs of ``slots`` edges; and the
    results to fill. It returns the index of the first edge whose block or window
    leaves the image, or -1.

    Some edges are compared first and summarized afterwards: what depends on what within an edge
    then waits less, because the processor works on several at a time.

    Args:
        block: side of the blocks, pixels; odd, 3 to 15.
        search: side of the search window, pixels; odd, 3 to 71.
        form: the `blocks.Form` of the code.
        slots: edges that are compared before they are summarized.
    """
    half, margin = block // 2, block // 2 + search // 2
    side = 2 * margin + 1

    def match_all(
        first: Any,
        second: Any,
        height: int,
        width: int,
        edges: Any,
        count: int,
        offsets: Any,
        moved: int,
        excess: int,
        alpha: float,
        displacements: Any,
        ranks: Any,
        reach: int,
        scratch: Any,
        sads: Any,
        translations: Any,
        sad: Any,
        covariances: Any,
    ) -> int:
        for start in range(0, count, slots):
            stop = min(start + slots, count)
            for i in range(start, stop):
                u, v = np.int64(edges[2 * i]), np.int64(edges[2 * i + 1])
                if u < half or v < half or u >= width - half or v >= height - half:
                    return i
                left, top = u - margin, v - margin
                if moved > 0:
                    left, top = left + offsets[2 * i], top + offsets[2 * i + 1]
                if left < 0 or top < 0 or left + side > width or top + side > height:
                    return i
                image, window, stride = second, top * width + left, width
                if (top + side - 1) * width + left + reach > height * width:
                    # Vectors read beyond the window's last column; here that leaves the image.
                    for y in range(side):
                        for x in range(side):
                            scratch[y * reach + x] = second[(top + y) * width + left + x]
                    image, window, stride = scratch, np.int64(0), reach
                block_at, slot = (v - half) * width + u - half, i - start
                compare(
                    first, block_at, width, image, window, stride, sads, slot, block, search, form
                )
            for i in range(start, stop):
                least, rank, n, x, xx, k, kx, kk = summarize(
                    sads, i - start, ranks, excess, block, search, form
                )
                bu, bv = np.int64(displacements[2 * rank]), np.int64(displacements[2 * rank + 1])
                translations[2 * i], translations[2 * i + 1] = bu, bv
                if moved > 0:
                    translations[2 * i] += offsets[2 * i]
                    translations[2 * i + 1] += offsets[2 * i + 1]
                sad[i] = least
                # Scatter around the best match, in integers until the division; bk: its row's k.
                bk = search - search // 2 - bv
                covariances[3 * i] = alpha + (xx - 2 * bu * x + n * bu * bu) / n
                covariances[3 * i + 1] = (bk * x - kx + bu * k - n * bu * bk) / n
                covariances[3 * i + 2] = alpha + (2 * kk - k - 2 * bk * k + n * bk * bk) / n
        return -1

    return match_all
