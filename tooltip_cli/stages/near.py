"""Where detections are looked for when the rig says where the hand is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tooltip_cli.log.recording import LoggedImage, Recording
from tooltip_cli.log.views import Views
from tooltip_cli.method.detector import DetectorParams, EdgeMotion, Image, TipDetection
from tooltip_cli.method.near import NearParams, Shown, detect_near, near_motion
from tooltip_cli.method.types import Array, Indices
from tooltip_cli.method.voting.params import VotingSettings
from tooltip_cli.stages.artifacts import digest, stage_key
from tooltip_cli.stages.clock import Lap
from tooltip_cli.stages.moving import (
    Light,
    Look,
    hand_in_image,
    light_in,
    look_at,
    noise_frames,
)
from tooltip_cli.stages.voting import pair_views

VERSION = 2


@dataclass(frozen=True)
class NearHand:
    """Detection near the hand, in one recording.

    Labels change nothing here: detections are of all images, whoever uses which of them.
    """

    recording: Recording
    params: NearParams
    hands: Array  # (N, 3) u, v and reach around it, whole pixels; NaN: unknown
    noise_frames: Indices  # (P, 2) pairs of images that show the noise

    @property
    def light(self) -> Light:
        """What the recording's images show of sensor and lamps.

        Raises:
            TooltipError: an image cannot be decoded.
        """
        return light_in(self.recording, self.noise_frames)

    @property
    def key(self) -> str:
        """The key of the detections; of the rig, they depend on where the hand is in the images."""
        parents = {
            "recording": self.recording.sha256,
            "image_topic": self.recording.image_topic,
            "hand": digest(self.hands),
            "noise": digest(self.noise_frames),
        }
        return stage_key("detect near the hand", VERSION, parents, self.params)

    def motion(self, frame: int, first: Image, second: Image) -> EdgeMotion | str:
        """Return the weighted edge map of an image and the next one, both (H, W) gray."""
        looks = [Look(image, self.params.moving) for image in (first, second)]
        shown = [
            Shown(image, look.smoothed) for image, look in zip((first, second), looks, strict=True)
        ]
        light = self.light
        edges, hand = looks[0].edges(light.noise), self.hands[frame]
        return near_motion(
            shown[0], shown[1], edges, hand, light.noise, self.params, steady=light.steady
        )

    def parts(self) -> Callable[[range], _SomePairs]:
        """Return what finds the tip in the pairs of some consecutive images.

        Raises:
            TooltipError: an image that shows the noise cannot be decoded.
        """
        light = self.light  # before threads ask for it
        return lambda images: _SomePairs(self, light, images)


class _SomePairs:
    """The pairs of some consecutive images."""

    def __init__(self, near: NearHand, light: Light, images: range) -> None:
        self.wanted = frozenset(images) if len(images) > 1 else frozenset()
        self._near, self._light = near, light
        self._first: tuple[Shown, Look] | None = None
        self._rows: list[TipDetection] = []

    def take(self, index: int, image: LoggedImage, lap: Lap) -> None:
        """Compare an image with the one before."""
        near = self._near
        gray = image.gray
        lap("decode")
        look = look_at(image, gray, near.params.moving)
        second = Shown(gray, look.smoothed)
        lap("smooth")
        if self._first is not None:
            first, look_at_first = self._first
            light = self._light
            edges = look_at_first.edges(light.noise)
            lap("edges")
            hand = near.hands[index - 1]
            self._rows.append(
                detect_near(first, second, edges, hand, light.noise, near.params, lap, light.steady)
            )
        self._first = second, look

    def result(self) -> list[TipDetection]:
        """Return the detections."""
        return self._rows


def near_hand(
    recording: Recording,
    views: Views,
    settings: VotingSettings | None = None,
    detector: DetectorParams | None = None,
) -> NearHand:
    """Return how the tip is detected in a recording whose rig is known."""
    settings = settings or VotingSettings()
    count = len(recording.image_stamps_ns)
    pairing, _ = pair_views(views, settings, np.ones(count, dtype=bool))
    centres, radii = hand_in_image(views, np.arange(count), settings.moving.reach)
    return NearHand(
        recording,
        NearParams(detector or DetectorParams(), settings.moving),
        # whole pixels, so that a rig that hardly differs changes nothing
        np.asarray(np.round(np.column_stack([centres, radii])) + 0.0, float),  # nor is there -0
        noise_frames(pairing, count),
    )


def near_unless(
    preset: str,
    recording: Recording,
    views: Views,
    settings: VotingSettings | None = None,
    detector: DetectorParams | None = None,
) -> NearHand | None:
    """Return the same, or None where the preset ``paper`` has all edges weighed."""
    return None if preset == "paper" else near_hand(recording, views, settings, detector)
