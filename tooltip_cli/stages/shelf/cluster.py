"""Work on a Dask cluster, which somebody else has started, or on one for this run alone."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from itertools import islice
from typing import TYPE_CHECKING, Any, TypeVar

from tooltip_cli.errors import MissingExtraError, TooltipError
from tooltip_cli.stages.shelf.pool import Died

if TYPE_CHECKING:
    from distributed import Client

LOCAL = "local"
_Task = TypeVar("_Task")
_Result = TypeVar("_Result")
_IN_FLIGHT = 4096  # tasks that the scheduler knows of: enough for any number of workers to wait for
_PATIENCE_S = 60.0


def on_dask(
    work: Callable[[_Task], _Result],
    tasks: Iterable[_Task],
    address: str,
    workers: int = 1,
    memory_bytes: int | None = None,
    key_of: Callable[[_Task], str] = str,
) -> Generator[tuple[_Task, _Result | Died], None, None]:
    """Yield each task with its result as it ends, in no particular order.

    A task whose worker is lost is given to another worker, by the scheduler, until it has lost
    several (``distributed.scheduler.allowed-failures``). That happens to tasks that only waited
    beside the one that kills, too, so each is tried once more at the end, alone; one that loses its
    workers then as well has died. When the scheduler itself is lost and
    comes back, what it had not answered is asked for again.

    Args:
        work: a function that the workers can import.
        address: of the scheduler, such as ``tcp://host:8786``, or ``local``.
        workers: of ``local``: processes of one thread.
        memory_bytes: of ``local``: of each process; a process that uses more is ended.
        key_of: a task's name for the scheduler, each another.

    Raises:
        MissingExtraError: Dask is not installed.
        TooltipError: the scheduler cannot be reached, or is lost and does not come back.
    """
    try:
        import dask

        # every step of every worker otherwise; it is read when distributed is imported
        dask.config.set({"logging.distributed": "error"})
        from distributed import as_completed
    except ImportError:
        raise MissingExtraError("--dask", "dask", "distributed") from None
    waiting, pending = iter(tasks), dict[str, _Task]()
    with _client(address, workers, memory_bytes) as client:
        done = as_completed(loop=client.loop, raise_errors=False)

        def submit(some: Iterable[_Task], how: str = "") -> None:
            for task in some:
                key = f"recording-{key_of(task)}{how}"
                pending[key] = task
                done.add(client.submit(work, task, key=key, pure=False))

        def answers() -> Iterator[tuple[_Task, Any]]:
            for future in done:
                task, result = pending.pop(future.key), _result(future)
                if result is None:
                    _wait_for_scheduler(client, address)
                    submit([task])
                    continue
                submit(islice(waiting, 1))
                yield task, result

        suspects = []
        submit(islice(waiting, _IN_FLIGHT))
        for task, result in answers():
            if isinstance(result, Died):
                suspects.append(task)
            else:
                yield task, result
        for suspect in suspects:
            submit([suspect], "-alone")
            yield from answers()


def _result(future: Any) -> Any:
    """Return what a future holds; None where it was lost together with its scheduler."""
    from distributed import KilledWorker

    try:
        return future.result()
    except CancelledError:
        return None
    except KilledWorker:
        return Died("every worker that worked on it died; the workers' logs may say of what")
    except Exception as error:  # whatever a worker may raise, such as a package that it lacks
        return Died(f"a worker could not do it: {type(error).__name__}: {error}")


def _wait_for_scheduler(client: Client, address: str) -> None:
    until = time.monotonic() + _PATIENCE_S
    while client.status != "running":
        if client.status == "closed" or time.monotonic() > until:
            raise TooltipError(
                f"the Dask scheduler at {address} is gone; what was finished is kept, and the same "
                "command goes on once there is a scheduler"
            )
        time.sleep(0.1)


@contextmanager
def _client(address: str, workers: int, memory_bytes: int | None) -> Iterator[Client]:
    from distributed import Client, LocalCluster

    if address == LOCAL:
        with (
            LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                memory_limit=memory_bytes,
                host="127.0.0.1",
                dashboard_address=None,
                scheduler_kwargs={"dashboard": False},
                silence_logs=logging.ERROR,
            ) as cluster,
            Client(cluster, set_as_default=False) as client,
        ):
            yield client
        return
    try:
        opened = Client(address, set_as_default=False)
    except (OSError, ValueError) as error:
        raise TooltipError(
            f"no Dask scheduler answers at {address} ({error}); start one with 'dask scheduler', "
            "or use --dask local"
        ) from error
    with opened:
        yield opened
