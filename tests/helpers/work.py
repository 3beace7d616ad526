"""Work for other processes, which import it from here."""

from __future__ import annotations

import os
import signal
import sys
import time

import numpy as np


def misbehave(task: str) -> str:
    """Do what the task says: end in some way, or answer."""
    what, _, detail = task.partition(" ")
    if what == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    elif what == "exit":
        os._exit(int(detail))
    elif what == "raise":
        raise ValueError(detail)
    elif what == "allocate":
        np.ones(int(float(detail) * 2**30), dtype=np.uint8)
    elif what == "sleep":
        time.sleep(float(detail))
    elif what == "flood":
        return "x" * int(detail)
    return f"{task} by {os.getpid()} with {len(sys.argv)}"
