"""Work on processes of which any may die without taking more along than what it worked on.

``concurrent.futures.ProcessPoolExecutor`` fails as a whole when one process dies (Python library,
``BrokenProcessPool``); here the death of a process is the result of its task.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import resource
import signal
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from itertools import islice
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnContext, SpawnProcess
from types import FrameType
from typing import Any, Generic, TypeVar, cast

_Task = TypeVar("_Task")
_Result = TypeVar("_Result")
_PATIENCE_S = 5.0


@dataclass(frozen=True)
class Died:
    """The process that worked on a task ended before it answered."""

    reason: str


@dataclass
class _Worker(Generic[_Task]):
    process: SpawnProcess
    connection: Connection
    task: _Task | None = None  # None: idle


def on_processes(
    work: Callable[[_Task], _Result],
    tasks: Iterable[_Task],
    jobs: int,
    memory_bytes: int | None = None,
) -> Generator[tuple[_Task, _Result | Died], None, None]:
    """Yield each task with its result as it ends, in no particular order.

    Each process works on one task at a time and is used again; one that died is replaced. Tasks are
    drawn as processes become free, so that memory does not grow with their number. When the
    iteration is left early, the processes are ended.

    Args:
        work: a function of a module, which the processes import.
        jobs: processes.
        memory_bytes: what each may use for data (``RLIMIT_DATA``); more raises MemoryError in it.
    """
    context = multiprocessing.get_context("spawn")
    waiting = iter(tasks)
    workers: list[_Worker[_Task]] = []
    try:
        for task in waiting:
            workers.append(_start(context, work, memory_bytes))
            _give(workers[-1], task)
            if len(workers) == jobs:
                break
        while busy := [worker for worker in workers if worker.task is not None]:
            ready = wait([worker.connection for worker in busy])
            for worker in (worker for worker in busy if worker.connection in ready):
                done, result = _take_answer(worker)
                if isinstance(result, Died):
                    workers.remove(worker)
                for task in islice(waiting, 1):
                    if isinstance(result, Died):
                        worker = _start(context, work, memory_bytes)
                        workers.append(worker)
                    _give(worker, task)
                yield done, result
    finally:
        _end(workers)


def _start(
    context: SpawnContext, work: Callable[[_Task], _Result], memory_bytes: int | None
) -> _Worker[_Task]:
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(theirs, work, memory_bytes), daemon=True)
    process.start()
    theirs.close()  # so that the death of the process ends the connection
    return _Worker(process, ours)


def _give(worker: _Worker[_Task], task: _Task) -> None:
    worker.task = task
    with contextlib.suppress(BrokenPipeError):  # it died; its answer will say so
        worker.connection.send(task)


def _take_answer(worker: _Worker[_Task]) -> tuple[_Task, Any]:
    task = cast(_Task, worker.task)
    worker.task = None
    try:
        return task, worker.connection.recv()
    except (EOFError, OSError):
        worker.process.join()
        worker.connection.close()
        return task, Died(_death(worker.process.exitcode or 0))


def _death(code: int) -> str:
    if code >= 0:
        return f"its process ended with code {code}"
    name = signal.Signals(-code).name
    text = f"its process was ended by {name}"
    if name == "SIGKILL":
        text += ", which is how the system takes memory back; give it more, or fewer --jobs"
    return text


def _end(workers: list[_Worker[Any]]) -> None:
    """End all processes: idle ones by closing their connection, others by a signal."""
    for worker in workers:
        worker.connection.close()
        if worker.task is not None:
            worker.process.terminate()
    for worker in workers:
        worker.process.join(_PATIENCE_S)
        if worker.process.is_alive():
            worker.process.kill()
            worker.process.join()


def _serve(connection: Connection, work: Callable[[Any], Any], memory_bytes: int | None) -> None:
    """Answer tasks until the connection ends; then nobody wants more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the starting process decides what it means
    signal.signal(signal.SIGTERM, _leave)
    if memory_bytes is not None:
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        limit = memory_bytes if hard == resource.RLIM_INFINITY else min(memory_bytes, hard)
        resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            connection.send(work(connection.recv()))


def _leave(number: int, frame: FrameType | None) -> None:
    """Leave by an exception, so that temporary files are removed on the way."""
    raise SystemExit(128 + number)
