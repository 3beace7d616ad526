"""COCO keypoints JSON.

Format: COCO's "Data format", keypoint detection: ``[x1, y1, v1, ...]``, 0-indexed; v = 0 is not
labelled (and then x = y = 0), 1 labelled but not visible, 2 visible.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

from tooltip_cli.labels.files import STATES
from tooltip_cli.labels.formats.base import POINT, Album, Foreign, Mark, json_text, malformed

TOOL = "COCO"
_NOT_LABELLED = "visibility 0: not labelled"
_CORNER_NOTE = (
    "the annotations carry 'occluded' as CVAT's COCO exports do, and CVAT counts pixels from the "
    "image's corner; if it wrote this file, add --origin corner"
)


def is_coco(document: Any) -> bool:
    """Say whether a JSON document has COCO's parts."""
    return isinstance(document, dict) and {"images", "annotations"} <= document.keys()


def read_coco(document: Any, source: str) -> Foreign:
    """Read COCO keypoints; visibility 0 is no label, 1 an occluded tip.

    Raises:
        TooltipError: it is malformed.
    """
    left_out: Counter[str] = Counter()
    try:
        images = {image["id"]: image for image in document["images"]}
        names = {item["id"]: item["keypoints"] for item in document["categories"]}
        annotations = document["annotations"]
        marks = tuple(
            mark
            for annotation in annotations
            for mark in _marks(
                annotation,
                images[annotation["image_id"]],
                names[annotation["category_id"]],
                left_out,
            )
        )
        from_cvat = any("occluded" in item.get("attributes", ()) for item in annotations)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise malformed(source, "COCO keypoints", error) from error
    return Foreign(source, TOOL, False, marks, left_out, (_CORNER_NOTE,) if from_cvat else ())


def _marks(
    annotation: Mapping[str, Any],
    image: Mapping[str, Any],
    names: list[str],
    left_out: Counter[str],
) -> Iterator[Mark]:
    numbers = annotation["keypoints"]
    if len(numbers) != 3 * len(names):
        raise ValueError(f"{len(numbers)} numbers for {len(names)} keypoints")
    file, size = str(image["file_name"]), (int(image["width"]), int(image["height"]))
    said = annotation.get("attributes", {}).get("state")  # as our own exports say it
    for place, name in enumerate(names):
        u, v, visibility = numbers[3 * place : 3 * place + 3]
        if visibility == 0 and said in STATES[1:]:
            yield Mark(file, name, said, size=size)
        elif visibility == 0:
            left_out[_NOT_LABELLED] += 1
        elif visibility == 1:
            yield Mark(file, name, "occluded", size=size)
        elif visibility == 2:
            yield Mark(file, name, "visible", (float(u), float(v)), size=size)
        else:
            raise ValueError(f"visibility {visibility!r} of a keypoint in {file}")


def write_coco(album: Album) -> str:
    """Return labels as COCO keypoints; a tip without a place has visibility 0 and its state."""
    width, height = album.size
    images = [
        {"id": number, "file_name": frame.name, "width": width, "height": height}
        for number, frame in enumerate(album.frames, start=1)
    ]
    annotations: list[dict[str, Any]] = []
    for number, frame in enumerate(album.frames, start=1):
        label = frame.label
        if label is None:
            continue
        u, v = label.pixel or (0, 0)
        annotations.append(
            {
                "id": len(annotations) + 1,
                "image_id": number,
                "category_id": 1,
                "iscrowd": 0,
                "area": 0,
                "bbox": [u, v, 0, 0],
                "keypoints": [u, v, 2 if label.pixel else 0],
                "num_keypoints": 1 if label.pixel else 0,
                "attributes": {"state": label.state, "labeler": label.labeler},
            }
        )
    category = {"id": 1, "name": "tool", "supercategory": "", "keypoints": [POINT], "skeleton": []}
    info = {"description": f"tool tips of {album.name}"}
    return json_text(
        {
            "info": info,
            "licenses": [],
            "images": images,
            "annotations": annotations,
            "categories": [category],
        }
    )
