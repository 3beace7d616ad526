"""Labels while they are edited: every change is saved at once, and none overwrites another's."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tooltip_cli.errors import TooltipError
from tooltip_cli.labels.files import TipLabels, labels_text, parse_labels
from tooltip_cli.labels.journal import Journal, open_journal
from tooltip_cli.log.whole import write_file


@dataclass(frozen=True)
class TipLabel:
    """What one person says of one image."""

    state: str  # visible, occluded or out_of_view
    pixel: tuple[float, float] | None  # u, v to a hundredth; None unless visible
    labeler: str


Rows = Mapping[int, TipLabel]  # by image stamp, ns


@dataclass(frozen=True)
class Entry:
    """The label of an image, None where there is none, and the change that made it so."""

    label: TipLabel | None
    revision: int


class ConflictError(TooltipError):
    """Somebody else changed the label in the meantime; nothing was saved."""

    def __init__(self, message: str, entry: Entry) -> None:
        super().__init__(message)
        self.entry = entry


class LabelBook:
    """One label file, open for editing; see :func:`open_book`. Safe to call from threads."""

    def __init__(self, path: Path, rows: Rows, journal: Journal, notes: tuple[str, ...]) -> None:
        self.path = path
        self.notes = notes
        self._rows = dict(rows)
        self._journal = journal
        self._revisions: dict[int, int] = {}
        self._count = 0
        self._text = rows_text(rows)
        self._lock = threading.Lock()

    def entries(self, stamps_ns: list[int]) -> list[Entry]:
        """Return the entries of images, changes that others made to the file included.

        Raises:
            TooltipError: the file cannot be read any more.
        """
        with self._lock:
            self._take_over()
            return [self._entry(stamp) for stamp in stamps_ns]

    def change(self, stamp_ns: int, revision: int, label: TipLabel | None) -> Entry:
        """Set or remove the label of an image; it is on disk when this returns.

        Args:
            revision: of the entry that the change was made from.

        Raises:
            ConflictError: the entry has another revision by now.
            TooltipError: the file cannot be written; then nothing has changed.
        """
        with self._lock:
            self._take_over()
            known = self._entry(stamp_ns)
            if known.label == label:
                return known  # sent again because the answer was lost
            if known.revision != revision:
                raise ConflictError("the label was changed elsewhere in the meantime", known)
            rows = {**self._rows}
            rows.pop(stamp_ns, None)
            if label is not None:
                rows[stamp_ns] = label
            self._save(rows, stamp_ns, label)
            return self._entry(stamp_ns)

    def _entry(self, stamp_ns: int) -> Entry:
        return Entry(self._rows.get(stamp_ns), self._revisions.get(stamp_ns, 0))

    def _save(self, rows: dict[int, TipLabel], stamp_ns: int, label: TipLabel | None) -> None:
        text = rows_text(rows)
        end = self._journal.append(_journalled(stamp_ns, label))
        try:
            write_file(self.path, text)
        except TooltipError:
            self._journal.rewind(end)
            raise
        self._rows, self._text = rows, text
        self._mark(stamp_ns)

    def _mark(self, stamp_ns: int) -> None:
        self._count += 1
        self._revisions[stamp_ns] = self._count

    def _take_over(self) -> None:
        """Take over what another program wrote into the file since it was written here."""
        text = _text_of(self.path)
        if text is None or text == self._text:
            return  # a file that has vanished comes back with the next change
        rows = rows_of(parse_labels(text, str(self.path)))
        for stamp in self._rows.keys() | rows.keys():
            if self._rows.get(stamp) != rows.get(stamp):
                self._mark(stamp)
        self._journal.restart({"csv": rows_text(rows)})
        self._rows, self._text = dict(rows), text


@contextmanager
def open_book(path: Path) -> Iterator[LabelBook]:
    """Open a label file for editing; a missing one is made with the first change.

    What a crash left in the journal and not in the file is restored, and ``notes`` say so.

    Raises:
        TooltipError: another process edits it, it is malformed, or nothing can be written there.
    """
    with open_journal(path) as journal:
        rows, notes = _restored(path, journal)
        journal.restart({"csv": rows_text(rows)})
        try:
            yield LabelBook(path, rows, journal, notes)
        finally:
            journal.remove()  # every change is in the file


def _restored(path: Path, journal: Journal) -> tuple[Rows, tuple[str, ...]]:
    """Return the labels of a file and its journal, the file brought up to date."""
    entries, damaged = journal.read()
    found = _text_of(path)
    notes = [f"{journal.path.name} ends in a half-written change, left out"] if damaged else []
    if len(entries) > 1:
        states = list(_replay(entries, str(journal.path)))
        texts = [rows_text(state) for state in states]
        if found in texts:
            known = len(texts) - 1 - texts[::-1].index(found)
        elif found is None or texts[-1].startswith(found):  # lost or cut short by the crash
            known = 0
        else:
            known = None
        if known is None:
            notes.append(
                f"{path.name} was changed by another program after a crash; taken as it is"
            )
        else:
            missing = len(states) - 1 - known
            if missing:
                write_file(path, texts[-1])
                notes.append(f"{path.name}: restored {missing} changes from {journal.path.name}")
            return states[-1], tuple(notes)
    return ({} if found is None else rows_of(parse_labels(found, str(path)))), tuple(notes)


def _replay(entries: list[Any], source: str) -> Iterator[dict[int, TipLabel]]:
    """Yield the labels at the start of a journal and after each of its changes."""
    rows = dict(rows_of(parse_labels(entries[0]["csv"], source)))
    yield rows
    for entry in entries[1:]:
        rows = {**rows}
        rows.pop(entry["stamp_ns"], None)
        if entry["label"] is not None:
            u, v, state, labeler = entry["label"]
            rows[entry["stamp_ns"]] = TipLabel(state, None if u is None else (u, v), labeler)
        yield rows


def _journalled(stamp_ns: int, label: TipLabel | None) -> dict[str, Any]:
    if label is None:
        return {"stamp_ns": stamp_ns, "label": None}
    u, v = label.pixel or (None, None)
    return {"stamp_ns": stamp_ns, "label": [u, v, label.state, label.labeler]}


def _text_of(path: Path) -> str | None:
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise TooltipError(f"{path}: labels cannot be read ({error})") from error


def rows_of(labels: TipLabels) -> Rows:
    """Return labels by stamp."""
    rows = {}
    for row, stamp in enumerate(labels.stamps_ns.tolist()):
        u, v = labels.pixels[row].tolist()
        pixel = (u, v) if labels.states[row] == "visible" else None
        rows[stamp] = TipLabel(labels.states[row], pixel, labels.labelers[row])
    return rows


def labels_of(rows: Rows, source: str = "labels") -> TipLabels:
    """Return labels by stamp as a table, ascending."""
    stamps = sorted(rows)
    chosen = [rows[stamp] for stamp in stamps]
    return TipLabels(
        np.array(stamps, dtype=np.int64),
        np.array([row.pixel or (math.nan, math.nan) for row in chosen]).reshape(-1, 2),
        tuple(row.state for row in chosen),
        tuple(row.labeler for row in chosen),
        source,
    )


def rows_text(rows: Rows) -> str:
    """Return what a label file with these rows holds."""
    return labels_text(labels_of(rows))
