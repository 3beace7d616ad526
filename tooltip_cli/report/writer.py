"""Writes a report: tables and sections as recordings come, figures and the page at the end."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from tooltip_cli.log.messages import IMAGE
from tooltip_cli.log.recording import Recording
from tooltip_cli.report.bars import error_by_tool, shares_by_tool, tip_error_by_tool
from tooltip_cli.report.charts import Drawing
from tooltip_cli.report.figures import detection_histogram, error_by_training
from tooltip_cli.report.model import EvaluationReport, FrameTable, RecordingReport
from tooltip_cli.report.page import page
from tooltip_cli.report.region import region_figure
from tooltip_cli.report.scenes import Scene, by_severity, scene_figures, thumbnails
from tooltip_cli.report.section import recording_section
from tooltip_cli.report.tables import (
    FRAME_COLUMNS,
    TOOL_COLUMNS,
    csv_text,
    frame_rows,
    latex_table,
    tool_rows,
)
from tooltip_cli.report.turnable import rays_figure
from tooltip_cli.report.worst import worst_figures

VERSION = 5  # of what a section looks like; a change draws all sections anew
MOST_SECTIONS = 16  # recordings shown in full: hundreds would make a page that opens for nobody
MOST_PICTURES = 400  # in the audit tables of the whole page, which keeps it below 10 MB
_A_RECORDING = (12, 100)  # least and most pictures of one recording
_LINK = re.compile(r'href="((?:figures|frames)/[^"]+)"')
Save = Callable[[str, str | bytes], None]


class ReportWriter:
    """Takes recordings one by one; holds none of their images or frames.

    Args:
        directory: of the report.
        recordings: how many will come.
        save: writes a file, given its place relative to the directory, whole or not at all.
        plain: turns the report into what JSON has.
        frame: image index that the figures show; default: a typical one.
    """

    def __init__(
        self,
        directory: Path,
        recordings: int,
        save: Save,
        plain: Callable[[EvaluationReport], Any],
        frame: int | None = None,
    ) -> None:
        self._directory, self._save, self._plain = directory, save, plain
        self._frame = frame
        least, most = _A_RECORDING
        self._pictures = min(max(MOST_PICTURES // min(recordings, MOST_SECTIONS), least), most)

    def add(self, row: RecordingReport, table: FrameTable, scene: Scene) -> bool:
        """Write one recording's table, figures and section; return whether they were drawn anew."""
        marker = f"<!-- {row.provenance['key']} {VERSION} {self._pictures} {self._frame} -->"
        section = self._part(row)
        if self._whole(section, marker):
            return False
        figures = list(_figures(row, table, scene, self._frame))
        for figure in figures:
            self._figure(figure)
        places = by_severity(table)[: self._pictures]
        pictures = {item.place: item.svg for item in thumbnails(row, table, scene, places)}
        files = self._whole_frames(row, table, scene, places)
        text = recording_section(row, table, figures, pictures, files)
        self._save(f"parts/{row.name}.csv", csv_text(FRAME_COLUMNS, frame_rows(row.name, table)))
        self._save(str(section.relative_to(self._directory)), f"{marker}\n{text}")
        return True

    def _whole(self, section: Path, marker: str) -> bool:
        """Return whether a section is there as it would be drawn, with every file it links to."""
        try:
            first, text = section.read_text(encoding="utf-8").split("\n", 1)
        except (OSError, ValueError):
            return False
        links = _LINK.findall(text) if first == marker else ()
        return first == marker and all(
            (self._directory / unquote(link)).is_file() for link in links
        )

    def finish(self, report: EvaluationReport) -> None:
        """Write what is about all recordings, and the page."""
        self._save("report.json", json.dumps(self._plain(report), indent=1) + "\n")
        self._save("tools.csv", csv_text(TOOL_COLUMNS, tool_rows(report)))
        self._save("frames.csv", "".join(self._frames(report)))
        self._save("tools.tex", latex_table(report))
        drawn = (
            error_by_tool(report),
            tip_error_by_tool(report),
            shares_by_tool(report),
            detection_histogram(report),
            error_by_training(report.recordings),
        )
        figures = [figure for figure in drawn if figure is not None]
        for figure in figures:
            self._figure(figure)
        shown, left_out = _chosen(report)
        sections = (self._part(row).read_text(encoding="utf-8") for row in shown)
        text = page(report, figures, sections, [row.name for row in left_out])
        self._save("index.html", "".join(text))

    def _part(self, row: RecordingReport) -> Path:
        return self._directory / "parts" / f"{row.name}.html"

    def _figure(self, figure: Drawing) -> None:
        for suffix, data in (("svg", figure.svg), ("png", figure.png), ("csv", figure.data)):
            self._save(f"figures/{figure.name}.{suffix}", data)

    def _whole_frames(
        self, row: RecordingReport, table: FrameTable, scene: Scene, places: list[int]
    ) -> dict[int, str]:
        """Write the frames that have pictures as they were logged."""
        ordered = sorted(places)
        frames = [int(table.frames[place]) for place in ordered]
        messages = scene.recording.image_messages(frames)
        files = {}
        for place, frame, message in zip(ordered, frames, messages, strict=True):
            data, suffix = _as_file(scene.recording, frame, message)
            files[place] = f"frames/{row.name}-{frame:06d}.{suffix}"
            self._save(files[place], data)
        return files

    def _frames(self, report: EvaluationReport) -> Iterator[str]:
        yield csv_text(FRAME_COLUMNS, [])
        for row in report.recordings:
            if row.provenance:
                path = self._directory / "parts" / f"{row.name}.csv"
                yield path.read_text(encoding="utf-8").split("\n", 1)[1]


def _figures(
    row: RecordingReport, table: FrameTable, scene: Scene, frame: int | None
) -> Iterator[Drawing]:
    yield from scene_figures(row, table, scene, frame)
    rays = rays_figure(row, scene)
    if rays is not None:
        yield rays
    region = region_figure(row)
    if region is not None:
        yield region
    yield from worst_figures(row, table)


def _chosen(report: EvaluationReport) -> tuple[list[RecordingReport], list[RecordingReport]]:
    """Return the recordings shown in full, in their order, and the others.

    Where there are too many, those with the largest errors are shown, refused ones first.
    """

    def severity(row: RecordingReport) -> float:
        return float("inf") if row.detector_px is None else row.detector_px.mean

    rows = [row for row in report.recordings if row.provenance]
    worst = {row.name for row in sorted(rows, key=severity, reverse=True)[:MOST_SECTIONS]}
    return [row for row in rows if row.name in worst], [
        row for row in rows if row.name not in worst
    ]


def _as_file(recording: Recording, frame: int, message: Any) -> tuple[bytes, str]:
    """Return an image as logged where that is a file, else as PNG, and the file's suffix."""
    import cv2

    data = b"" if recording.image_type == IMAGE else bytes(message.data)
    for start, suffix in ((b"\xff\xd8", "jpg"), (b"\x89PNG", "png")):
        if data.startswith(start):
            return data, suffix
    image = next(recording.images([frame]))
    return cv2.imencode(".png", image)[1].tobytes(), "png"
