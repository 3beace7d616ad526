"""Time ours and what one could use instead, on the same frames in one run, and print ratios.

    taskset -c 0 python tests/benchmarks/flow/compare.py REC [--frames 20]

Everybody starts from two decoded images; ours, Lucas-Kanade and the dense SADs also from the edge
points, whose search is a row of its own. The contestants take turns, on one thread.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from tooltip_cli.log.recording import read_recording
from tooltip_cli.method.affine import fit_background
from tooltip_cli.method.blocks import match_blocks, window_margin
from tooltip_cli.method.canny import edge_points

Image = npt.NDArray[np.uint8]
Pixels = npt.NDArray[np.int32]
Contestant = Callable[[Image, Image, Pixels], object]

LIBRARY: Any = cv2  # its type stubs lack the flows


def ours(first: Image, second: Image, edges: Pixels) -> object:
    matches = match_blocks(first, second, edges)
    return fit_background(edges, matches.translations, matches.covariances)


def dense_sads(first: Image, second: Image, edges: Pixels) -> object:
    """All 121 shifts of the whole image; of the edges the sums that the covariances need."""
    height, width = first.shape
    padded = cv2.copyMakeBorder(second, 5, 5, 5, 5, cv2.BORDER_REPLICATE)
    u, v = edges.T
    sads = np.empty((121, len(edges)), np.uint16)
    for index, (dv, du) in enumerate(itertools.product(range(11), range(11))):
        difference = cv2.absdiff(first, padded[dv : dv + height, du : du + width])
        sums = cv2.boxFilter(difference, cv2.CV_16U, (5, 5), normalize=False)
        sads[index] = sums[v, u]
    return sads.min(axis=0), (sads < sads.min(axis=0) + 200).sum(axis=0)


def lucas_kanade(first: Image, second: Image, edges: Pixels) -> object:
    points = edges.astype(np.float32)[:, None]
    return LIBRARY.calcOpticalFlowPyrLK(first, second, points, None, winSize=(11, 11), maxLevel=2)


def farneback(first: Image, second: Image, edges: Pixels) -> object:
    return LIBRARY.calcOpticalFlowFarneback(first, second, None, 0.5, 3, 15, 3, 5, 1.2, 0)


def dis(preset: int) -> Contestant:
    flow = LIBRARY.DISOpticalFlow_create(preset)
    return lambda first, second, edges: flow.calc(first, second, None)


CONTESTANTS: dict[str, Contestant] = {
    "ours: match and fit": ours,
    "ours: match": match_blocks,
    "ours: edge points": lambda first, second, edges: edge_points(first, 50, 150, 7),
    "Canny of OpenCV, listed": lambda first, second, edges: edge_points(
        first, 50, 150, 7, use_numba=False
    ),
    "DIS ultrafast": dis(0),
    "DIS fast": dis(1),
    "DIS medium": dis(2),
    "Farneback": farneback,
    "Lucas-Kanade, same edges": lucas_kanade,
    "dense SADs, 121 shifts": dense_sads,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--frames", type=int, default=20)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    images = list(read_recording(options.recording).images(range(options.frames + 1), gray=True))
    times: dict[str, list[float]] = {name: [] for name in CONTESTANTS}
    counts = []
    for index, (first, second) in enumerate(itertools.pairwise(images)):
        edges = edge_points(first, 50, 150, window_margin(5, 11))
        counts.append(len(edges))
        for name, run in CONTESTANTS.items():
            begin = time.thread_time()
            run(first, second, edges)
            if index:  # the first round warms up
                times[name].append(time.thread_time() - begin)
    base = np.array(times["ours: match and fit"])
    height, width = images[0].shape
    print(f"{width}x{height}, {np.median(counts):.0f} edges (median), {len(base)} pairs")
    for name, values in times.items():
        ratio = np.median(np.array(values) / base)
        print(f"{name:26s} {1000 * np.median(values):9.2f} ms {ratio:8.2f} of match and fit")


if __name__ == "__main__":
    main()
