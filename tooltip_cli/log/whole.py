"""Files that are written whole or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from tooltip_cli.errors import TooltipError


@contextlib.contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Turn what the operating system says about writing a file into one line."""
    try:
        yield
    except OSError as error:
        raise TooltipError(f"{path}: cannot be written ({error.strerror})") from error


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """Yield a file, without a buffer, that gets its name when the block ends well.

    Until then it has a temporary name beside it; when the block fails nothing remains.

    Raises:
        TooltipError: it cannot be written.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    with contextlib.ExitStack() as stack:
        with disk_errors(path):
            file = stack.enter_context(temporary.open("w+b", buffering=0))
        stack.callback(_remove, temporary)
        yield file
        with disk_errors(path):
            os.fsync(file.fileno())
            temporary.replace(path)


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink()


def write_file(path: Path, data: str | bytes) -> None:
    """Write a small file whole or not at all.

    Raises:
        TooltipError: it cannot be written.
    """
    with whole_file(path) as file, disk_errors(path):
        view = memoryview(data.encode() if isinstance(data, str) else data)
        while view:  # a disk that is almost full takes a part
            view = view[file.write(view) :]


def check_absent(path: Path, *, overwrite: bool) -> None:
    """Refuse to replace a file that nobody asked to replace.

    Raises:
        TooltipError: it exists and ``overwrite`` is false, or its name cannot be one.
    """
    with disk_errors(path):
        exists = path.exists()
    if exists and not overwrite:
        raise TooltipError(f"{path} exists; give another name, or --force to replace it")
