"""Frames that hand labels exist for: they are kept for testing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from tooltip_cli.labels.files import match_labels, read_labels
from tooltip_cli.log.recording import Recording
from tooltip_cli.rig.camera import CameraModel
from tooltip_cli.stages.artifacts import find_artifact

LABELS_SUFFIX = ".labels.csv"


def unlabelled(
    recording: Recording, camera: CameraModel, out: Path | None
) -> npt.NDArray[np.bool_]:
    """Return (N,) which images ``STEM.labels.csv`` does not label; all where there is none.

    Raises:
        TooltipError: the labels are malformed or of another recording.
    """
    allowed = np.ones(len(recording.image_stamps_ns), dtype=bool)
    place = find_artifact(recording.path, LABELS_SUFFIX, out)
    if place is not None:
        labels = match_labels(read_labels(place), recording.image_stamps_ns, camera)
        allowed[labels.frames] = False
    return allowed
