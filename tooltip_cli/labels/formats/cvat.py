"""CVAT 1.1 XML, "for video" and "for images".

Format: CVAT's manual, "XML annotation format". A frame's number is that of the video, also where a
task takes every n-th frame of a part of it. Coordinates count from the image's top left corner.
"""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from xml.etree import ElementTree

from tooltip_cli.errors import TooltipError
from tooltip_cli.labels.files import STATES
from tooltip_cli.labels.formats.base import POINT, Album, Foreign, Mark, Shown, malformed

TOOL = "CVAT"
_INTERPOLATED = "between keyframes, placed by CVAT and not by a person"
_OUTSIDE = "outside: no label, as CVAT also writes it to end a track"
_STATE = "state"  # attribute by which our own exports say that the tip is out of view


class _NoDocumentType(ElementTree.TreeBuilder):
    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise ValueError("a document type, which CVAT does not write")


def read_cvat(text: str, source: str) -> Foreign:
    """Read a CVAT XML file; only keyframes are labels.

    Raises:
        TooltipError: it is malformed.
    """
    left_out: Counter[str] = Counter()
    try:
        parser = ElementTree.XMLParser(target=_NoDocumentType())  # noqa: S314 - as above
        root = ElementTree.parse(io.StringIO(text), parser).getroot()  # noqa: S314 - as above
        if root.tag != "annotations":
            raise ValueError(f"found <{root.tag}>, expected <annotations>")
        size = _size(root)
        marks = [replace(mark, size=size) for mark in _tracks(root, left_out)]
        marks += _images(root)
    except (ElementTree.ParseError, ValueError, TypeError, KeyError) as error:
        raise malformed(source, TOOL, error) from error
    return Foreign(source, TOOL, True, tuple(marks), left_out)


def _size(root: ElementTree.Element) -> tuple[int, int] | None:
    found = root.find("meta//original_size")
    if found is None:
        return None
    return int(found.findtext("width", "")), int(found.findtext("height", ""))


def _tracks(root: ElementTree.Element, left_out: Counter[str]) -> Iterator[Mark]:
    for track in root.iterfind("track"):
        for shape in track:
            frame, key = shape.get("frame"), shape.get("keyframe") == "1"
            for point in shape.iter("points"):  # the shape itself, or those of a skeleton
                name = point.get("label") or track.attrib["label"]
                state = point.findtext(f"attribute[@name='{_STATE}']")
                if not key and point.get("keyframe") != "1":
                    left_out[_INTERPOLATED] += 1
                elif point.get("outside") == "1" and state not in STATES[1:]:
                    left_out[_OUTSIDE] += 1
                else:
                    yield _mark(int(frame or ""), name, point, state)


def _images(root: ElementTree.Element) -> Iterator[Mark]:
    for image in root.iterfind("image"):
        name = image.attrib["name"]
        size = int(image.attrib["width"]), int(image.attrib["height"])
        for holder in image:
            if holder.tag == "tag" and holder.get("label") in STATES[1:]:
                yield Mark(name, None, holder.attrib["label"], size=size)
            for point in holder.iter("points"):
                if point.get("outside") != "1":
                    yield replace(_mark(name, point.attrib["label"], point, None), size=size)


def _mark(image: int | str, name: str, point: ElementTree.Element, state: str | None) -> Mark:
    if state in STATES[1:] or point.get("occluded") == "1":
        return Mark(image, name, state if state in STATES[1:] else "occluded")
    pairs = point.attrib["points"].split(";")
    if len(pairs) != 1:
        raise ValueError(f"{len(pairs)} points in one shape of image {image}; a tip is one")
    u, v = map(float, pairs[0].split(","))
    return Mark(image, name, "visible", (u, v))


def write_cvat(album: Album) -> str:
    """Return labels as CVAT for video 1.1: as CVAT writes single shapes, a track each."""
    width, height = album.size
    labelled = [frame for frame in album.frames if frame.label is not None]
    tracks = "".join(_track(number, frame, album.size) for number, frame in enumerate(labelled))
    states = "\n".join(STATES)
    return f"""<?xml version="1.0" encoding="utf-8"?>
<annotations>
  <version>1.1</version>
  <meta>
    <task>
      <mode>interpolation</mode>
      <labels>
        <label>
          <name>{POINT}</name>
          <type>points</type>
          <attributes>
            <attribute>
              <name>{_STATE}</name>
              <mutable>True</mutable>
              <input_type>select</input_type>
              <default_value>visible</default_value>
              <values>{states}</values>
            </attribute>
          </attributes>
        </label>
      </labels>
      <original_size>
        <width>{width}</width>
        <height>{height}</height>
      </original_size>
    </task>
  </meta>
{tracks}</annotations>
"""


def _track(number: int, frame: Shown, size: tuple[int, int]) -> str:
    label = frame.label
    if label is None:
        raise TooltipError(f"frame {frame.image} has no label")
    # a shape needs a place, also where the tip has none: the middle of the image
    u, v = label.pixel or (size[0] / 2 - 0.5, size[1] / 2 - 0.5)
    place = f"{u + 0.5:.2f},{v + 0.5:.2f}"
    hidden = int(label.state == "out_of_view")
    occluded = int(label.state == "occluded")
    attribute = f'<attribute name="{_STATE}">{label.state}</attribute>'
    return (
        f'  <track id="{number}" label="{POINT}" source="manual">\n'
        f'    <points frame="{frame.image}" keyframe="1" outside="{hidden}" '
        f'occluded="{occluded}" points="{place}" z_order="0">{attribute}</points>\n'
        f'    <points frame="{frame.image + 1}" keyframe="1" outside="1" '
        f'occluded="{occluded}" points="{place}" z_order="0"></points>\n'
        "  </track>\n"
    )
