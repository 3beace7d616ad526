"""What lies in a bucket, on this machine for as long as it is worked on."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from tooltip_cli.errors import TooltipError
from tooltip_cli.rig.rigfile import Rig, parse_rig, rig_files
from tooltip_cli.stages.shelf.plan import Item
from tooltip_cli.stages.shelf.store import (
    Listing,
    Place,
    Remote,
    Seen,
    fetch,
    read,
    read_some,
    write,
)

PREFIX = "tooltip-scratch-"
_YOUNG_S = 60.0
_TEXTS = (".json", ".csv")  # artifacts that may say where a file lay


@contextmanager
def scratch() -> Iterator[Path]:
    """Yield a folder of this process, which is removed afterwards.

    Those of processes that were killed are removed by whoever comes next: a process holds a lock on
    its own, which ends with it.

    Raises:
        TooltipError: it cannot be made.
    """
    base = Path(tempfile.gettempdir())
    for old in base.glob(f"{PREFIX}*"):
        _remove_if_left(old)
    try:
        folder = Path(tempfile.mkdtemp(prefix=PREFIX, dir=base))
    except OSError as error:
        raise TooltipError(f"{base}: cannot be written ({error.strerror})") from error
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(handle)


def _remove_if_left(folder: Path) -> None:
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY | os.O_NOFOLLOW)
        try:
            # one that is not locked yet is young
            if time.time() - os.fstat(handle).st_mtime > _YOUNG_S:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
        finally:
            os.close(handle)


def load_remote_rig(where: Remote) -> Rig:
    """Read a rig file and the files that it names from a bucket.

    Raises:
        TooltipError: as :func:`~tooltip_cli.rig.rigfile.load_rig`.
    """

    def text(place: Remote) -> str:
        try:
            return read(place).decode()
        except UnicodeDecodeError as error:
            raise TooltipError(f"{place}: cannot be read (not UTF-8 text)") from error

    return parse_rig(text(where), lambda name: text(where.parent / name), str(where))


@dataclass
class Bench:
    """A recording, what belongs to it, and its results so far, as files of this machine."""

    recording: Path
    rig: Path | None
    labels: Path | None
    folder: Path  # of the results
    _said: dict[str, str] = field(default_factory=dict)  # folder here -> where it comes from
    _results: Remote | None = None
    known: dict[str, tuple[int, int]] = field(default_factory=dict)  # results as fetched

    def said(self, text: str) -> str:
        """Return a text with the places of files here replaced by where they come from."""
        for here, there in self._said.items():
            text = text.replace(here, there)
        return text

    def keep(self) -> None:
        """Write the results that are new or have changed to where they belong.

        Raises:
            TooltipError: one cannot be written.
        """
        if not self._said:
            return  # they lie there already, and so did everything else
        there = self._results or self.folder
        for name, state in _states(self.folder).items():
            if self.known.get(name) == state:
                continue
            data = (self.folder / name).read_bytes()
            said = self.said(data.decode()).encode() if name.endswith(_TEXTS) else data
            if said != data or isinstance(there, Remote):
                write(there / name, said)


def _states(folder: Path) -> dict[str, tuple[int, int]]:
    """Return size and time of change of every file by its path below the folder."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            state = path.stat()
            found[str(path.relative_to(folder))] = (state.st_size, state.st_mtime_ns)
    return found


@contextmanager
def at_hand(
    item: Item, folder: Place, seen: Seen | None, beside: tuple[Remote, ...], *, anew: bool
) -> Iterator[Bench]:
    """Yield a bench with everything of an item that lies in a bucket; the rest stays where it is.

    Args:
        folder: of the results.
        seen: what was known of the recording when the work was planned.
        beside: other objects that the stages look for next to the recording or its labels.
        anew: leave results that exist already where they are.

    Raises:
        TooltipError: something cannot be fetched, or the recording has changed.
    """
    recording, rig, labels, results = item.recording, item.rig, item.labels, folder
    if (
        isinstance(recording, Path)
        and not isinstance(rig, Remote)
        and not isinstance(labels, Remote)
        and isinstance(results, Path)
    ):
        yield Bench(recording, rig, labels, results)
        return
    with scratch() as here:
        tray = _Tray(here)
        bench = Bench(
            tray.recording(recording, seen),
            tray.rig(rig),
            tray.labels(labels),
            tray.results(results, anew),
            tray.said,
            results if isinstance(results, Remote) else None,
        )
        for other in beside:
            near = bench.labels if other.suffix == ".csv" else bench.recording
            if near is not None and near.is_relative_to(here):
                fetch(other, near.with_name(other.name))
        bench.known = _states(bench.folder)
        yield bench


class _Tray:
    """Fetches into a folder of this machine what does not lie on it."""

    def __init__(self, here: Path) -> None:
        self._here = here
        self.said: dict[str, str] = {}

    def _place(self, there: Remote, kind: str) -> Path:
        folder = self._here / kind
        folder.mkdir()
        self.said[str(folder)] = str(there.parent)
        return folder / there.name

    def recording(self, there: Place, seen: Seen | None) -> Path:
        if isinstance(there, Path):
            return there
        free = shutil.disk_usage(self._here).free
        if seen is not None and seen.size > free:
            raise TooltipError(
                f"{there}: its {seen.size / 1e6:.0f} MB do not fit into {self._here.parent}, which "
                f"has {free / 1e6:.0f} MB left; TMPDIR may name another place"
            )
        path = self._place(there, "recording")
        fetch(there, path, seen)
        return path

    def labels(self, there: Place | None) -> Path | None:
        if not isinstance(there, Remote):
            return there
        path = self._place(there, "labels")
        fetch(there, path)
        return path

    def rig(self, there: Place | None) -> Path | None:
        if not isinstance(there, Remote):
            return there
        path = self._place(there, "rig")
        files = rig_files(load_remote_rig(there))
        for name, text in {**files, path.name: files["rig.yaml"]}.items():
            (path.parent / name).write_text(text, encoding="utf-8")
        return path

    def results(self, there: Place, anew: bool) -> Path:
        if isinstance(there, Path):
            return there
        folder = self._here / "results"
        folder.mkdir()
        self.said[str(folder)] = str(there)
        if not anew:
            _fetch_results(there, folder)
        return folder


def _fetch_results(folder: Remote, results: Path) -> None:
    listing = Listing()
    listing.add_tree(folder)
    for found, data in read_some(listing.below(folder)):
        path = results / found.url.removeprefix(f"{folder.url}/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
