"""Time block matching and the background fit on the frames of a recording, on one core.

    taskset -c 1 python tests/benchmarks/matcher/bench_matcher.py \
        ../shared/data/reference/pen.mcap [--reference kernel.so]

Every row is the median over frames and repetitions, in microseconds of processor time an edge, of a
call from Python with everything it allocates; the contestants take turns within one run, so that a
busy machine slows them alike. The reference is a shared library with a hand-written kernel:

    void match(const uint8_t *first, const uint8_t *second, int height, int width,
               const int32_t *edges, int count, int tau, double alpha,
               int16_t *translations, int32_t *sad, double *covariances);

for blocks of 5 and windows of 11; it may read 64 bytes beyond the second image. Its answers are
compared with ours before it is timed.
"""

from __future__ import annotations

import argparse
import ctypes
import functools
import itertools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from tooltip_cli.method import blocks
from tooltip_cli.method.affine import fit_background
from tooltip_cli.method.blocks import BlockMatches, Form, match_blocks, matchable

Image = npt.NDArray[np.uint8]
Pixels = npt.NDArray[np.int32]


def frames(recording: Path, count: int) -> list[Image]:
    """The first grey-level images of a recording."""
    images: list[Image] = []
    with recording.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, _, _, message in reader.iter_decoded_messages():
            if schema is not None and schema.name == "sensor_msgs/msg/CompressedImage":
                data = np.frombuffer(bytes(message.data), np.uint8)
                images.append(np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.uint8))
            if len(images) == count:
                break
    return images


def edges_of(image: Image, low: float, high: float) -> Pixels:
    v, u = np.nonzero(cv2.Canny(image, low, high))
    edges = np.stack([u, v], axis=1).astype(np.int32)
    return edges[matchable(edges, image.shape)]


def load_reference(path: Path) -> Callable[[Image, Image, Pixels], BlockMatches]:
    match = ctypes.CDLL(str(path.resolve())).match

    def run(first: Image, second: Image, edges: Pixels) -> BlockMatches:
        count = len(edges)
        translations, sad = np.empty((count, 2), np.int16), np.empty(count, np.int32)
        covariances = np.empty((count, 3))
        padded = np.concatenate([second.ravel(), np.zeros(64, np.uint8)])
        pointers: list[Any] = [
            array.ctypes.data_as(ctypes.c_void_p)
            for array in (first, padded, edges, translations, sad, covariances)
        ]
        size = (*first.shape, pointers[2], count, 200, ctypes.c_double(0.25))
        match(*pointers[:2], *size, *pointers[3:])
        return BlockMatches(translations.astype(np.int32), sad, covariances)

    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--reference", type=Path)
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--repeat", type=int, default=7)
    parser.add_argument("--canny", type=float, nargs=2, default=(50.0, 150.0))
    options = parser.parse_args()
    images = frames(options.recording, options.frames + 1)
    contestants: dict[str, Callable[[Image, Image, Pixels], object]] = {
        "match_blocks": match_blocks
    }
    for form in range(blocks.best_form(), -1, -1):
        contestants[f"form {Form(form).name}"] = functools.partial(compiled, Form(form))
    reference = load_reference(options.reference) if options.reference else None
    if reference is not None:
        contestants["reference"] = reference
    times: dict[str, list[float]] = {}
    counts, rng = [], np.random.default_rng(0)
    for first, second in itertools.pairwise(images):
        edges = edges_of(first, *options.canny)
        counts.append(len(edges))
        matches = match_blocks(first, second, edges)
        if reference is not None:
            theirs = reference(first, second, edges)
            for name in ("translations", "sad", "covariances"):
                np.testing.assert_array_equal(getattr(theirs, name), getattr(matches, name))
        motion = (edges, matches.translations, matches.covariances)
        runs: dict[str, Callable[[], object]] = {
            name: functools.partial(run, first, second, edges) for name, run in contestants.items()
        }
        runs["fit_background"] = functools.partial(fit_background, *motion)
        shaken = matches.translations + rng.normal(0, 3, edges.shape)  # always more to drop
        runs["fit_background, every drop"] = functools.partial(
            fit_background, edges.astype(float), shaken, matches.covariances
        )
        for run in runs.values():
            run()
        for _ in range(options.repeat):
            for name, run in runs.items():
                begin = time.thread_time()
                run()
                elapsed = time.thread_time() - begin
                times.setdefault(name, []).append(elapsed / len(edges) * 1e6)
    print(f"{len(counts)} pairs, {np.median(counts):.0f} edges each (median)")
    ours = np.median(times["match_blocks"])
    for name, values in times.items():
        median = np.median(values)
        print(f"{name:28s} {median:8.4f} us/edge {median / ours:6.2f} of match_blocks")


def compiled(form: Form, first: Image, second: Image, edges: Pixels) -> BlockMatches:
    return blocks._match_compiled(first, second, edges, 5, 11, 199, 0.25, None, form)


if __name__ == "__main__":
    main()
