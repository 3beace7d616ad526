"""A whole shelf: what is left to do, doing it, and the table of all."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from tooltip_cli.errors import MissingExtraError, TooltipError
from tooltip_cli.log.recording import Topics
from tooltip_cli.method.estimators import EstimatorParams
from tooltip_cli.rig.rigfile import load_rig
from tooltip_cli.stages.artifacts import digest, write_whole
from tooltip_cli.stages.held_out import LABELS_SUFFIX
from tooltip_cli.stages.measure import Protocol
from tooltip_cli.stages.shelf.plan import Item
from tooltip_cli.stages.shelf.pool import Died
from tooltip_cli.stages.shelf.table import Row, csv_table, parquet_table
from tooltip_cli.stages.shelf.work import (
    VERSIONS,
    Outcome,
    Task,
    failed_row,
    store_row,
    stored_row,
)

Engine = Callable[[Iterable[Task]], Generator[tuple[Task, Outcome | Died], None, None]]
"""Has :func:`~tooltip_cli.stages.shelf.work.work_on` done somewhere, in any order."""
_LABELS = ".labels."


@dataclass(frozen=True)
class Plan:
    """What is finished and what is left to do."""

    order: tuple[str, ...]  # names of all recordings, finished or not
    finished: Mapping[str, Row]  # by name; nothing that they depend on has changed
    tasks: tuple[Task, ...]  # everything else, in the same order
    sizes: Mapping[str, int]  # of what is left to do, bytes by name; 0 where it is missing


def plan_run(
    items: Sequence[Item],
    out: Path,
    *,
    rig: Path | None = None,
    topics: Topics | None = None,
    params: EstimatorParams | None = None,
    force: bool = False,
    verify: bool = False,
) -> Plan:
    """Find out what is left to do, without opening a recording.

    A stored row is taken where sizes and times of change of the recording and its labels, the
    content of the rig, and all parameters are as they were. What is left goes through the stages,
    each of which is reused by the content of what it depends on.

    Args:
        rig: of recordings whose item names none; default: the one stored in them.
        force: compute everything anew.
        verify: take no stored row; every recording is read and compared by its content.
    """
    topics, params = topics or Topics(), params or EstimatorParams()
    settings = (VERSIONS, topics, params, Protocol(params=params, curve=False))
    look = _Look(digest(settings))
    finished: dict[str, Row] = {}
    tasks, sizes = [], {}
    trust = not (force or verify)
    for item in items:
        chosen_rig = item.rig or rig
        chosen = replace(
            item,
            recording=item.recording.absolute(),
            rig=None if chosen_rig is None else chosen_rig.absolute(),
        )
        chosen = replace(chosen, labels=look.labels(chosen))
        folder = (out / "recordings" / item.name).absolute()
        inputs, size = look.inputs(chosen)
        row = stored_row(folder, inputs) if trust else None
        if row is not None:
            finished[item.name] = row
        else:
            tasks.append(Task(chosen, folder, inputs, topics, params, force, trust))
            sizes[item.name] = size
    return Plan(tuple(item.name for item in items), finished, tuple(tasks), sizes)


class _Look:
    """Looks at files from outside, at each folder and each rig once."""

    def __init__(self, settings: str) -> None:
        self._settings = settings
        self._folders: dict[Path, dict[str, list[str]]] = {}
        self._rigs: dict[Path, str] = {}

    def labels(self, item: Item) -> Path | None:
        """Return the labels that a recording is evaluated with."""
        if item.labels is not None:
            return item.labels.absolute()
        name = f"{item.recording.stem}{LABELS_SUFFIX}"
        here = self._labels_in(item.recording.parent)
        return item.recording.parent / name if name in here.get(item.recording.stem, ()) else None

    def inputs(self, item: Item) -> tuple[str, int]:
        """Return the digest of what a row depends on, and the recording's size in bytes."""
        seen = [_look_at(item.recording)]
        if item.labels is not None:
            seen.append(_look_at(item.labels))
            others = self._labels_in(item.labels.parent).get(item.recording.stem, ())
            seen += [_look_at(item.labels.parent / name) for name in others]
        paths = (str(item.recording), str(item.labels))
        about = (item.tool, item.columns)
        rig = None if item.rig is None else self._rig(item.rig)
        return digest((self._settings, paths, about, rig, seen)), seen[0][0]

    def _labels_in(self, folder: Path) -> dict[str, list[str]]:
        """Return the label files of a folder by the recording that they are named after."""
        if folder not in self._folders:
            found: dict[str, list[str]] = {}
            with suppress(OSError), os.scandir(folder) as entries:
                for name in sorted(entry.name for entry in entries):
                    stem, middle, _ = name.rpartition(_LABELS)
                    if middle and name.endswith(".csv"):
                        found.setdefault(stem, []).append(name)
            self._folders[folder] = found
        return self._folders[folder]

    def _rig(self, path: Path) -> str:
        if path not in self._rigs:
            try:
                self._rigs[path] = digest((str(path), load_rig(path)))
            except TooltipError as error:  # the row that needs it will say so
                self._rigs[path] = digest(str(error))
        return self._rigs[path]


def _look_at(path: Path) -> tuple[int, int]:
    """Return size and time of change; zeros where there is no such file."""
    try:
        found = path.stat()
    except OSError:
        return 0, 0
    return found.st_size, found.st_mtime_ns


def carry_out(plan: Plan, engine: Engine) -> Generator[Outcome, None, None]:
    """Yield the outcome of each task of a plan as it ends.

    A task whose process died is a failed row too.
    """
    with closing(engine(plan.tasks)) as results:
        for task, result in results:
            if isinstance(result, Died):
                row = failed_row(task, "process_died", result.reason)
                with suppress(TooltipError):  # told all the same
                    store_row(task, row)
                result = Outcome(row, False)
            yield result


def write_results(plan: Plan, outcomes: Iterable[Row], path: Path) -> list[Path]:
    """Write the table of all rows that exist, as ``.csv`` and, with PyArrow, ``.parquet``.

    Args:
        path: of the table, without suffix.

    Returns:
        The files written.

    Raises:
        TooltipError: they cannot be written.
    """
    rows = {**plan.finished, **{row.name: row for row in outcomes}}
    ordered = [rows[name] for name in plan.order if name in rows]
    written = [path.with_name(f"{path.name}.csv")]
    write_whole(written[0], csv_table(ordered))
    with suppress(MissingExtraError):
        data = parquet_table(ordered)
        written.append(path.with_name(f"{path.name}.parquet"))
        write_whole(written[1], data)
    return written


@dataclass(frozen=True)
class TimeLeft:
    """How long the rest takes, from what the recordings done so far took for their size."""

    total_bytes: int
    done_bytes: int = 0
    done: int = 0

    def after(self, size: int) -> TimeLeft:
        """Return the same after another recording."""
        return TimeLeft(self.total_bytes, self.done_bytes + size, self.done + 1)

    def seconds(self, elapsed_s: float, jobs: int) -> float | None:
        """Return the time left; None while too few have ended to tell.

        The first of ``jobs`` recordings that run side by side say too much: they all end at once.
        """
        if self.done < jobs or not self.done_bytes:
            return None
        return elapsed_s * (self.total_bytes - self.done_bytes) / self.done_bytes
