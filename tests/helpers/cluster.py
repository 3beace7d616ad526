"""A real Dask scheduler and real workers on loopback, as processes that can be killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]
_PATIENCE_S = 60


class Cluster:
    """A scheduler at an address that it keeps, and workers of one thread."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._port = 0
        self.scheduler: subprocess.Popen[bytes] | None = None
        self.workers: list[subprocess.Popen[bytes]] = []

    def start(self, workers: int, memory: str = "0") -> None:
        """Start the scheduler, where it was before, and workers.

        Args:
            memory: of each worker, which is ended when it uses more; "0": as much as it wants.
        """
        address = self._folder / "scheduler.json"
        address.unlink(missing_ok=True)
        self.scheduler = self._process(
            "dask_scheduler", "--port", self._port, "--scheduler-file", address
        )
        until = time.monotonic() + _PATIENCE_S
        while not (address.exists() and address.read_text().endswith("}")):
            assert time.monotonic() < until, "no scheduler"
            time.sleep(0.05)
        self.address: str = json.loads(address.read_text())["address"]
        self._port = int(self.address.rpartition(":")[2])
        for _ in range(workers):
            limits = ("--nthreads", 1, "--memory-limit", memory)
            self.workers.append(self._process("dask_worker", self.address, *limits))

    def _process(self, command: str, *arguments: object) -> subprocess.Popen[bytes]:
        words = [*map(str, arguments), "--host", "127.0.0.1", "--no-dashboard"]
        return subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.{command}", *words],
            cwd=self._folder,
            env={
                **os.environ,
                "PYTHONPATH": str(ROOT),
                "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "1",
            },
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )

    @staticmethod
    def kill(process: subprocess.Popen[bytes]) -> None:
        """End a process and all that it started at once, as the loss of a machine does."""
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()

    def stop(self) -> None:
        """End everything."""
        for process in (self.scheduler, *self.workers):
            if process is not None and process.poll() is None:
                self.kill(process)
        self.workers.clear()
