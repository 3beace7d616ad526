"""Images that an estimate is made from, chosen and looked at while they arrive."""

from __future__ import annotations

import logging
from collections.abc import Callable, Container

import numpy as np

from tooltip_cli.errors import TooltipError
from tooltip_cli.log.messages import (
    COMPRESSED_IMAGE,
    IMAGE,
    Message,
    compressed_image,
    header_stamp_ns,
)
from tooltip_cli.log.views import Views
from tooltip_cli.method.voting.moving import (
    FrameEdges,
    Image,
    moving_edges,
    noise_level,
    smooth,
)
from tooltip_cli.method.voting.online import CausalPairing, Decided, Spread
from tooltip_cli.method.voting.pairing import orientations
from tooltip_cli.method.voting.params import VotingSettings
from tooltip_cli.rig.camera import CameraModel
from tooltip_cli.rig.kinematics import inverse_transform
from tooltip_cli.rig.rigfile import Rig
from tooltip_cli.sources.streams import encode_jpeg
from tooltip_cli.stages.held import HeldFrame, Snapshot, pixels_of
from tooltip_cli.stages.moving import hand_in_image
from tooltip_cli.stages.poses import PosedImage, PoseFollower
from tooltip_cli.stages.voting import focal_px

_LOG = logging.getLogger(__name__)
_NOISE_PAIRS = 8


