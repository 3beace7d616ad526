"""Small files that are written whole or not at all."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from tooltip_cli.errors import TooltipError


def write_file(path: Path, data: str | bytes) -> None:
    """Write a file under a temporary name and rename it, so that it is whole or absent.

    Raises:
        TooltipError: it cannot be written.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        temporary.write_bytes(data.encode() if isinstance(data, str) else data)
        temporary.replace(path)
    except OSError as error:
        raise TooltipError(f"{path}: cannot be written ({error.strerror})") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()
