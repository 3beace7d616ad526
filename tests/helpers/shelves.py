"""Small shelves of recordings of the wrist."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

from tests.helpers.logs import write_true_labels

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


def table(path: Path) -> dict[str, dict[str, str]]:
    """Return the rows of a results table by name, without what depends on the clock."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {
        row["name"]: {key: value for key, value in row.items() if key not in TIMED} for row in rows
    }


def artifacts(out: Path) -> dict[str, Any]:
    """Return every JSON file under a folder of results, without what depends on the clock."""
    return {
        str(path.relative_to(out)): _timeless(json.loads(path.read_text()))
        for path in sorted((out / "recordings").rglob("*.json"))
    }


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
