"""Cached artifacts: keys, places and whole-or-nothing writing.

An artifact is reused when, and only when, its key is unchanged: the SHA-256 over the stage, its
version, its parents' keys, its parameters, and what it depends on of the rig.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tooltip_cli import __version__
from tooltip_cli.errors import TooltipError
from tooltip_cli.log.whole import write_file


def stage_key(stage: str, version: int, parents: Mapping[str, str], parameters: Any) -> str:
    """Return the key of what a stage makes from its parents with its parameters.

    Args:
        parents: role -> key or content hash.
        parameters: anything that :func:`canonical` takes.
    """
    text = canonical(
        {"stage": stage, "version": version, "parents": dict(parents), "parameters": parameters}
    )
    return hashlib.sha256(text.encode()).hexdigest()


def canonical(value: Any) -> str:
    """Return JSON with one spelling for equal values; dataclasses and arrays are taken apart."""
    return json.dumps(plain(value), sort_keys=True, separators=(",", ":"))


def plain(value: Any) -> Any:
    """Return a value as what JSON has; not-a-number becomes null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = dataclasses.fields(value)
        return {field.name: plain(getattr(value, field.name)) for field in fields}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value


def digest(value: Any) -> str:
    """Return the SHA-256 of a value's canonical form; arrays by their bytes' shape and content."""
    if isinstance(value, np.ndarray):
        sha = hashlib.sha256(f"{value.dtype}{value.shape}".encode())
        sha.update(np.ascontiguousarray(value).tobytes())
        return sha.hexdigest()
    return hashlib.sha256(canonical(value).encode()).hexdigest()


def provenance(recording: Path, sha256: str, key: str, parameters: Any) -> dict[str, Any]:
    """Return where an artifact comes from, for people and for :func:`stored_key`."""
    now = datetime.datetime.now(datetime.timezone.utc)
    return {
        "recording": recording.name,
        "recording_sha256": sha256,
        "parameters": plain(parameters),
        "version": __version__,
        "created": now.isoformat(timespec="seconds"),
        "key": key,
    }


def artifact_path(recording: Path, suffix: str, out: Path | None) -> Path:
    """Return where a stage writes: under ``out``, else beside the recording."""
    return (out or recording.parent) / f"{recording.stem}{suffix}"


def known_places(recording: Path, suffix: str, out: Path | None) -> list[Path]:
    """Return where a later stage looks: under ``out`` first, then beside the recording."""
    places = [artifact_path(recording, suffix, out), artifact_path(recording, suffix, None)]
    return list(dict.fromkeys(places))


def find_artifact(recording: Path, suffix: str, out: Path | None) -> Path | None:
    """Return the first of the known places where a file is; None where there is none."""
    for place in known_places(recording, suffix, out):
        with contextlib.suppress(OSError):  # a name that no file can have
            if place.exists():
                return place
    return None


def ensure_directory(path: Path) -> None:
    """Create a directory for artifacts.

    Raises:
        TooltipError: it cannot be created.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TooltipError(f"{path}: cannot be created ({error.strerror})") from error


def write_whole(path: Path, data: str | bytes) -> None:
    """Write an artifact whole or not at all, and its directory where that is missing.

    Raises:
        TooltipError: it cannot be written.
    """
    ensure_directory(path.parent)
    write_file(path, data)


def read_json(path: Path) -> Any | None:
    """Return a JSON artifact, or None where it is absent or not JSON (then it is made anew)."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
