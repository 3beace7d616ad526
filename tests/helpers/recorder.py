"""Real ``tooltip record`` processes, and what they have written."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from tooltip_cli.log.container import LoggedMessage, iterate

ROOT = Path(__file__).parents[2]


def interruptible() -> None:
    """Let a new process take SIGINT, which one that runs in the background is born to ignore."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def recorder(kind: str, out: Path, *arguments: object) -> subprocess.Popen[str]:
    """Start ``tooltip record KIND OUT ...``."""
    command = [sys.executable, "-m", "tooltip_cli.cli.main", "record", kind, str(out)]
    command += map(str, arguments)
    return subprocess.Popen(
        command,
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=interruptible,  # noqa: PLW1509 - nothing else happens between fork and exec
    )


def results(process: subprocess.Popen[str], number: int | None = None) -> tuple[str, str]:
    """Return what a recorder printed and said, after a signal or by itself; it must end well."""
    if number is not None:
        process.send_signal(number)
    out, err = process.communicate(timeout=90)
    assert process.returncode == 0, err
    return out, err


def ended(process: subprocess.Popen[str], number: int | None = None) -> str:
    """Return what a recorder said; see :func:`results`."""
    return results(process, number)[1]


def by_topic(path: Path) -> dict[str, list[LoggedMessage]]:
    """Return the messages of a log, which must be whole."""
    found: dict[str, list[LoggedMessage]] = {}
    for item in iterate(path):
        if isinstance(item, LoggedMessage):
            found.setdefault(item.topic, []).append(item)
    return found


def grown(out: Path, size: int) -> Callable[[], bool]:
    """Return whether a recording in the making has so many bytes on the disk."""
    unfinished = out.with_name(f"{out.name}.unfinished")
    return lambda: unfinished.exists() and unfinished.stat().st_size > size


def wait_for(condition: Callable[[], bool], what: str) -> None:
    """Wait for something that happens within seconds."""
    for _ in range(6000):
        if condition():
            return
        time.sleep(0.01)
    raise AssertionError(f"{what} did not happen")
