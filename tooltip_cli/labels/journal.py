"""A journal beside a label file: every change, on disk before the file is replaced.

The file ``STEM.labels.csv.journal`` exists while labels are edited and is locked by who edits them.
Its first line holds the labels as they were, each further line one change; every line starts with
its own CRC-32, so that a line that a crash cut in half is told from a whole one.
"""

from __future__ import annotations

import fcntl
import json
import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from tooltip_cli.errors import TooltipError

SUFFIX = ".journal"


class Journal:
    """The journal of one label file, open and locked; see :func:`open_journal`."""

    def __init__(self, path: Path, descriptor: int) -> None:
        self.path = path
        self._descriptor = descriptor

    def read(self) -> tuple[list[Any], bool]:
        """Return the entries up to the first damaged line, and whether there was one."""
        data = b"".join(self._blocks())
        entries: list[Any] = []
        for line in data.splitlines(keepends=True):
            checksum, _, text = line.partition(b" ")
            if not line.endswith(b"\n") or checksum != _checksum(text):
                return entries, True
            entries.append(json.loads(text))
        return entries, False

    def _blocks(self) -> Iterator[bytes]:
        os.lseek(self._descriptor, 0, os.SEEK_SET)
        while block := os.read(self._descriptor, 1 << 20):
            yield block

    def restart(self, first: Any) -> None:
        """Empty the journal and write its first entry."""
        self.rewind(0)
        self.append(first)

    def append(self, entry: Any) -> int:
        """Write an entry through to the disk; returns where the journal ended before.

        Raises:
            TooltipError: it cannot be written; the journal is as it was.
        """
        text = json.dumps(entry, separators=(",", ":")).encode() + b"\n"
        end = os.lseek(self._descriptor, 0, os.SEEK_END)
        line = _checksum(text) + b" " + text
        try:
            if os.write(self._descriptor, line) < len(line):
                raise OSError(None, "the disk is full")
            os.fsync(self._descriptor)
        except OSError as error:
            self.rewind(end)
            raise TooltipError(f"{self.path}: cannot be written ({error.strerror})") from error
        return end

    def rewind(self, end: int) -> None:
        """Forget everything past a place that :meth:`append` returned."""
        os.ftruncate(self._descriptor, end)

    def remove(self) -> None:
        """Delete the file; for a session that has ended in good order."""
        self.path.unlink(missing_ok=True)


def _checksum(text: bytes) -> bytes:
    return b"%08x" % zlib.crc32(text)


@contextmanager
def open_journal(labels: Path) -> Iterator[Journal]:
    """Open and lock the journal of a label file.

    The lock is the operating system's: it ends with the process, however that ends.

    Raises:
        TooltipError: another process edits these labels, or no file can be made beside them.
    """
    path = labels.with_name(labels.name + SUFFIX)
    descriptor = _locked(path, labels)
    try:
        yield Journal(path, descriptor)
    finally:
        os.close(descriptor)


def _locked(path: Path, labels: Path) -> int:
    while True:
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise TooltipError(
                f"{path}: cannot be written ({error.strerror}); name another directory with --out"
            ) from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(descriptor)
            raise TooltipError(
                f"{labels} is being edited by another 'tooltip label'; use its page, or stop it "
                "first"
            ) from error
        # whoever held the lock before may have removed the file since it was opened here
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(descriptor), path.stat()):
                return descriptor
        os.close(descriptor)
