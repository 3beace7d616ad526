"""labelme's JSON, a file for each image.

Format: what labelme's ``LabelFile`` saves. Coordinates count from the image's top left corner.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from tooltip_cli.labels.files import STATES
from tooltip_cli.labels.formats.base import (
    POINT,
    Album,
    Foreign,
    Mark,
    Shown,
    json_text,
    malformed,
)

TOOL = "labelme"
_OTHER = "shapes that are no points"


def is_labelme(document: Any) -> bool:
    """Say whether a JSON document has labelme's parts."""
    return isinstance(document, dict) and {"shapes", "imagePath"} <= document.keys()


def read_labelme(documents: Sequence[tuple[Any, str]], source: str) -> Foreign:
    """Read the (document, source) of a folder's files; flags named like our states are states.

    Raises:
        TooltipError: one is malformed.
    """
    left_out: Counter[str] = Counter()
    marks: list[Mark] = []
    for document, place in documents:
        try:
            marks += _marks(document, left_out)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise malformed(place, TOOL, error) from error
    return Foreign(source, TOOL, True, tuple(marks), left_out)


def _marks(document: Mapping[str, Any], left_out: Counter[str]) -> Iterator[Mark]:
    image = document["imagePath"].replace("\\", "/")
    size = int(document["imageWidth"]), int(document["imageHeight"])
    said = _state(document.get("flags"))
    if said is not None:
        yield Mark(image, None, said, size=size)
        return
    for shape in document["shapes"]:
        if shape.get("shape_type") != "point":
            left_out[_OTHER] += 1
            continue
        ((u, v),) = shape["points"]
        state = _state(shape.get("flags"))
        pixel = (float(u), float(v)) if state is None else None
        yield Mark(image, shape["label"], state or "visible", pixel, size=size)


def _state(flags: Mapping[str, Any] | None) -> str | None:
    return next((state for state in STATES[1:] if (flags or {}).get(state)), None)


def write_labelme(album: Album) -> dict[str, str]:
    """Return the files of a folder by name, one for each image."""
    return {
        f"{frame.name.rsplit('.', 1)[0]}.json": json_text(_document(frame, album.size))
        for frame in album.frames
    }


def _document(frame: Shown, size: tuple[int, int]) -> dict[str, Any]:
    label = frame.label
    shapes: list[dict[str, Any]] = []
    if label is not None and label.pixel is not None:
        u, v = label.pixel
        shapes.append(
            {
                "label": POINT,
                "points": [[u + 0.5, v + 0.5]],
                "group_id": None,
                "description": "",
                "shape_type": "point",
                "flags": {},
                "mask": None,
            }
        )
    return {
        "version": "5.5.0",  # of labelme, whose layout this is
        "flags": {state: label is not None and label.state == state for state in STATES[1:]},
        "shapes": shapes,
        "imagePath": frame.name,
        "imageData": None,
        "imageHeight": size[1],
        "imageWidth": size[0],
    }
