"""What one labelling page shows and may change."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tooltip_cli.labels.book import LabelBook
from tooltip_cli.log.recording import Recording


@dataclass(frozen=True)
class Hints:
    """Where the machine sees the tip; hidden from labellers unless they ask."""

    detections: Mapping[int, tuple[float, float]]  # u, v by image index
    predictions: Mapping[int, tuple[float, float]]
    notes: tuple[str, ...] = ()  # why there are none


@dataclass(frozen=True)
class Session:
    """One labeller at one recording."""

    recording: Recording
    size: tuple[int, int]  # width, height of the images
    frames: npt.NDArray[np.intp]  # ascending image indices to label
    book: LabelBook
    labeler: str
    hints: Callable[[], Hints] | None  # None: this labeller is to judge alone
    notes: tuple[str, ...] = ()  # what was odd

    @property
    def stamps_ns(self) -> list[int]:
        """The stamps of the frames."""
        stamps: list[int] = self.recording.image_stamps_ns[self.frames].tolist()
        return stamps

    @property
    def images(self) -> frozenset[int]:
        """The images that the page may ask for: the frames and their neighbours."""
        count = len(self.recording.image_stamps_ns)
        wanted = {frame + step for frame in self.frames.tolist() for step in (-1, 0, 1)}
        return frozenset(wanted & set(range(count)))
