"""How long a report over ten recordings takes, how much memory, and how large its page is.

    python tests/benchmarks/report/run.py FOLDER [--method kmeans]

FOLDER is where the paper's ten tools are simulated and taken through detection once; a later run
finds them there. What is timed is `tooltip evaluate` in a process of its own, from stored
detections and estimates, those from fewer frames among them, but without any part of a report.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

TOOLS = (
    "hot_glue_gun",
    "screwdriver",
    "bottle",
    "electrical_plug",
    "paint_brush",
    "robot_finger",
    "pen",
    "pliers",
    "hammer",
    "scissors",
)
SECONDS, MEGABYTES, PAGE_MEGABYTES = 20.0, 500.0, 10.0


def tooltip(*arguments: object) -> None:
    """Run a command in a process of its own."""
    subprocess.run([sys.executable, "-m", "tooltip_cli.cli.main", *map(str, arguments)], check=True)


def main() -> None:
    """Prepare, measure and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--method", default="voting")
    options = parser.parse_args()
    folder: Path = options.folder
    folder.mkdir(exist_ok=True)
    recordings = [folder / f"{tool}.mcap" for tool in TOOLS]
    for tool, path in zip(TOOLS, recordings, strict=True):
        if not path.exists():
            tooltip("record", "sim", path, "--tool", tool)
    out = folder / f"report-{options.method}"
    command = ("evaluate", *recordings, "--method", options.method, "--out", out)
    tooltip(*command)
    for place in ("parts", "figures", "frames"):
        shutil.rmtree(out / place)
    (out / "index.html").unlink()
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    start = time.perf_counter()
    tooltip(*command)
    elapsed = time.perf_counter() - start
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    processor = after.ru_utime + after.ru_stime - children.ru_utime - children.ru_stime
    sizes = {path.name: path.stat().st_size / 1e6 for path in out.iterdir() if path.is_file()}
    total = sum(path.stat().st_size for path in out.rglob("*") if path.is_file()) / 1e6
    print(f"time      {elapsed:6.1f} s (at most {SECONDS:g}), processor {processor:.1f} s, ")
    print(f"          load before and after on {os.cpu_count()} cores: {os.getloadavg()[0]:.1f}")
    print(f"memory    {after.ru_maxrss / 1e3:6.0f} MB (at most {MEGABYTES:g})")
    print(f"page      {sizes['index.html']:6.1f} MB (at most {PAGE_MEGABYTES:g})")
    print(f"all files {total:6.1f} MB")


if __name__ == "__main__":
    main()
