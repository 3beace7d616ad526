"""Small shelves of recordings of the wrist."""

from __future__ import annotations

import csv
import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

from tests.helpers.logs import wrist_parts, write_log, write_true_labels
from tooltip_cli.log.container import LoggedMessage, iterate

TIMED = ("created", "seconds", "seconds_estimate", "seconds_evaluate")
METHOD = ("--method", "kmeans")


def make_shelf(folder: Path, wrist: Path, count: int = 3) -> Path:
    """Copy the wrist several times, label the first, and add one that is cut off."""
    (folder / "sub").mkdir(parents=True)
    for number in range(count):
        parent = folder / "sub" if number % 2 else folder
        shutil.copy(wrist, parent / f"w{number}.mcap")
    write_true_labels(folder / "w0.labels.csv", range(0, 40, 4))
    (folder / "cut.mcap").write_bytes(wrist.read_bytes()[:50_000])
    return folder


def hoard(path: Path) -> Path:
    """Write a log of less than a megabyte that takes 1.6 GB to read: joint states full of zeros."""
    parts = wrist_parts()
    parts["joints"] = [
        replace(message, payload=message.payload + bytes(8 << 20))
        for message in parts["joints"][:200]
    ]
    return write_log(path, parts)


def table(path: Path) -> dict[str, dict[str, str]]:
    """Return the rows of a results table by name, without what depends on the clock."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {
        row["name"]: {key: value for key, value in row.items() if key not in TIMED} for row in rows
    }


def contents(out: Path, without: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return everything under a folder of results, without what depends on the clock.

    Logs are their messages; ``without`` names further keys of JSON files to leave out.
    """
    found: dict[str, Any] = {}
    for path in sorted(path for path in (out / "recordings").rglob("*") if path.is_file()):
        name = str(path.relative_to(out))
        if path.suffix == ".json":
            document = _timeless(json.loads(path.read_text()))
            found[name] = {key: item for key, item in document.items() if key not in without}
        elif path.suffix == ".mcap":
            messages = [item for item in iterate(path) if isinstance(item, LoggedMessage)]
            sha = hashlib.sha256(b"".join(item.payload for item in messages))
            found[name] = f"{len(messages)} messages, {sha.hexdigest()}"
        else:
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _timeless(item) for key, item in value.items() if key not in TIMED}
    return [_timeless(item) for item in value] if isinstance(value, list) else value


def stamps(out: Path) -> dict[str, int]:
    """Return when each row was last written."""
    return {
        str(path.parent.relative_to(out / "recordings")): path.stat().st_mtime_ns
        for path in (out / "recordings").rglob("row.json")
    }
