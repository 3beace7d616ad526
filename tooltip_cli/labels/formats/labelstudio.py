"""Label Studio's JSON export.

Format: Label Studio's guide, "Export annotations", and the tag KeyPointLabels: x and y are percent
of the image's width and height, from its top left corner.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any
from urllib.parse import unquote

from tooltip_cli.labels.book import TipLabel
from tooltip_cli.labels.files import STATES
from tooltip_cli.labels.formats.base import POINT, Album, Foreign, Mark, json_text, malformed

TOOL = "Label Studio"
_CANCELLED = "skipped by their annotator"
_OTHER = "results that are neither keypoints nor states"


def read_label_studio(document: Any, source: str) -> Foreign:
    """Read keypoints, and choices named like our states, of the JSON export (not JSON_MIN).

    Raises:
        TooltipError: it is malformed, or an image was turned while it was labelled.
    """
    left_out: Counter[str] = Counter()
    try:
        marks = tuple(mark for task in document for mark in _task(task, left_out))
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise malformed(source, f"{TOOL} (export as JSON)", error) from error
    return Foreign(source, TOOL, True, marks, left_out)


def _task(task: Mapping[str, Any], left_out: Counter[str]) -> Iterator[Mark]:
    data = task["data"]
    address = data["image"] if "image" in data else _only_text(data)
    # an address, a path, or /data/local-files/?d=path
    name = re.split(r"[/\\=]", unquote(address))[-1]
    for annotation in task["annotations"]:
        if annotation.get("was_cancelled"):
            left_out[_CANCELLED] += 1
            continue
        labeler = _labeler(annotation.get("completed_by"))
        for result in annotation["result"]:
            mark = _mark(result, name, labeler)
            if mark is None:
                left_out[_OTHER] += 1
            else:
                yield mark


def _only_text(data: Mapping[str, Any]) -> str:
    texts = [value for value in data.values() if isinstance(value, str)]
    if len(texts) != 1:
        raise ValueError("no 'image' in the data of a task")
    return texts[0]


def _labeler(completed_by: Any) -> str | None:
    if isinstance(completed_by, Mapping):  # since 1.6 a person may be written out
        completed_by = completed_by.get("email") or completed_by.get("id")
    return None if completed_by is None else str(completed_by)


def _mark(result: Mapping[str, Any], name: str, labeler: str | None) -> Mark | None:
    value = result.get("value", {})
    if result.get("type") == "choices":
        (choice, *more) = value["choices"]
        known = not more and choice in STATES[1:]
        return Mark(name, None, choice, labeler=labeler) if known else None
    if result.get("type") != "keypointlabels":
        return None
    if result.get("image_rotation", 0) != 0:
        raise ValueError(f"{name} was turned by {result['image_rotation']} degrees")
    size = int(result["original_width"]), int(result["original_height"])
    u, v = (float(value[axis]) / 100 * side for axis, side in zip("xy", size, strict=True))
    (point,) = value["keypointlabels"]
    return Mark(name, point, "visible", (u, v), labeler, size)


def write_label_studio(album: Album) -> str:
    """Return labels as tasks to import, a tip without a place as a choice."""
    tasks = [
        {
            "id": number,
            "data": {"image": frame.name},
            "annotations": [
                {
                    "id": number,
                    "completed_by": {"email": frame.label.labeler},
                    "was_cancelled": False,
                    "result": [_result(frame.label, album.size)],
                }
            ]
            if frame.label
            else [],
        }
        for number, frame in enumerate(album.frames, start=1)
    ]
    return json_text(tasks)


def _result(label: TipLabel, size: tuple[int, int]) -> dict[str, Any]:
    width, height = size
    shared = {"to_name": "image", "original_width": width, "original_height": height}
    if label.pixel is None:
        return {
            "type": "choices",
            "from_name": "state",
            "value": {"choices": [label.state]},
            **shared,
        }
    u, v = label.pixel
    value = {
        "x": 100 * (u + 0.5) / width,
        "y": 100 * (v + 0.5) / height,
        "width": 0.5,
        "keypointlabels": [POINT],
    }
    return {
        "type": "keypointlabels",
        "from_name": "kp",
        "image_rotation": 0,
        "value": value,
        **shared,
    }
