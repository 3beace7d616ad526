"""What is freed leaves the process."""

from __future__ import annotations

import subprocess
import sys

import pytest

_PROGRAM = """
import sys
from pathlib import Path

import numpy as np

from tooltip_cli.stages.memory import MANY_RECORDINGS, give_back_freed, give_back_large_arrays


def resident_mb():
    return int(Path("/proc/self/statm").read_text().split()[1]) * {page} / 1e6


how, values = sys.argv[1], int(sys.argv[2])
if how == "large":
    give_back_large_arrays(MANY_RECORDINGS)
np.ones(3_000_000).sum()  # 24 MB: glibc's threshold rises above it when it goes
before = resident_mb()
kept = []
arrays = []
for _ in range(20_000_000 // values):
    arrays.append(np.ones(values))
    kept.append(np.ones(2_000))  # small things lie between
del arrays
if how == "freed":
    give_back_freed()
print(resident_mb() - before)
"""


def held(how: str, values: int) -> float:
    """Return the megabytes that a process of its own keeps of 160 MB which it has freed.

    Args:
        values: of 8 bytes in an array.
    """
    import resource

    program = _PROGRAM.replace("{page}", str(resource.getpagesize()))
    done = subprocess.run(
        [sys.executable, "-c", program, how, str(values)],
        capture_output=True,
        text=True,
        check=True,
    )
    return float(done.stdout)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads Linux's /proc")
@pytest.mark.parametrize(("how", "values"), [("large", 500_000), ("freed", 40_000)])
def test_freed_arrays_leave_the_process(how: str, values: int) -> None:
    import platform

    if platform.libc_ver()[0] != "glibc":
        pytest.skip("the C library is not glibc, whose habit this is about")
    kept, given_back = held("unasked", values), held(how, values)
    assert given_back < 25, f"{given_back:.0f} MB of 160 are still held"
    assert kept > 100, f"glibc held {kept:.0f} MB unasked: the module is no longer needed"


def test_other_systems_are_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    import ctypes

    from tooltip_cli.stages.memory import MANY_RECORDINGS, give_back_freed, give_back_large_arrays

    def forbidden(name: object) -> None:
        raise AssertionError("no C library is to be opened")

    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.setattr(ctypes, "CDLL", forbidden)
    give_back_large_arrays(MANY_RECORDINGS)
    give_back_freed()


def test_another_c_library_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    import ctypes

    from tooltip_cli.stages.memory import MANY_RECORDINGS, give_back_freed, give_back_large_arrays

    monkeypatch.setattr(ctypes, "CDLL", lambda name: object())
    give_back_large_arrays(MANY_RECORDINGS)
    give_back_freed()
