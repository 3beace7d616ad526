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
from tooltip_cli.stages.artifacts import digest, ensure_directory
from tooltip_cli.stages.held_out import LABELS_SUFFIX
from tooltip_cli.stages.measure import Protocol
from tooltip_cli.stages.shelf.plan import Item
from tooltip_cli.stages.shelf.pool import Died
from tooltip_cli.stages.shelf.scratch import load_remote_rig
from tooltip_cli.stages.shelf.store import Listing, Place, Remote, Seen, place, read_some, write
from tooltip_cli.stages.shelf.table import Row, csv_table, parquet_table
from tooltip_cli.stages.shelf.work import (
    ROW,
    VERSIONS,
    Outcome,
    Task,
    failed_row,
    parsed,
    row_of,
    store_row,
    stored_row,
)

Engine = Callable[[Iterable[Task]], Generator[tuple[Task, Outcome | Died], None, None]]
"""Has :func:`~tooltip_cli.stages.shelf.work.work_on` done somewhere, in any order."""
_LABELS = ".labels."
_TRUTH = ".truth.json"


@dataclass(frozen=True)
class Plan:
    """What is finished and what is left to do."""

    order: tuple[str, ...]  # names of all recordings, finished or not
    finished: Mapping[str, Row]  # by name; nothing that they depend on has changed
    tasks: tuple[Task, ...]  # everything else, in the same order
    sizes: Mapping[str, int]  # of what is left to do, bytes by name; 0 where it is missing


def plan_run(
    items: Sequence[Item],
    out: Place,
    *,
    rig: Place | None = None,
    topics: Topics | None = None,
    params: EstimatorParams | None = None,
    force: bool = False,
    verify: bool = False,
    listing: Listing | None = None,
    on_row: Callable[[], None] = lambda: None,
) -> Plan:
    """Find out what is left to do, without opening a recording.

    A stored row is taken where sizes and times of change (in a bucket: versions) of the recording
    and its labels, the content of the rig, and all parameters are as they were. What is left goes
    through the stages, each of which is reused by the content of what it depends on.

    Args:
        rig: of recordings whose item names none; default: the one stored in them.
        force: compute everything anew.
        verify: take no stored row; every recording is read and compared by its content.
        listing: what is known already of the buckets that recordings lie in.
        on_row: called for each stored row that was looked for.

    Raises:
        TooltipError: a store does not answer.
    """
    topics, params = topics or Topics(), params or EstimatorParams()
    settings = (VERSIONS, topics, params, Protocol(params=params, curve=False))
    look = _Look(digest(settings), Listing() if listing is None else listing)
    trust = not (force or verify)
    everything, sizes = [], {}
    for item in items:
        chosen_rig = item.rig or rig
        chosen = replace(
            item,
            recording=item.recording.absolute(),
            rig=None if chosen_rig is None else chosen_rig.absolute(),
        )
        chosen = replace(chosen, labels=look.labels(chosen))
        folder = (out / "recordings" / item.name).absolute()
        inputs, sizes[item.name] = look.inputs(chosen)
        everything.append(
            Task(
                chosen,
                folder,
                inputs,
                topics,
                params,
                force,
                trust,
                seen=look.seen(chosen.recording),
                beside=look.beside(chosen),
            )
        )
    finished = look.finished(everything, out, on_row) if trust else {}
    return Plan(
        tuple(item.name for item in items),
        finished,
        tuple(task for task in everything if task.item.name not in finished),
        {name: size for name, size in sizes.items() if name not in finished},
    )


