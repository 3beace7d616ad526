"""Accuracy on recordings whose images are altered, or left out, after they were made.

Example:
    python -m tests.benchmarks.accuracy.altered --work /tmp/altered DIR/*.mcap
    python -m tests.benchmarks.accuracy.altered --work /tmp/altered REC.mcap --alter noise flicker

What a recording needs beside it is as for ``run.py``. Altered ones are made once under ``--work``
and reused; the labels of images that are left out are left out too.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from tests.benchmarks.accuracy.run import Case, rig_beside, score_all, true_tip
from tooltip_cli.labels.files import TipLabels, read_labels, write_labels
from tooltip_cli.log.container import LoggedAttachment, iterate
from tooltip_cli.log.messages import COMPRESSED_IMAGE, Message, compressed_image
from tooltip_cli.log.recording import Recording, read_recording
from tooltip_cli.log.writer import LogWriter

Pixels: TypeAlias = npt.NDArray[np.float32]
Random: TypeAlias = np.random.Generator


def _as_they_are(image: Pixels, share: float, rng: Random) -> Pixels:
    return image


def _noise(sigma: float) -> Callable[[Pixels, float, Random], Pixels]:
    def noisy(image: Pixels, share: float, rng: Random) -> Pixels:
        return np.asarray(image + rng.normal(0, sigma, image.shape), np.float32)

    return noisy


def _flicker(part: float) -> Callable[[Pixels, float, Random], Pixels]:
    return lambda image, share, rng: image * np.float32(1 + rng.uniform(-part, part))


def _dark(image: Pixels, share: float, rng: Random) -> Pixels:
    return _noise(2.0)(0.4 * image, share, rng)


def _drift(image: Pixels, share: float, rng: Random) -> Pixels:
    return np.asarray(image * (0.9 + 0.2 * share), np.float32)


def _blur(image: Pixels, share: float, rng: Random) -> Pixels:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 1.5), np.float32)


def _gray(image: Pixels, share: float, rng: Random) -> Pixels:
    return np.repeat(image.mean(axis=2, keepdims=True), 3, axis=2)


def _specks(image: Pixels, share: float, rng: Random) -> Pixels:
    hit = rng.random(image.shape[:2]) < 0.002
    image[hit] = rng.integers(0, 256, (np.count_nonzero(hit), 1))
    return image


@dataclass(frozen=True)
class _Alteration:
    # given the image, where in the recording it is from 0 to 1, and a source of chance
    change: Callable[[Pixels, float, Random], Pixels] = _as_they_are
    quality: int = 95  # of the JPEG
    kept: tuple[float, float] = (0.0, 1.0)  # part of the recording
    every: int = 1  # how many images one is kept of


ALTERATIONS = {
    "noise": _Alteration(_noise(4.0)),
    "noise8": _Alteration(_noise(8.0)),
    "q50": _Alteration(quality=50),
    "noise_q30": _Alteration(_noise(4.0), quality=30),
    "dark": _Alteration(_dark),
    "flicker": _Alteration(_flicker(0.1)),
    "drift": _Alteration(_drift),
    "blur": _Alteration(_blur),
    "gray": _Alteration(_gray),
    "specks": _Alteration(_specks),
    "half": _Alteration(every=2),
    "quarter": _Alteration(every=4),
    "first": _Alteration(kept=(0.0, 0.5)),
    "last": _Alteration(kept=(0.5, 1.0)),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--work", type=Path, required=True, help="directory for what is made")
    parser.add_argument("--alter", nargs="+", default=list(ALTERATIONS), choices=ALTERATIONS)
    parser.add_argument("--methods", nargs="+", default=["voting"])
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    cases = _altered(arguments.recordings, arguments.alter, arguments.work)
    score_all(cases, arguments.methods, arguments.work)


def _altered(recordings: list[Path], names: list[str], work: Path) -> Iterator[Case]:
    for name in names:
        for path in recordings:
            made = work / f"{path.stem}-{name}.mcap"
            if not made.exists():
                _write(read_recording(path), made, ALTERATIONS[name])
            yield made, rig_beside(path), name


def _write(recording: Recording, made: Path, alteration: _Alteration) -> None:
    """Write an altered recording, its labels and the true tip."""
    path, stamps = recording.path, recording.image_stamps_ns
    rng = np.random.default_rng(len(stamps))
    low, high = (round(part * len(stamps)) for part in alteration.kept)
    kept = range(low, high, alteration.every)
    images = enumerate(recording.images(range(len(stamps))))
    with LogWriter(made) as log:
        for item in iterate(path):
            if isinstance(item, LoggedAttachment):
                log.attach(item.name, item.media_type, item.data)
            elif item.topic != recording.image_topic:
                log.copy(item)
            else:
                index, image = next(images)
                if index not in kept:
                    continue
                pixels = alteration.change(image.astype(np.float32), index / len(stamps), rng)
                stored = np.clip(np.round(pixels), 0, 255).astype(np.uint8)
                quality = [cv2.IMWRITE_JPEG_QUALITY, alteration.quality]
                payload = compressed_image(
                    int(stamps[index]),
                    recording.image_frame,
                    "jpeg",
                    cv2.imencode(".jpg", stored, quality)[1].tobytes(),
                )
                log.write(Message(item.topic, COMPRESSED_IMAGE, item.log_time_ns, payload))
    _write_labels(read_labels(path.with_suffix(".labels.csv")), stamps[kept], made)
    truth = true_tip(path, recording.attachments)
    if truth is not None:
        made.with_suffix(".truth.json").write_text(json.dumps({"tip_in_hand_m": truth.tolist()}))


def _write_labels(labels: TipLabels, stamps: npt.NDArray[np.int64], made: Path) -> None:
    rows = np.flatnonzero(np.isin(labels.stamps_ns, stamps))
    of_kept = TipLabels(
        labels.stamps_ns[rows],
        labels.pixels[rows],
        tuple(labels.states[row] for row in rows),
        tuple(labels.labelers[row] for row in rows),
    )
    write_labels(made.with_suffix(".labels.csv"), of_kept)


if __name__ == "__main__":
    main()
