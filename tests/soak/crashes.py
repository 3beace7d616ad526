"""Real ``tooltip record`` processes, cut short at random moments: what is lost of their recordings.

Each process is fed 640x480 JPEG images at 30 Hz through named pipes, with joints at 100 Hz, and is
ended by SIGKILL, by SIGINT, or by a disk that is full (a small tmpfs where that can be mounted,
else a limit on the size of files). What is left must salvage, hold nothing that was not sent, and
lack at most the last second.

    python -m tests.soak.crashes [--each 50] [--parallel 4] [--seed 0]
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import shutil
import signal
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.helpers import paced
from tooltip_cli.errors import TooltipError
from tooltip_cli.log.salvage import salvage

ALLOWED_S = 1.0
KINDS = ("full disk", "SIGKILL", "SIGINT")


def main() -> None:
    """Print one line of JSON for each kind of end."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--each", type=int, default=50)
    parser.add_argument("--only", choices=KINDS)
    parser.add_argument("--parallel", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    image = paced.picture()
    for kind in [options.only] if options.only else KINDS:
        seeds = [f"{options.seed}/{kind}/{number}" for number in range(options.each)]
        with ThreadPoolExecutor(options.parallel) as pool:
            found = list(pool.map(lambda seed, kind=kind: one(kind, seed, image), seeds))
        losses = [loss for _, loss in found]
        summary = {
            "end": kind,
            "recordings": len(found),
            "salvaged": sum(images is not None for images, _ in found),
            "images": sum(images or 0 for images, _ in found),
            "wrong_images": 0,  # else it would have stopped
            "lost_s_median": round(statistics.median(losses), 3),
            "lost_s_max": round(max(losses), 3),
        }
        print(json.dumps(summary), flush=True)
        assert max(losses) <= ALLOWED_S


def one(kind: str, seed: str, image: bytes) -> tuple[int | None, float]:
    """Cut one recording short and recover it; return the images and the seconds that were lost."""
    rng = random.Random(seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if kind == "full disk":
            with full_disk(folder / "disk", rng.randint(500_000, 12_000_000)) as limit:
                session = paced.run(
                    folder / "disk",
                    lambda process, sent: False,
                    arguments=("--min-free", "0"),
                    file_limit=limit,
                    image=image,
                )
                assert session.code == 1, session.stderr
                assert "cannot be written" in session.stderr, session.stderr
                return lost(session, folder / "rescued.mcap")
        number, delay = rng.randint(1, 150), rng.uniform(0, paced.FRAME_NS / 1e9)
        session = paced.run(folder / "a", ended_by(kind, number, delay), image=image)
        if kind == "SIGINT":
            assert session.code == 1, session.stderr
            assert "stopped by SIGINT" in session.stderr, session.stderr
        return lost(session, folder / "rescued.mcap")


def ended_by(kind: str, number: int, delay: float) -> Callable[[subprocess.Popen[str], int], bool]:
    """Return what sends a signal a moment after so many images."""

    def end(process: subprocess.Popen[str], sent: int) -> bool:
        if sent < number:
            return False
        time.sleep(delay)
        process.send_signal(getattr(signal, kind))
        return True

    return end


def lost(session: paced.Session, rescued: Path) -> tuple[int | None, float]:
    """Salvage, compare with what was sent; return the images and the seconds that are missing.

    The images are None where the file held nothing at all.
    """
    try:
        result = salvage(session.unfinished, rescued)
    except TooltipError:  # nothing was on the disk yet
        return None, session.lost_s([])
    assert result.state != "damaged", result
    found = paced.images_in(rescued)
    return len(found), session.lost_s(found)


@contextlib.contextmanager
def full_disk(folder: Path, room: int) -> Iterator[int | None]:
    """Provide a folder that takes only so many bytes; yield a limit that must do that instead."""
    folder.mkdir()
    # the pipes and the table of joints need a little themselves
    command = ["mount", "-t", "tmpfs", "-o", f"size={room + 100_000}", "tmpfs", str(folder)]
    mounted = shutil.which("mount") and os.geteuid() == 0
    if mounted and subprocess.run(command, check=False, capture_output=True).returncode == 0:
        try:
            yield None
        finally:
            subprocess.run(["umount", "-l", str(folder)], check=True)
    else:
        yield room


if __name__ == "__main__":
    main()