class _Look:
    """Looks at files from outside, at each folder and each rig once."""

    def __init__(self, settings: str, listing: Listing) -> None:
        self._settings, self._listing = settings, listing
        self._folders: dict[Place, dict[str, list[str]]] = {}
        self._rigs: dict[Place, str] = {}

    def labels(self, item: Item) -> Place | None:
        """Return the labels that a recording is evaluated with."""
        if item.labels is not None:
            return item.labels.absolute()
        name = f"{item.recording.stem}{LABELS_SUFFIX}"
        here = self._labels_in(item.recording.parent)
        return item.recording.parent / name if name in here.get(item.recording.stem, ()) else None

    def inputs(self, item: Item) -> tuple[str, int]:
        """Return the digest of what a row depends on, and the recording's size in bytes."""
        seen = [self._look_at(item.recording)]
        if item.labels is not None:
            seen.append(self._look_at(item.labels))
            seen += [self._look_at(item.labels.parent / name) for name in self._others(item)]
        paths = (str(item.recording), str(item.labels))
        about = (item.tool, item.columns)
        rig = None if item.rig is None else self._rig(item.rig)
        return digest((self._settings, paths, about, rig, seen)), seen[0][0]

    def seen(self, recording: Place) -> Seen | None:
        """Return what a bucket's listing says of a recording."""
        if isinstance(recording, Path):
            return None
        return self._listing.folder(recording.parent).get(recording.name)

    def beside(self, item: Item) -> tuple[Remote, ...]:
        """Return what else the stages look for next to a recording and its labels in buckets."""
        found = []
        if isinstance(item.recording, Remote):
            truth = item.recording.with_name(f"{item.recording.stem}{_TRUTH}")
            if truth.name in self._listing.folder(truth.parent):
                found.append(truth)
        if isinstance(item.labels, Remote):
            names = (name for name in self._others(item) if name != item.labels.name)
            found += [item.labels.with_name(name) for name in names]
        return tuple(found)

    def finished(
        self, tasks: Sequence[Task], out: Place, on_row: Callable[[], None]
    ) -> dict[str, Row]:
        """Return by name the rows that are stored and still hold."""
        finished: dict[str, Row] = {}
        if isinstance(out, Path):
            for task in tasks:
                row = stored_row(task.folder, task.inputs)
                if row is not None:
                    finished[task.item.name] = row
                on_row()
            return finished
        self._listing.add_tree(out / "recordings")
        stored = {task.folder / ROW: task for task in tasks if self._is_there(task.folder / ROW)}
        wanted = [where for where in stored if isinstance(where, Remote)]
        for where, data in read_some(wanted):
            row = row_of(parsed(data), stored[where].inputs, where.parent)
            if row is not None and row.tip_file is not None and self._is_there(place(row.tip_file)):
                finished[stored[where].item.name] = row
            on_row()
        return finished

    def _is_there(self, where: Place) -> bool:
        return isinstance(where, Remote) and where.name in self._listing.folder(where.parent)

    def _others(self, item: Item) -> Sequence[str]:
        """Return the names of all label files of a recording where its labels lie."""
        if item.labels is None:
            return ()
        return self._labels_in(item.labels.parent).get(item.recording.stem, ())

    def _labels_in(self, folder: Place) -> dict[str, list[str]]:
        """Return the label files of a folder by the recording that they are named after."""
        if folder not in self._folders:
            found: dict[str, list[str]] = {}
            for name in self._names(folder):
                stem, middle, _ = name.rpartition(_LABELS)
                if middle and name.endswith(".csv"):
                    found.setdefault(stem, []).append(name)
            self._folders[folder] = found
        return self._folders[folder]

    def _names(self, folder: Place) -> list[str]:
        if isinstance(folder, Remote):
            return sorted(self._listing.folder(folder))
        with suppress(OSError), os.scandir(folder) as entries:
            return sorted(entry.name for entry in entries)
        return []

    def _rig(self, path: Place) -> str:
        if path not in self._rigs:
            try:
                rig = load_rig(path) if isinstance(path, Path) else load_remote_rig(path)
                self._rigs[path] = digest((str(path), rig))
            except TooltipError as error:  # the row that needs it will say so
                self._rigs[path] = digest(str(error))
        return self._rigs[path]

    def _look_at(self, where: Place) -> tuple[int, int | str]:
        """Return size and time of change or version; zeros where there is no such file."""
        if isinstance(where, Path):
            return _look_at(where)
        seen = self._listing.folder(where.parent).get(where.name)
        return (0, 0) if seen is None else (seen.size, seen.version)


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


def prepare(plan: Plan, table: Place) -> None:
    """Make sure that results can be written, before anything is computed.

    In a bucket that is known only by writing: the table of what is finished.

    Raises:
        TooltipError: they cannot.
    """
    if isinstance(table, Path):
        ensure_directory(table.parent)
    elif plan.tasks:
        write_results(in_order(plan, ()), table)


def in_order(plan: Plan, outcomes: Iterable[Row]) -> list[Row]:
    """Return all rows that exist in the order of the shelf."""
    rows = {**plan.finished, **{row.name: row for row in outcomes}}
    return [rows[name] for name in plan.order if name in rows]


def write_results(rows: Sequence[Row], path: Place) -> list[Place]:
    """Write the table of rows, as ``.csv`` and, with PyArrow, ``.parquet``.

    Args:
        path: of the table, without suffix.

    Returns:
        The files written.

    Raises:
        TooltipError: they cannot be written.
    """
    written = [path.with_name(f"{path.name}.csv")]
    write(written[0], csv_table(rows))
    with suppress(MissingExtraError):
        data = parquet_table(rows)
        written.append(path.with_name(f"{path.name}.parquet"))
        write(written[1], data)
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
