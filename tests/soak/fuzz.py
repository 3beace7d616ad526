"""Every reader on inputs that nobody meant to be read: no uncaught exception, no runaway.

Each reader works in a process of its own, so that its memory can be told from the others'. An input
is made from a good one by random changes, from a seed that a failure names.

    python -m tests.soak.fuzz [--inputs 10000] [--seed 0] [--only NAME]
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.helpers.fuzz import attempt, mutate, targets

ALLOWED_S, ALLOWED_MIB = 5.0, 512


def main() -> None:
    """Print one line of JSON for each reader; exit with 1 where one fails."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only")
    parser.add_argument("--parallel", type=int, default=2)
    options = parser.parse_args()
    if options.only:
        one(options.only, options.inputs, options.seed)
        return
    with tempfile.TemporaryDirectory() as folder:
        names = list(targets(Path(folder)))
    command = [sys.executable, "-m", "tests.soak.fuzz", "--inputs", str(options.inputs)]
    command += ["--seed", str(options.seed), "--only"]
    failed = 0
    running: list[subprocess.Popen[bytes]] = []
    for name in [*names, None]:
        while running and (name is None or len(running) >= options.parallel):
            failed += running.pop(0).wait() != 0
        if name is not None:
            running.append(subprocess.Popen([*command, name]))
    sys.exit(failed > 0)


def one(name: str, inputs: int, seed: int) -> None:
    """Feed one reader."""
    with Path(os.devnull).open("wb") as silence:  # the image libraries print what they think of it
        os.dup2(silence.fileno(), 2)
    refused, slowest, failures = 0, 0.0, []
    with tempfile.TemporaryDirectory() as folder:
        target = targets(Path(folder))[name]
        for number in range(inputs):
            rng = random.Random(f"{seed}/{name}/{number}")
            data = mutate(rng.choice(target.seeds), target.seeds, rng, text=target.text)
            start = time.process_time()
            try:
                refused += attempt(target, data, Path(folder)) is not None
            except Exception as error:  # counted, named, and the others still tried
                failures.append(f"{number}: {error!r}")
            slowest = max(slowest, time.process_time() - start)
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    summary = {
        "reader": name,
        "inputs": inputs,
        "refused": refused,
        "uncaught": len(failures),
        "slowest_cpu_s": round(slowest, 3),
        "peak_mib": round(peak_mib),
        "first_failures": failures[:5],
    }
    print(json.dumps(summary), flush=True)
    sys.exit(bool(failures) or slowest > ALLOWED_S or peak_mib > ALLOWED_MIB)


if __name__ == "__main__":
    main()