class FrameKeeper:
    """Holds the moving edges of a bounded number of images, spread over the hand's orientations.

    Args:
        left_out: header stamps of images that must not be used.
    """

    def __init__(
        self, rig: Rig, settings: VotingSettings, left_out: Container[int] = frozenset()
    ) -> None:
        self._rig, self._settings, self._left_out = rig, settings, left_out
        self.follower = PoseFollower(rig, keep_images=True)
        self._spread = Spread(settings.pairing.frames, 9)
        self._held: dict[int, HeldFrame] = {}  # by place
        self._window: dict[int, PosedImage] = {}
        self._smoothed: dict[int, Image] = {}
        self._noise: list[float] = []
        self._count = 0
        self._first_ns = self._last_ns = 0
        self._decided: PosedImage | None = None  # the last one
        self._camera: CameraModel | None = None
        self._causal: CausalPairing | None = None
        self.passed_over = self.unreadable = 0
        self.behind_s = 0.0
        self.changes = 0  # of what is held

    @property
    def full(self) -> bool:
        """Whether as many images are held as may be."""
        return self._spread.full

    @property
    def held(self) -> int:
        """How many images are held."""
        return len(self._held)

    @property
    def window(self) -> int:
        """How many of the last images are kept for those to come."""
        return len(self._window)

    @property
    def camera(self) -> CameraModel | None:
        """The intrinsics, once poses are known."""
        return self._camera

    def advance(
        self, now_ns: Callable[[], int], late_s: float, *, at_end: bool = False
    ) -> list[PosedImage]:
        """Look at the images whose poses are known by now, and return them.

        Args:
            now_ns: the clock of the arrivals.
            late_s: behind the newest image, from which on images are passed over.

        Raises:
            TooltipError: images of another size than the intrinsics'.
        """
        images = []
        for image in self.follower.passed(at_end=at_end):
            if self._count and image.stamp_ns <= self._last_ns:
                continue
            images.append(image)
            self._count += 1
            self._last_ns = image.stamp_ns
            self._first_ns = self._first_ns or image.stamp_ns
            frame, pose = self._count - 1, image.camera_from_hand
            if image.stamp_ns in self._left_out:
                pose = np.full((4, 4), np.nan)
            self._window[frame] = image
            pairing = self._pairing()
            for decided in pairing.add(pose):
                assert image.message is not None  # noqa: S101 - images are kept
                self.behind_s = (now_ns() - image.message.log_time_ns) / 1e9
                self._consider(decided, self.behind_s > late_s)
            self._forget(pairing.oldest)
        if at_end and self._count:
            for decided in self._pairing().finish():
                self._consider(decided, late=False)
        return images

    def snapshot(self) -> Snapshot:
        """Return what an estimate is made from."""
        frames = sorted(self._held.values(), key=lambda held: held.frame)
        last, pairing = self._decided, self._pairing()
        stamp_ns = last.stamp_ns if last is not None else self._last_ns
        arrival_ns = last.message.log_time_ns if last is not None and last.message else 0
        return Snapshot(
            tuple(frames),
            self._known_camera(),
            pairing.fastest_px,
            stamp_ns,
            (stamp_ns - self._first_ns) / 1e9,
            arrival_ns,
        )

    def _pairing(self) -> CausalPairing:
        if self._causal is None:
            self._camera = self.follower.camera
            focal = focal_px(self._known_camera())
            self._causal = CausalPairing(focal, self._settings.pairing)
        return self._causal

    def _forget(self, oldest: int) -> None:
        for kept in (self._window, self._smoothed):
            for frame in [frame for frame in kept if frame < oldest]:
                del kept[frame]

    def _consider(self, decided: Decided, late: bool) -> None:
        """Look at an image and hold it, where that spreads what is held."""
        image = self._decided = self._window[decided.frame]
        if decided.partners is None:
            return
        point = orientations(image.camera_from_hand[None])[0]
        place = self._spread.place_for(point, decided.level)
        if place is None:
            return
        if late:
            self.passed_over += 1
            return
        edges = self._edges(decided.frame, decided.partners, decided.level)
        if edges is None:
            self.unreadable += 1
            return
        poses = np.stack(
            [self._window[i].camera_from_hand for i in (decided.frame, *decided.partners)]
        )
        self._spread.put(place, point, decided.level)
        assert image.message is not None  # noqa: S101 - images are kept
        self._held[place] = HeldFrame(
            decided.frame,
            poses,
            decided.displacements,
            decided.level,
            edges,
            image.root_from_camera,
            _packed(image.message, decided.frame),
        )
        self.changes += 1

    def _edges(self, frame: int, partners: tuple[int, int], level: int) -> FrameEdges | None:
        """Return an image's moving edges; None: it or a partner cannot be read."""
        params = self._settings.moving
        images = []
        for index in (frame, *partners):
            if index not in self._smoothed:
                pixels = self._pixels(index)
                if pixels is None:
                    return None
                self._smoothed[index] = smooth(pixels, params)
            images.append(self._smoothed[index])
        if len(self._noise) < _NOISE_PAIRS:
            pair = self._pixels(frame), self._pixels(partners[1])
            if pair[0] is not None and pair[1] is not None:
                self._noise.append(noise_level([(pair[0], pair[1])]))
        image = self._window[frame]
        view = Views(
            self._known_camera(),
            np.array([image.stamp_ns]),
            inverse_transform(image.camera_from_hand[None]),
            self._rig.spheres,
            image.root_from_camera[None],
        )
        centres, radii = hand_in_image(view, np.zeros(1, dtype=np.intp), params.reach)
        noise = float(np.median(self._noise))
        return moving_edges(
            images[0], (images[1], images[2]), centres[0], float(radii[0]), noise, params, level
        )

    def _known_camera(self) -> CameraModel:
        assert self._camera is not None  # noqa: S101 - known where there are poses
        return self._camera

    def _pixels(self, frame: int) -> Image | None:
        """Decode an image; None: it is damaged."""
        message = self._window[frame].message
        assert message is not None  # noqa: S101 - images are kept
        try:
            pixels = pixels_of(message, frame, gray=True)
        except TooltipError as error:
            _LOG.info("%s", error)
            return None
        camera, (height, width) = self._known_camera(), pixels.shape
        if (width, height) != (camera.width, camera.height):
            raise TooltipError(
                f"{message.topic}: images are {width}x{height} but the intrinsics are for "
                f"{camera.width}x{camera.height}; calibrate at that size, or scale the camera file "
                "to it"
            )
        return pixels


def _packed(message: Message, number: int) -> Message:
    """Return an image as JPEG where it is raw: hundreds are held."""
    if message.datatype != IMAGE:
        return message
    data = encode_jpeg(pixels_of(message, number, gray=False))
    payload = compressed_image(header_stamp_ns(message.payload) or 0, "", "jpeg", data)
    return Message(message.topic, COMPRESSED_IMAGE, message.log_time_ns, payload)
