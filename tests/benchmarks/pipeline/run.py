"""Time `tooltip detect` against loops that decode, run Canny and an optical flow, and its start.

    python tests/benchmarks/pipeline/run.py REC [--rig RIG] [--runs 5] [--core 0] [--jobs]

Whole processes, one after the other in turn, everything included, kernels compiled before. Ratios
are taken run by run and their median is printed, so that a machine whose speed drifts disturbs
them little: of processor time, and with --jobs, which wants two idle cores, of wall time.
"""

from __future__ import annotations

import argparse
import itertools
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tooltip_cli.log.container import LoggedMessage, iterate
from tooltip_cli.log.messages import COMPRESSED_IMAGE, Message
from tooltip_cli.log.writer import LogWriter

LOOP = Path(__file__).with_name("loop.py")
PYTHON = sys.executable
TOOLTIP = [PYTHON, "-m", "tooltip_cli.cli.main"]


@dataclass(frozen=True)
class Cost:
    """Of one process, seconds."""

    cpu: float
    wall: float


def run(command: Sequence[str]) -> Cost:
    begin = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    assert status == 0, command
    return Cost(usage.ru_utime + usage.ru_stime, time.monotonic() - begin)


def compare(
    contestants: Mapping[str, Sequence[str]], runs: int, cores: Sequence[int]
) -> dict[str, list[Cost]]:
    os.sched_setaffinity(0, cores)  # which the processes inherit
    for command in contestants.values():
        run(command)
    costs: dict[str, list[Cost]] = {name: [] for name in contestants}
    for _ in range(runs):
        for name, command in contestants.items():
            costs[name].append(run(command))
    return costs


def ratio(costs: dict[str, list[Cost]], first: str, second: str, kind: str = "cpu") -> float:
    pairs = zip(costs[first], costs[second], strict=True)
    return float(np.median([getattr(a, kind) / getattr(b, kind) for a, b in pairs]))


def table(costs: dict[str, list[Cost]]) -> None:
    for name, values in costs.items():
        cpu = [value.cpu for value in values]
        print(f"{name:34s} {np.median(cpu):7.3f} s ({min(cpu):.3f} to {max(cpu):.3f})")


def first_frames(recording: Path, frames: int, short: Path) -> None:
    """Write a recording's first frames; images alone, as the paper's detector needs no more."""
    images = (
        item
        for item in iterate(recording)
        if isinstance(item, LoggedMessage) and item.datatype == COMPRESSED_IMAGE
    )
    with LogWriter(short) as writer:
        for item in itertools.islice(images, frames):
            writer.write(Message(item.topic, item.datatype, item.log_time_ns, item.payload))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--rig", type=Path)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--core", type=int, default=0)
    parser.add_argument("--jobs", action="store_true")
    options = parser.parse_args()
    recording = str(options.recording)
    rig = ["--rig", str(options.rig)] if options.rig else []
    with tempfile.TemporaryDirectory() as folder:
        detect = [*TOOLTIP, "detect", recording, *rig, "--force", "--out", folder]
        if options.jobs:
            jobs = {f"jobs {n}": [*detect, "--preset", "paper", "--jobs", str(n)] for n in (1, 2)}
            costs = compare(jobs, options.runs, (0, 1))
            print(f"wall time, 1 job / 2 jobs: {ratio(costs, 'jobs 1', 'jobs 2', 'wall'):.2f}")
            print(f"processor time, 2 jobs / 1 job: {ratio(costs, 'jobs 2', 'jobs 1'):.2f}")
            return
        loop = [PYTHON, str(LOOP), recording]
        costs = compare(
            {
                "detect --preset paper": [*detect, "--preset", "paper"],
                "detect --preset voting": detect,
                "decode, Canny": loop,
                "decode, Canny, DIS fast": [*loop, "--flow", "dis-fast"],
            },
            options.runs,
            [options.core],
        )
        table(costs)
        for preset, other in itertools.product(("paper", "voting"), tuple(costs)[2:]):
            print(f"{preset} / {other}: {ratio(costs, f'detect --preset {preset}', other):.2f}")
        short = Path(folder) / "ten.mcap"
        first_frames(options.recording, 10, short)
        ten = [*TOOLTIP, "detect", str(short), "--preset", "paper", "--force", "--out", folder]
        starts = {
            "detect, ten frames": ten,
            "tooltip --help": [*TOOLTIP, "--help"],
            "import click": [PYTHON, "-c", "import click"],
        }
        costs = compare(starts, 2 * options.runs, [options.core])
        table(costs)
        print(
            f"tooltip --help / import click: {ratio(costs, 'tooltip --help', 'import click'):.2f}"
        )


if __name__ == "__main__":
    main()
