"""Writing a recording so that it survives: power cuts, ``kill -9``, full disks, Ctrl-C.

While it is written the file is called ``OUT.mcap.unfinished``. Messages reach the disk in chunks,
as soon as one is full and at least every half second, so a file that nobody closed lacks at most
its last moment; ``tooltip salvage`` recovers the rest. Only a file that was finished gets the name
``OUT.mcap``, and what is unfinished is never overwritten.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from tooltip_cli.errors import LowDiskError, TooltipError
from tooltip_cli.log.messages import Message
from tooltip_cli.log.whole import check_absent, disk_errors
from tooltip_cli.log.writer import MessageWriter

UNFINISHED = ".unfinished"
FLUSH_EVERY_S = 0.5
MIN_FREE_BYTES = 100_000_000


class CrashSafeWriter(MessageWriter):
    """Writes one MCAP file so that what was written is never lost.

    ::

        with CrashSafeWriter(Path("pliers.mcap")) as writer:
            for message in received:
                writer.write(message)

    When the block ends well the file is finished and gets its name. When it ends with an exception
    the file is finished too, where the disk still allows it, but stays ``OUT.mcap.unfinished``;
    :meth:`discard` removes it instead. Any thread may write.

    Args:
        path: the name of the finished file.
        overwrite: replace ``path``, when finished, where it exists.
        min_free_bytes: stop before the disk has less than this left.
        flush_every_s: longest time that a message waits in memory, seconds; None: chunks go by
            size alone, so that equal messages give equal bytes.

    Raises:
        TooltipError: the file exists and ``overwrite`` is false, or the disk takes no more.
        LowDiskError: less than ``min_free_bytes`` are left; raised before the file is made, and by
            :meth:`write`. All earlier messages are in the file: who catches it inside the block and
            leaves well gets a finished file.
    """

    def __init__(
        self,
        path: Path,
        *,
        overwrite: bool = False,
        min_free_bytes: int = MIN_FREE_BYTES,
        flush_every_s: float | None = FLUSH_EVERY_S,
    ) -> None:
        super().__init__(path, overwrite=overwrite)
        self._overwrite = overwrite
        self._min_free, self._every = min_free_bytes, flush_every_s
        self._lock = threading.RLock()
        self._closing = threading.Event()
        self._failure: TooltipError | None = None
        self._low: LowDiskError | None = None
        self._checked_bytes = 0
        self._begun = self._discarded = False

    def __enter__(self) -> CrashSafeWriter:
        with disk_errors(self._path):
            self._check_space()
            if self._low is not None:
                raise self._low
            self._file, self._unfinished = _create(self._path)
            self._start(self._file)
            _sync_directory(self._path)
        self._flusher = threading.Thread(target=self._keep_flushing, daemon=True)
        self._flusher.start()
        return self

    @property
    def unfinished_path(self) -> Path:
        """Where the file is until it is finished."""
        return self._unfinished

    @property
    def written_bytes(self) -> int:
        """Size of the file so far."""
        return self._mcap.intact_bytes

    def write(self, message: Message) -> None:
        """Append a message; it is on the disk ``flush_every_s`` later at the latest.

        Raises:
            LowDiskError: too little space is left; this message is not written.
            TooltipError: the topic has another type, or the disk takes no more.
        """
        if self._low is not None:
            raise self._low
        super().write(message)
        if not self._begun:
            # at once, so that even the shortest recording is not an empty file
            self._begun = True
            self.flush()

    def flush(self) -> None:
        """Write what waits in memory and return when it is on the disk.

        Raises:
            TooltipError: the disk takes no more.
        """
        with self._writing():
            self._mcap.flush()
        # outside the lock: a slow disk must not keep anybody from writing
        with disk_errors(self._path):
            os.fdatasync(self._file.fileno())

    def discard(self) -> None:
        """Remove the file when the block ends, however it ends."""
        self._discarded = True

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._closing.set()
        self._flusher.join()
        try:
            if self._discarded:
                with contextlib.suppress(OSError):
                    self._unfinished.unlink()
                return
            self._finish()
            if kind is not None:
                return
            if self._failure is not None:
                raise self._failure
            with disk_errors(self._path):
                # somebody else may have come first meanwhile
                check_absent(self._path, overwrite=self._overwrite)
                self._unfinished.replace(self._path)
                _sync_directory(self._path)
        finally:
            self._file.close()

    def _finish(self) -> None:
        """Close the file behind its last complete record, with a summary where that still fits."""
        with contextlib.suppress(OSError):
            self._cut()
            if self._tried(self._mcap.finish):
                return
            # no room for all that waits: some of it, one by one, and the summary may still fit
            self._cut()
            while self._mcap.waiting and self._tried(lambda: self._mcap.flush(limit=1)):
                pass
            self._cut()
            self._mcap.drop_waiting()
            if not self._tried(self._mcap.finish):
                self._cut()

    def _tried(self, write: Callable[[], None]) -> bool:
        """Whether something could be written."""
        try:
            with self._writing(ignore_failure=True):
                write()
                os.fsync(self._file.fileno())
        except TooltipError:
            return False
        return True

    def _cut(self) -> None:
        """Remove what a failed write has left behind the last complete record."""
        self._file.seek(self._mcap.intact_bytes)
        self._file.truncate()

    def _keep_flushing(self) -> None:
        while not self._closing.wait(self._every):
            try:
                self.flush()
            except TooltipError:
                return  # kept as the failure that the next write raises

    @contextlib.contextmanager
    def _writing(self, *, ignore_failure: bool = False) -> Iterator[None]:
        with self._lock:
            if self._failure is not None and not ignore_failure:
                raise self._failure
            try:
                yield
                if self._mcap.intact_bytes != self._checked_bytes:
                    self._check_space()
                    self._checked_bytes = self._mcap.intact_bytes
            except OSError as error:
                self._failure = self._failure or TooltipError(
                    f"{self._path}: cannot be written ({error.strerror}); what came before is in "
                    f"{self._unfinished}, and 'tooltip salvage' makes a recording of it"
                )
                raise self._failure from error

    def _check_space(self) -> None:
        free = shutil.disk_usage(self._path.parent).free
        if free < self._min_free:
            self._low = LowDiskError(
                f"{self._path}: the disk has {free / 1e6:.0f} MB left, less than the "
                f"{self._min_free / 1e6:.0f} MB to be kept free; free some space, or lower "
                "--min-free"
            )


def leftovers(path: Path) -> list[Path]:
    """Return what earlier recordings of this name have left unfinished."""
    return [place for place in _places(path) if place.exists()]


def _places(path: Path) -> list[Path]:
    first = path.with_name(path.name + UNFINISHED)
    return [first, *(first.with_name(f"{first.name}.{number}") for number in range(1, 100))]


def _create(path: Path) -> tuple[BinaryIO, Path]:
    for place in _places(path):
        with contextlib.suppress(FileExistsError):
            return place.open("xb", buffering=0), place
    raise TooltipError(
        f"{path}: a hundred unfinished recordings lie beside it; recover or remove them"
    )


def _sync_directory(path: Path) -> None:
    """Make a new name outlive a power cut."""
    descriptor = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
