"""Watch recordings at their own speed on one core: what keeps up, and how near it ends.

taskset -c 0 python -m tests.benchmarks.watch.run REC...
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

_COMMAND = [sys.executable, "-m", "tooltip_cli.cli.main"]
_REGION = 7.815  # 95 % of a chi-squared distribution with three degrees of freedom


def estimate(recording: Path, rig: list[str], out: Path) -> dict[str, Any]:
    """Return what ``tooltip estimate`` says."""
    command = [*_COMMAND, "estimate", str(recording), *rig, "--out", str(out), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    document: dict[str, Any] = json.loads(done.stdout)
    return document


def watch(recording: Path, rig: list[str]) -> tuple[list[dict[str, Any]], float, int]:
    """Return the updates of ``tooltip watch``, processor seconds and bytes of memory."""
    command = [*_COMMAND, "watch", str(recording), *rig, "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert process.stdout is not None
    lines = process.stdout.read().splitlines()
    _, _, used = os.wait4(process.pid, 0)
    return [json.loads(line) for line in lines], used.ru_utime + used.ru_stime, used.ru_maxrss


def spread_mm(document: dict[str, Any]) -> float:
    """Return the root of the covariance's trace, millimetres."""
    return 1000 * float(np.sqrt(np.trace(document["tip"]["covariance_m2"])))


def main(paths: list[Path]) -> None:
    folder = Path(tempfile.mkdtemp())
    for path in paths:
        # away from its labels, whose images both leave out, so that all of them are used
        recording = Path(shutil.copy(path, folder / path.name))
        beside = path.with_name(f"{path.stem}.rig.yaml")
        rig = ["--rig", str(beside)] if beside.exists() else []
        began = time.monotonic()
        updates, processor_s, memory_kb = watch(recording, rig)
        wall_s = time.monotonic() - began
        last = updates[-1]
        delays = [update["delay_s"] for update in updates[:-1]]
        behind = [update["behind_s"] for update in updates]
        print(
            f"{path.stem}: {last['images']} images, {last['dropped']} dropped, "
            f"{last['passed_over']} passed over; {len(updates)} updates in {wall_s:.1f} s, "
            f"{processor_s:.1f} s of processor time, {memory_kb / 1000:.0f} MB"
        )
        if delays:
            print(
                f"  delay of updates {np.median(delays):.1f} s median, {max(delays):.1f} s at "
                f"most; of the last {last['delay_s']:.1f} s; images taken after "
                f"{np.median(behind):.2f} s median, {max(behind):.2f} s at most"
            )
        stated = [f"{spread_mm(item):.1f}" for item in updates if item["tip"] is not None]
        print(f"  stated uncertainty, mm: {', '.join(stated)}")
        own = estimate(recording, rig, folder / "own")
        if last["tip"] is None or own["tip"] is None:
            print(f"  ends {last['status']}, the whole recording {own['status']}")
            continue
        away = np.subtract(last["tip"]["position_m"], own["tip"]["position_m"])
        squared = float(away @ np.linalg.solve(np.array(last["tip"]["covariance_m2"]), away))
        print(
            f"  ends {1000 * np.linalg.norm(away):.2f} mm from the whole recording's estimate: "
            f"{squared**0.5:.2f} standard deviations, "
            f"{'inside' if squared < _REGION else 'OUTSIDE'} the 95 % region"
        )
    shutil.rmtree(folder)


if __name__ == "__main__":
    main([Path(argument) for argument in sys.argv[1:]])
