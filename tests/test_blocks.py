"""Block matching against a longhand implementation of the paper's formulas."""

from __future__ import annotations

import ctypes
import mmap
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tooltip_cli.method import blocks
from tooltip_cli.method.blocks import (
    BlockMatches,
    Form,
    match_blocks,
    matchable,
    window_margin,
)

Image = npt.NDArray[np.uint8]
Pixels = npt.NDArray[np.int32]

try:
    BEST: int = blocks.best_form()
except ImportError:
    BEST = -1

needs_numba = pytest.mark.skipif(BEST < 0, reason="numba is not installed")

KINDS = ["texture", "noise", "flat", "steps", "jpeg", "contrast"]


def image_pair(kind: str, seed: int, shape: tuple[int, int]) -> tuple[Image, Image]:
    """Two images as a camera might give them, the second moved a little against the first."""
    rng = np.random.default_rng(seed)
    height, width = shape
    coarse = rng.integers(0, 256, (height // 6 + 2, width // 6 + 2), np.uint8)
    scene = cv2.resize(coarse, (width + 8, height + 8), interpolation=cv2.INTER_CUBIC)
    if kind == "noise":
        scene = rng.integers(0, 256, scene.shape, np.uint8)
    elif kind == "flat":  # whole regions of ties
        scene = (scene // 128 * 100).astype(np.uint8)
    elif kind == "steps":
        scene = np.broadcast_to(np.arange(width + 8) // 3 % 2 * 90, scene.shape).astype(np.uint8)
    elif kind == "contrast":
        scene = np.where(scene > 127, 255, 0).astype(np.uint8)
    dv, du = rng.integers(0, 9, 2)
    first, second = scene[4 : 4 + height, 4 : 4 + width], scene[dv:, du:][:height, :width]
    if kind in ("texture", "jpeg"):
        second = np.clip(second + rng.normal(0, 3, shape), 0, 255).astype(np.uint8)
    if kind == "jpeg":
        first, second = (
            cv2.imdecode(
                cv2.imencode(".jpg", view, [cv2.IMWRITE_JPEG_QUALITY, 25])[1],
                cv2.IMREAD_GRAYSCALE,
            )
            for view in (first, second)
        )
    return first, second


def some_edges(rng: np.random.Generator, shape: tuple[int, int], margin: int, count: int) -> Pixels:
    """Edges anywhere that they can be matched, the four outermost ones among them."""
    high = np.array([shape[1], shape[0]]) - margin
    inside = rng.integers(margin, high, (count, 2))
    u, v = (high - 1).tolist()
    corners = [(margin, margin), (u, margin), (margin, v), (u, v)]
    return np.concatenate([inside, corners]).astype(np.int32)


def longhand(
    first: Image,
    second: Image,
    edges: Pixels,
    block: int = 5,
    search: int = 11,
    tau: float = 200.0,
    alpha: float = 0.25,
    offsets: Pixels | None = None,
) -> BlockMatches:
    """The paper's section 3.1, one edge and one displacement at a time."""
    half, reach = block // 2, search // 2
    translations, lowest, covariances = [], [], []
    for index, (u, v) in enumerate(edges.tolist()):
        ou, ov = (0, 0) if offsets is None else offsets[index].tolist()
        ours = first[v - half : v + half + 1, u - half : u + half + 1].astype(int)
        sads = {}
        for dv in range(ov - reach, ov + reach + 1):
            for du in range(ou - reach, ou + reach + 1):
                x, y = u + du - half, v + dv - half
                theirs = second[y : y + block, x : x + block].astype(int)
                sads[du, dv] = int(np.abs(ours - theirs).sum())
        best = min(sads.values())
        ties = [place for place, sad in sads.items() if sad == best]
        bu, bv = min(ties, key=lambda p: ((p[0] - ou) ** 2 + (p[1] - ov) ** 2, p[1], p[0]))
        similar = [(du - bu, dv - bv) for (du, dv), sad in sads.items() if sad < best + tau]
        scatter = sum(np.outer(step, step) for step in similar) / len(similar)
        covariance = alpha * np.eye(2) + scatter
        translations.append((bu, bv))
        lowest.append(best)
        covariances.append([covariance[0, 0], covariance[0, 1], covariance[1, 1]])
    return BlockMatches(
        np.array(translations, np.int32), np.array(lowest, np.int32), np.array(covariances)
    )


def assert_same(found: BlockMatches, expected: BlockMatches) -> None:
    np.testing.assert_array_equal(found.translations, expected.translations)
    np.testing.assert_array_equal(found.sad, expected.sad)
    np.testing.assert_allclose(found.covariances, expected.covariances, rtol=0, atol=1e-12)
    assert found.translations.dtype == found.sad.dtype == np.int32
    assert found.covariances.dtype == np.float64


def check_against_longhand(block: int, search: int, seed: int, form: Form | None) -> None:
    """Compare one compiled form with the longhand one on every kind of image."""
    rng = np.random.default_rng(seed)
    margin = block // 2 + search // 2
    for index, kind in enumerate(KINDS):
        shape = (2 * margin + 1 + int(rng.integers(0, 20)), 2 * margin + 1 + index * 7)
        first, second = image_pair(kind, seed + index, shape)
        edges = some_edges(rng, shape, margin, 4)
        offsets = None
        if index % 2:
            at = some_edges(rng, shape, block // 2, 4)
            at[-1] = edges[-1]
            edges, offsets = at, (edges - at).astype(np.int32)
        tau, alpha = (200.0, 0.25) if index < 2 else (float(rng.uniform(0.1, 3000)), 0.5)
        expected = longhand(first, second, edges, block, search, tau, alpha, offsets)
        found = blocks._match_compiled(
            np.ascontiguousarray(first),
            np.ascontiguousarray(second),
            edges,
            block,
            search,
            int(np.ceil(tau)) - 1,
            alpha,
            offsets,
            form,
        )
        assert_same(found, expected)


@needs_numba
@pytest.mark.parametrize("search", range(3, 23, 2))
@pytest.mark.parametrize("block", [3, 5, 7, 9])
def test_compiled_form_equals_longhand(block: int, search: int) -> None:
    check_against_longhand(block, search, 100 * block + search, None)


@needs_numba
@pytest.mark.parametrize(("block", "search"), [(3, 3), (3, 21), (5, 11), (7, 9), (9, 17), (15, 13)])
@pytest.mark.parametrize("form", Form)
def test_every_instruction_set_equals_longhand(block: int, search: int, form: Form) -> None:
    if form > BEST:
        pytest.skip(f"this processor is not one for {form.name}")
    check_against_longhand(block, search, 7 * block + search, form)


@settings(deadline=None, max_examples=60)
@given(data=st.data())
def test_both_forms_equal_longhand(data: st.DataObject) -> None:
    """Any images, places, thresholds and offsets; sizes few, for every pair is compiled once."""
    block, search = data.draw(st.sampled_from([(3, 5), (5, 11), (7, 9), (9, 3), (5, 21)]))
    margin = block // 2 + search // 2
    shape = (
        data.draw(st.integers(2 * margin + 1, 2 * margin + 25)),
        data.draw(st.integers(2 * margin + 1, 2 * margin + 40)),
    )
    first, second = image_pair(
        data.draw(st.sampled_from(KINDS)), data.draw(st.integers(0, 10**6)), shape
    )
    rng = np.random.default_rng(data.draw(st.integers(0, 10**6)))
    edges, offsets = some_edges(rng, shape, margin, 3), None
    if data.draw(st.booleans()):
        at = some_edges(rng, shape, block // 2, 3)
        edges, offsets = at, (edges - at).astype(np.int32)
    tau = data.draw(st.one_of(st.floats(1e-9, 1e4), st.integers(1, 500), st.just(float("inf"))))
    alpha = data.draw(st.floats(0, 10))
    expected = longhand(first, second, edges, block, search, tau, alpha, offsets)
    for use_numba in (False, True) if BEST >= 0 else (False,):
        found = match_blocks(
            first,
            second,
            edges,
            block=block,
            search=search,
            tau=tau,
            alpha=alpha,
            offsets=offsets,
            use_numba=use_numba,
        )
        assert_same(found, expected)


@pytest.mark.parametrize("use_numba", [False, pytest.param(True, marks=needs_numba)])
@pytest.mark.parametrize(("block", "search"), [(15, 13), (3, 71)])
def test_largest_sizes_do_not_overflow(block: int, search: int, use_numba: bool) -> None:
    """Black against white is the largest SAD there is; a flat window counts the most ties."""
    margin = block // 2 + search // 2
    side = 2 * margin + 1
    first, second = np.zeros((side, side), np.uint8), np.full((side, side), 255, np.uint8)
    edges = np.array([[margin, margin]], np.int32)
    for target in (first, second):
        found = match_blocks(
            first, target, edges, block=block, search=search, tau=1.0, use_numba=use_numba
        )
        assert_same(found, longhand(first, target, edges, block, search, 1.0))
    assert found.sad[0] == block * block * 255


@pytest.mark.parametrize("use_numba", [False, pytest.param(True, marks=needs_numba)])
def test_flat_area_does_not_move(use_numba: bool) -> None:
    flat = np.full((40, 50), 77, np.uint8)
    edges = np.array([[20, 20], [30, 15]], np.int32)
    offsets = np.array([[0, 0], [-3, 4]], np.int32)
    found = match_blocks(flat, flat, edges, offsets=offsets, use_numba=use_numba)
    np.testing.assert_array_equal(found.translations, offsets)
    np.testing.assert_array_equal(found.sad, 0)
    # A uniform window of 11 pixels: (11^2 - 1) / 12 = 10.
    np.testing.assert_allclose(found.covariances, [[10.25, 0.0, 10.25]] * 2)


@pytest.mark.parametrize("use_numba", [False, pytest.param(True, marks=needs_numba)])
def test_ties_go_to_the_nearest_then_the_first_row(use_numba: bool) -> None:
    """A lone block that the second image shows four times, at distances 2, 2, 2 and 3."""
    first, second = np.zeros((2, 41, 41), np.uint8)
    first[20, 20] = 200
    for du, dv in ((3, 0), (0, 2), (2, 0), (-2, 0)):
        second[20 + dv, 20 + du] = 200
    edges = np.array([[20, 20]], np.int32)
    found = match_blocks(first, second, edges, block=3, search=7, use_numba=use_numba)
    assert found.translations.tolist() == [[-2, 0]]
    assert_same(found, longhand(first, second, edges, 3, 7))
    second[18, 20] = 200
    found = match_blocks(first, second, edges, block=3, search=5, use_numba=use_numba)
    assert found.translations.tolist() == [[0, -2]]


@pytest.mark.parametrize("use_numba", [False, pytest.param(True, marks=needs_numba)])
def test_displacements_exactly_tau_worse_are_left_out(use_numba: bool) -> None:
    first, second = np.zeros((2, 31, 31), np.uint8)
    second[:] = 10
    second[13:18, 13:18] = 0  # the best match; one pixel aside, five or more pixels differ by ten
    edges = np.array([[15, 15]], np.int32)

    def spread(tau: float) -> Any:
        return match_blocks(first, second, edges, tau=tau, use_numba=use_numba).covariances[0]

    assert spread(50.0).tolist() == [0.25, 0.0, 0.25]
    np.testing.assert_allclose(spread(50.5), [0.25 + 0.4, 0.0, 0.25 + 0.4], atol=1e-12)


@pytest.mark.parametrize("use_numba", [False, pytest.param(True, marks=needs_numba)])
def test_a_shift_is_found(use_numba: bool) -> None:
    first, _ = image_pair("texture", 3, (80, 90))
    second = np.roll(first, (-4, 3), axis=(0, 1))
    edges = some_edges(np.random.default_rng(0), first.shape, 12, 30)
    found = match_blocks(first, second, edges, use_numba=use_numba)
    np.testing.assert_array_equal(found.translations, [[3, -4]] * len(edges))
    np.testing.assert_array_equal(found.sad, 0)


@settings(deadline=None, max_examples=60)
@given(data=st.data())
def test_exactly_the_matchable_edges_are_matched(data: st.DataObject) -> None:
    shape = (data.draw(st.integers(5, 24)), data.draw(st.integers(5, 24)))
    place = st.tuples(st.integers(-3, 26), st.integers(-3, 26))
    edges = np.array(data.draw(st.lists(place, min_size=1, max_size=5)), np.int64)
    offsets = None
    if data.draw(st.booleans()):
        step = st.tuples(st.integers(-9, 9), st.integers(-9, 9))
        drawn = data.draw(st.lists(step, min_size=len(edges), max_size=len(edges)))
        offsets = np.array(drawn, np.int64)
    inside = matchable(edges, shape, 5, 7, offsets)
    centres = edges if offsets is None else edges + offsets
    for (u, v), (cu, cv), answer in zip(edges, centres, inside, strict=True):
        rows, columns = np.arange(shape[0]), np.arange(shape[1])
        block = {v - 2, v + 2} <= set(rows) and {u - 2, u + 2} <= set(columns)
        window = {cv - 5, cv + 5} <= set(rows) and {cu - 5, cu + 5} <= set(columns)
        assert answer == (block and window)
    image = np.zeros(shape, np.uint8)
    for use_numba in (False, True) if BEST >= 0 else (False,):
        for index, answer in enumerate(inside):
            one = slice(index, index + 1)
            options: dict[str, Any] = {
                "search": 7,
                "use_numba": use_numba,
                "offsets": None if offsets is None else offsets[one],
            }
            if answer:
                match_blocks(image, image, edges[one], **options)
            else:
                with pytest.raises(ValueError, match=r"edge 0 .*leaves the image"):
                    match_blocks(image, image, edges[one], **options)


@pytest.mark.parametrize("use_numba", [False, pytest.param(True, marks=needs_numba)])
def test_views_and_other_integers_are_taken(use_numba: bool) -> None:
    first, second = image_pair("texture", 5, (60, 120))
    edges = some_edges(np.random.default_rng(1), (60, 60), 10, 20)
    expected = longhand(first[:, ::2].copy(), second[:, ::2].copy(), edges)
    first.flags.writeable = False
    for kind in (np.int64, np.uint8, np.int16):
        given_edges = np.asfortranarray(edges.astype(kind))
        found = match_blocks(first[:, ::2], second[:, ::2], given_edges, use_numba=use_numba)
        assert_same(found, expected)


@pytest.mark.parametrize("use_numba", [False, pytest.param(True, marks=needs_numba)])
def test_no_edges_give_no_matches(use_numba: bool) -> None:
    image = np.zeros((30, 30), np.uint8)
    found = match_blocks(image, image, np.zeros((0, 2), np.int32), use_numba=use_numba)
    assert (found.translations.shape, found.sad.shape) == ((0, 2), (0,))
    assert found.covariances.shape == (0, 3)
    assert matchable(np.zeros((0, 2), np.int32), (30, 30)).shape == (0,)


@pytest.mark.parametrize("use_numba", [False, pytest.param(True, marks=needs_numba)])
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"block": 4}, "block is 4"),
        ({"block": 17}, "block is 17"),
        ({"search": 1}, "search is 1"),
        ({"search": 73}, "search is 73"),
        ({"tau": 0.0}, "tau is 0"),
        ({"tau": float("nan")}, "tau is nan"),
        ({"alpha": -0.1}, "alpha is -0.1"),
        ({"alpha": float("nan")}, "alpha is nan"),
        ({"first": np.zeros((30, 30))}, "first is a float64 array"),
        ({"second": np.zeros((30, 30, 3), np.uint8)}, "second is a uint8 array of shape"),
        ({"second": np.zeros((30, 31), np.uint8)}, "differ in size"),
        ({"edges": np.array([[15.0, 15.0]])}, "edges is a float64 array"),
        ({"edges": np.array([15, 15])}, "edges is a int64 array of shape"),
        ({"edges": np.array([[2**32 + 15, 15]])}, "leaves the image"),
        ({"offsets": np.zeros((2, 2), np.int32)}, "offsets is a int32 array"),
        ({"offsets": np.array([[2**31 - 1, 0]])}, "leaves the image"),
    ],
)
def test_wrong_arguments_are_refused(
    changes: dict[str, Any], message: str, use_numba: bool
) -> None:
    image = np.zeros((30, 30), np.uint8)
    arguments = {"first": image, "second": image, "edges": np.array([[15, 15]]), **changes}
    with pytest.raises(ValueError, match=message):
        match_blocks(**arguments, use_numba=use_numba)


def before_a_wall(image: Image) -> Image:
    """A copy of an image that ends where the memory that may be read ends, until the test does."""
    page = mmap.PAGESIZE
    pages = -(-image.size // page)
    memory = mmap.mmap(-1, (pages + 1) * page)
    end = ctypes.addressof(ctypes.c_char.from_buffer(memory)) + pages * page
    assert ctypes.CDLL(None).mprotect(ctypes.c_void_p(end), page, 0) == 0  # PROT_NONE
    copy = np.frombuffer(memory, np.uint8, image.size, pages * page - image.size)
    copy = copy.reshape(image.shape)
    copy[:] = image
    return copy


@needs_numba
@pytest.mark.skipif(sys.platform != "linux", reason="needs mprotect")
@pytest.mark.parametrize("form", Form)
@pytest.mark.parametrize(("block", "search"), [(5, 11), (7, 9), (9, 17)])
def test_vectors_do_not_read_beyond_the_images(block: int, search: int, form: Form) -> None:
    """Reading one byte more would end this process."""
    if form > BEST:
        pytest.skip(f"this processor is not one for {form.name}")
    margin = block // 2 + search // 2
    for width in (2 * margin + 1, 2 * margin + 2, 2 * margin + 30):
        shape = (2 * margin + 3, width)
        first, second = (before_a_wall(image) for image in image_pair("texture", width, shape))
        u, v = np.meshgrid(np.arange(margin, shape[1] - margin), np.arange(margin, margin + 3))
        edges = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.int32)
        found = blocks._match_compiled(first, second, edges, block, search, 199, 0.25, None, form)
        options: dict[str, Any] = {"block": block, "search": search, "use_numba": False}
        assert_same(found, match_blocks(first, second, edges, **options))


def test_the_margin_is_that_of_the_matchable_edges() -> None:
    u, v = np.meshgrid(np.arange(40), np.arange(30))
    edges = np.stack([u.ravel(), v.ravel()], axis=1)
    for block, search in ((5, 11), (3, 7), (9, 3)):
        margin = window_margin(block, search)
        inside = edges[matchable(edges, (30, 40), block, search)]
        assert inside.min(axis=0).tolist() == [margin, margin]
        assert inside.max(axis=0).tolist() == [39 - margin, 29 - margin]


@needs_numba
def test_forms_agree_on_a_real_recording(reference_data: Path) -> None:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    frames: list[Image] = []
    with (reference_data / "reference/pen.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, _, _, message in reader.iter_decoded_messages():
            if schema is not None and schema.name == "sensor_msgs/msg/CompressedImage":
                data = np.frombuffer(bytes(message.data), np.uint8)
                frames.append(np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.uint8))
            if len(frames) == 2:
                break
    v, u = np.nonzero(cv2.Canny(frames[0], 50, 150))
    edges = np.stack([u, v], axis=1)
    edges = edges[matchable(edges, frames[0].shape)]
    assert len(edges) > 1000
    everything = match_blocks(frames[0], frames[1], edges, use_numba=True)
    some = np.random.default_rng(0).choice(len(edges), 4000, replace=False)
    assert_same(
        match_blocks(frames[0], frames[1], edges[some], use_numba=False),
        BlockMatches(
            everything.translations[some], everything.sad[some], everything.covariances[some]
        ),
    )
    few = some[:100]
    assert_same(
        longhand(frames[0], frames[1], edges[few].astype(np.int32)),
        BlockMatches(
            everything.translations[few], everything.sad[few], everything.covariances[few]
        ),
    )
