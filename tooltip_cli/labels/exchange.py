"""Labels from and for other tools: whose a file is, and what its frames and pixels mean here."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from tooltip_cli.errors import TooltipError, one_of
from tooltip_cli.labels.book import Rows, TipLabel
from tooltip_cli.labels.formats.base import Album, Foreign, Mark, parse_json, read_text
from tooltip_cli.labels.formats.coco import is_coco, read_coco, write_coco
from tooltip_cli.labels.formats.cvat import read_cvat, write_cvat
from tooltip_cli.labels.formats.deeplabcut import (
    is_deeplabcut,
    read_deeplabcut,
    write_deeplabcut,
)
from tooltip_cli.labels.formats.labelme import is_labelme, read_labelme, write_labelme
from tooltip_cli.labels.formats.labelstudio import read_label_studio, write_label_studio

WRITERS: Mapping[str, Callable[[Album], str | dict[str, str]]] = {
    "cvat": write_cvat,
    "coco": write_coco,
    "labelstudio": write_label_studio,
    "labelme": write_labelme,
    "deeplabcut": write_deeplabcut,
}
"""By the name of the format: what it holds, or the files of a folder by name."""

_NUMBER = re.compile(r"(\d+)(?:\.[^.]*)?$")


@dataclass(frozen=True)
class Place:
    """What the frames and points of another tool's file are in a recording."""

    stamps_ns: Sequence[int]  # of all images, ascending
    numbered: Sequence[int]  # indices of the images that the file's numbers count
    size: tuple[int, int]  # width, height
    first: int = 0  # number of the first of them


@dataclass(frozen=True)
class Choice:
    """What to take from a file, where it could mean several things; None: the only one."""

    point: str | None = None
    annotator: str | None = None
    corner: bool | None = None  # whether pixels count from the corner; None: as the tool does
    labeler: str | None = None  # written into every row; None: who the file names


def read_foreign(path: Path) -> Foreign:
    """Read a file of another tool, or a folder of labelme's; its content says whose it is.

    Raises:
        TooltipError: it is of none of the tools, or malformed.
    """
    if path.is_dir():
        files = sorted(path.glob("*.json"))
        documents = [(parse_json(read_text(file), str(file)), str(file)) for file in files]
        chosen = [item for item in documents if is_labelme(item[0])]
        if not chosen:
            raise TooltipError(f"{path} holds no JSON file as labelme writes them")
        return read_labelme(chosen, str(path))
    text = read_text(path)
    start = text.lstrip()[:1]
    if start == "<":
        return read_cvat(text, str(path))
    if is_deeplabcut(text):
        return read_deeplabcut(text, str(path))
    if start in ("{", "["):
        document = parse_json(text, str(path))
        if isinstance(document, list):
            return read_label_studio(document, str(path))
        if is_labelme(document):
            return read_labelme([(document, str(path))], str(path))
        if is_coco(document):
            return read_coco(document, str(path))
    raise TooltipError(
        f"{path}: expected CVAT XML, COCO keypoints JSON, Label Studio JSON, labelme JSON or a "
        "DeepLabCut CSV, and found none of them"
    )


def adopt(foreign: Foreign, place: Place, choice: Choice) -> Rows:
    """Return a file's labels by image stamp, pixels as everywhere here: centres at integers.

    Raises:
        TooltipError: a frame or a pixel that the recording does not have, images of another size,
            several points or people, or two labels of one frame.
    """
    marks = _chosen(foreign, choice)
    corner = foreign.corner if choice.corner is None else choice.corner
    by_stamp = {str(stamp): index for index, stamp in enumerate(place.stamps_ns)}
    rows: dict[int, TipLabel] = {}
    for mark in marks:
        if mark.size not in (None, place.size):
            raise TooltipError(
                f"{foreign.source}: image {mark.image} measures {_times(mark.size)}, but those of "
                f"the recording {_times(place.size)}; export the labels at the recorded size"
            )
        stamp = place.stamps_ns[_index(mark.image, by_stamp, place, foreign.source)]
        pixel = _pixel(mark, corner, place.size, foreign.source)
        row = TipLabel(mark.state, pixel, choice.labeler or mark.labeler or foreign.tool)
        if rows.setdefault(stamp, row) != row:
            raise TooltipError(
                f"{foreign.source}: two labels of image {mark.image}; if two people made them, "
                "choose one with --annotator"
            )
    return rows


def _chosen(foreign: Foreign, choice: Choice) -> list[Mark]:
    marks = list(foreign.marks)
    people = {mark.labeler for mark in marks if mark.labeler is not None}
    if choice.annotator is not None:
        if choice.annotator not in people:
            raise TooltipError(
                f"{foreign.source}: " + one_of("annotator", choice.annotator, people)
            )
        marks = [mark for mark in marks if mark.labeler == choice.annotator]
    names = {mark.point for mark in marks if mark.point is not None}
    if choice.point is not None and choice.point not in names:
        raise TooltipError(f"{foreign.source}: " + one_of("point", choice.point, names))
    if choice.point is None and len(names) > 1:
        raise TooltipError(
            f"{foreign.source} has several points: {', '.join(sorted(names))}; choose the tip with "
            "--point"
        )
    wanted = {None, *names} if choice.point is None else {None, choice.point}
    return [mark for mark in marks if mark.point in wanted]


def _index(image: int | str, by_stamp: Mapping[str, int], place: Place, source: str) -> int:
    """Return the index of an image that is given by number, by stamp, or by a name with either."""
    digits = str(image)
    if isinstance(image, str):
        found = _NUMBER.search(image)
        if found is None:
            raise TooltipError(
                f"{source}: the image name {image!r} ends in no number; expected the image's stamp "
                "in nanoseconds or its place in the recording, such as 1700000000123456789.jpg or "
                "frame_000012.png"
            )
        digits = found[1]
        if digits in by_stamp:
            return by_stamp[digits]
    number = int(digits) - place.first
    if not 0 <= number < len(place.numbered):
        raise TooltipError(
            f"{source}: the recording has no image {image}; numbers count {len(place.numbered)} "
            f"images from {place.first} (see --numbers and --first), and no image has that stamp"
        )
    return place.numbered[number]


def _pixel(
    mark: Mark, corner: bool, size: tuple[int, int], source: str
) -> tuple[float, float] | None:
    if mark.pixel is None:
        return None
    u, v = (round(value - 0.5 * corner, 2) for value in mark.pixel)
    if not (-0.5 <= u <= size[0] - 0.5 and -0.5 <= v <= size[1] - 0.5):
        raise TooltipError(
            f"{source}: the point ({u}, {v}) of image {mark.image} lies outside the {_times(size)} "
            "image"
        )
    return u, v


def _times(size: tuple[int, int] | None) -> str:
    return "nothing" if size is None else f"{size[0]}x{size[1]}"
