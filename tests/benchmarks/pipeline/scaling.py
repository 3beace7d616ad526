"""How time and memory grow with frames and with edges.

    python tests/benchmarks/pipeline/scaling.py REC [--frames 100 200 500 1000 2000 5000]

Recordings of any length are made by repeating a recording's images. Printed are the processor time
of `tooltip detect --preset paper` without its start, which is that of two frames, and its peak
memory, for every length; the time of matching and fitting for numbers of edges; and the exponents
of the fitted powers.
"""

from __future__ import annotations

import argparse
import itertools
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import numpy.typing as npt

from tooltip_cli.log.container import LoggedMessage, iterate
from tooltip_cli.log.messages import COMPRESSED_IMAGE, Message
from tooltip_cli.log.recording import read_recording
from tooltip_cli.log.writer import LogWriter
from tooltip_cli.method.affine import fit_background
from tooltip_cli.method.blocks import match_blocks, window_margin
from tooltip_cli.method.canny import edge_points

PERIOD_NS = 33_333_333


def repeat(recording: Path, frames: int, long: Path) -> None:
    """Write a recording of so many frames, forwards and backwards through the given one."""
    images = [
        item
        for item in iterate(recording)
        if isinstance(item, LoggedMessage) and item.datatype == COMPRESSED_IMAGE
    ]
    there_and_back = itertools.cycle([*images, *images[-2:0:-1]])
    with LogWriter(long) as writer:
        for index, item in enumerate(itertools.islice(there_and_back, frames)):
            seconds, nanoseconds = divmod(index * PERIOD_NS, 1_000_000_000)
            stamp = seconds.to_bytes(4, "little") + nanoseconds.to_bytes(4, "little")
            payload = item.payload[:4] + stamp + item.payload[12:]
            writer.write(Message(item.topic, item.datatype, index * PERIOD_NS, payload))


def detect(recording: Path) -> tuple[float, int]:
    """Return processor seconds and peak megabytes."""
    tooltip = [sys.executable, "-m", "tooltip_cli.cli.main"]
    process = subprocess.Popen(
        [*tooltip, "detect", str(recording), "--force", "--preset", "paper"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    _, status, usage = os.wait4(process.pid, 0)
    assert status == 0
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss // 1024


def exponent(sizes: list[int], seconds: list[float]) -> float:
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def by_frames(recording: Path, lengths: list[int]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        long = Path(folder) / "long.mcap"
        times = []
        for frames in [2, 2, *lengths]:  # the first compiles what is not compiled yet
            long.unlink(missing_ok=True)
            repeat(recording, frames, long)
            repeats = [detect(long) for _ in range(3 if frames <= 1000 else 1)]
            seconds, megabytes = (float(np.median(column)) for column in zip(*repeats, strict=True))
            times.append(seconds)
            print(f"{frames:6d} frames {seconds:8.2f} s {megabytes:6.0f} MB", flush=True)
        above_start = [seconds - times[1] for seconds in times[2:]]
        print(f"time without the start grows as frames^{exponent(lengths, above_start):.3f}")


def by_edges(recording: Path) -> None:
    first, second = read_recording(recording).images([0, 1], gray=True)
    everywhere = edge_points(first, 0, 0, window_margin(5, 11))
    rng = np.random.default_rng(0)
    sizes = [1000, 2000, 5000, 10_000, 20_000, 50_000]
    medians = []
    for size in sizes:
        rows = np.sort(rng.choice(len(everywhere), min(size, len(everywhere)), replace=False))
        edges: npt.NDArray[np.int32] = np.resize(everywhere[rows], (size, 2))
        elapsed = []
        for _ in range(15):
            begin = time.thread_time()
            matches = match_blocks(first, second, edges)
            fit_background(edges, matches.translations, matches.covariances)
            elapsed.append(time.thread_time() - begin)
        medians.append(float(np.median(elapsed[3:])))
        print(
            f"{size:6d} edges {1000 * medians[-1]:8.3f} ms, {1e6 * medians[-1] / size:.4f} us each"
        )
    print(f"matching and fitting grow as edges^{exponent(sizes, medians):.3f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--frames", type=int, nargs="+", default=[100, 200, 500, 1000, 2000, 5000])
    options = parser.parse_args()
    by_edges(options.recording)
    by_frames(options.recording, options.frames)


if __name__ == "__main__":
    main()
