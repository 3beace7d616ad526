"""The label stage's other doors: labels from and for other tools."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tooltip_cli.errors import TooltipError
from tooltip_cli.labels.book import rows_of, rows_text
from tooltip_cli.labels.exchange import WRITERS, Choice, Place, adopt, read_foreign
from tooltip_cli.labels.files import frames_of, read_labels
from tooltip_cli.labels.formats.base import Album, Shown
from tooltip_cli.labels.journal import open_journal
from tooltip_cli.log.images import viewable
from tooltip_cli.log.recording import Recording, Topics, read_recording
from tooltip_cli.stages.artifacts import ensure_directory, find_artifact, write_whole
from tooltip_cli.stages.held_out import LABELS_SUFFIX
from tooltip_cli.stages.label import Labeler, Selection, choose_frames, image_size, label_place


@dataclass(frozen=True)
class Imported:
    """What an import wrote."""

    path: Path
    tool: str
    states: dict[str, int]  # labels by state
    notes: tuple[str, ...]  # what was left out, and what to keep in mind


def import_labels(
    recording_path: Path,
    source: Path,
    *,
    choice: Choice | None = None,
    blind: bool = False,
    numbered: Selection | None = None,
    first: int = 0,
    topics: Topics | None = None,
    out: Path | None = None,
    force: bool = False,
) -> Imported:
    """Read another tool's labels and write them as this recording's.

    Args:
        blind: they are a second person's; the choice then names the labeller.
        numbered: the frames that numbers in the file count; default: all of the recording.
        first: the number of the first of them.

    Raises:
        TooltipError: the labels are malformed or fit another recording, none is left, or there
            are labels already and ``force`` was not given.
    """
    choice = choice or Choice()
    recording = read_recording(recording_path, topics or Topics())
    foreign = read_foreign(source)
    stamps = recording.image_stamps_ns
    frames = range(len(stamps)) if numbered is None else choose_frames(recording, numbered).tolist()
    place = Place(stamps.tolist(), frames, image_size(recording), first)
    rows = adopt(foreign, place, choice)
    left_out = tuple(f"left out {count} {why}" for why, count in sorted(foreign.left_out.items()))
    if not rows:
        raise TooltipError("; ".join([f"{source}: holds no label", *left_out]))
    path = label_place(recording, Labeler(choice.labeler or foreign.tool, blind), out)
    ensure_directory(path.parent)
    with open_journal(path) as journal:  # refuses while a labelling page is open
        if path.exists() and not force:
            raise TooltipError(f"{path} exists; --force replaces it")
        write_whole(path, rows_text(rows))
        journal.remove()
    states = Counter(row.state for row in rows.values())
    return Imported(path, foreign.tool, dict(states), (*left_out, *foreign.notes))


def export_labels(
    recording_path: Path,
    target: Path,
    tool: str,
    *,
    labels: Path | None = None,
    images: Path | None = None,
    topics: Topics | None = None,
    out: Path | None = None,
    force: bool = False,
) -> list[Path]:
    """Write labels for another tool, and the labelled images where a folder is given.

    Without labels the test frames of the default split are exported, to be labelled elsewhere.

    Args:
        target: file, or for labelme a folder.
        labels: label file; default: the recording's own.

    Returns:
        The files that were written, the labels first.

    Raises:
        TooltipError: the labels are of another recording, or a file is in the way and ``force``
            was not given.
    """
    recording = read_recording(recording_path, topics or Topics())
    album = _album(recording, labels, out)
    content = WRITERS[tool](album)
    files = {"": content} if isinstance(content, str) else content
    texts = {target / name: text for name, text in files.items()}
    pictures = {} if images is None else {images / shown.name: shown for shown in album.frames}
    for path in (*texts, *pictures):
        if path.exists() and not force:
            raise TooltipError(f"{path} exists; --force replaces it")
    for path, text in texts.items():
        write_whole(path, text)
    for path, shown in pictures.items():
        write_whole(path, _image_file(recording, shown.image)[0])
    return [*texts, *pictures]


def _album(recording: Recording, labels: Path | None, out: Path | None) -> Album:
    path = labels or find_artifact(recording.path, LABELS_SUFFIX, out)
    stamps = recording.image_stamps_ns
    if path is None:
        rows, frames = {}, choose_frames(recording, Selection())
    else:
        found = read_labels(path)
        rows, frames = dict(rows_of(found)), np.sort(frames_of(found, stamps))
    shown = []
    for frame in frames.tolist():
        stamp = int(stamps[frame])
        ending = _image_file(recording, frame)[1]
        shown.append(Shown(frame, stamp, f"{stamp}{ending}", rows.get(stamp)))
    return Album(recording.path.stem, image_size(recording), tuple(shown))


def _image_file(recording: Recording, index: int) -> tuple[bytes, str]:
    """Return an image as a file's bytes, and the ending of its name."""
    (message,) = recording.image_messages([index])
    data, media_type = viewable(message, recording.image_type, f"{recording.path}: image {index}")
    return data, {"image/jpeg": ".jpg", "image/png": ".png"}[media_type]
