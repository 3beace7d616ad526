"""Estimates from images that are held, one after the other while what is held changes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from tooltip_cli.log.images import decode_compressed, decode_raw
from tooltip_cli.log.messages import IMAGE, Message, decode_foreign
from tooltip_cli.log.views import Views
from tooltip_cli.method.rays import sphere_array
from tooltip_cli.method.types import Array, TipEstimate, refused
from tooltip_cli.method.voting.estimate import METHOD, check_motion, estimate_by_voting
from tooltip_cli.method.voting.moving import FrameEdges, Image, join
from tooltip_cli.method.voting.pairing import Pairing
from tooltip_cli.method.voting.params import VotingSettings
from tooltip_cli.method.voting.silhouette import FrameSilhouette
from tooltip_cli.rig.camera import CameraModel
from tooltip_cli.rig.kinematics import inverse_transform
from tooltip_cli.rig.rigfile import Rig
from tooltip_cli.stages.scene import Scene
from tooltip_cli.stages.voting import hand_edges


@dataclass(frozen=True)
class HeldFrame:
    """An image that is held, with its moving edges."""

    frame: int  # running number of the image
    poses: Array  # (3, 4, 4) camera_from_hand of the image and its partners
    displacements: tuple[float, float]  # pixels that a tool's end moves by to them
    level: int  # how often images were halved for that to fit the search window
    edges: FrameEdges
    root_from_camera: Array  # (3, 3) how the camera is turned
    message: Message


@dataclass(frozen=True)
class Snapshot:
    """What an estimate is made from."""

    frames: tuple[HeldFrame, ...]  # in the order of time
    camera: CameraModel
    fastest_px: float  # median motion of a tool's end from image to image
    stamp_ns: int  # of the last image that was taken into account
    time_s: float  # from the first image to that one
    arrival_ns: int  # of that one


class HeldEstimator:
    """Does with held images what the estimate stage does with those that it chooses.

    The scene behind the hand is learnt anew whenever as many images have come as it was learnt
    from, and at the end; silhouettes are kept meanwhile.
    """

    def __init__(self, rig: Rig, settings: VotingSettings) -> None:
        self._rig, self._settings = rig, settings
        self._scene: Scene | None = None
        self._learnt: set[int] = set()  # frames that were held then
        self._silhouettes: dict[int, FrameSilhouette] = {}

    def estimate(self, snapshot: Snapshot, *, final: bool) -> TipEstimate:
        """Return the estimate.

        Args:
            final: learn the scene from exactly these images.

        Raises:
            TooltipError: an image cannot be decoded.
        """
        held, settings, rig = snapshot.frames, self._settings, self._rig
        count = len(held)
        numbers, partners = np.arange(count), count + np.arange(2 * count).reshape(-1, 2)
        poses = np.concatenate(
            [np.zeros((0, 4, 4)), *(item.poses[:1] for item in held)]
            + [item.poses[1:] for item in held]
        )
        moved = np.array([item.displacements for item in held]).reshape(-1, 2)
        levels = np.array([item.level for item in held], dtype=np.intp)
        pairing = Pairing(numbers, partners, moved, snapshot.fastest_px, levels)
        reason = check_motion(pairing, poses, settings)
        if reason is not None:
            return refused(METHOD, count, reason)
        turned = np.stack([item.root_from_camera for item in held])
        views = Views(snapshot.camera, numbers, inverse_transform(poses), rig.spheres, turned)
        moving = join(numbers, partners, self._with_silhouettes(held, views, final))
        spheres = sphere_array([(sphere.center, sphere.radius) for sphere in rig.spheres])
        return estimate_by_voting(hand_edges(views, moving, poses, settings), spheres, settings)

    def _with_silhouettes(
        self, held: tuple[HeldFrame, ...], views: Views, final: bool
    ) -> list[FrameEdges]:
        frames = {item.frame for item in held}
        if self._scene is None or final or len(frames - self._learnt) >= len(self._learnt):
            pictures = _Pictures(held)
            self._scene = Scene(pictures, views, np.arange(len(held)), self._settings.silhouette)
            self._learnt, self._silhouettes = frames, {}
        known = {frame: self._silhouettes[frame] for frame in frames & self._silhouettes.keys()}
        for item in held:
            if item.frame not in known:
                image = pixels_of(item.message, item.frame, gray=False)
                known[item.frame] = self._scene.silhouette(image, item.root_from_camera)
        self._silhouettes = known
        return [replace(item.edges, silhouette=known[item.frame]) for item in held]


class _Pictures:
    """Held images in colour."""

    def __init__(self, held: tuple[HeldFrame, ...]) -> None:
        self._held = held

    def images(self, indices: Iterable[int]) -> Iterator[Image]:
        """Yield decoded images by their place among those held."""
        for index in indices:
            yield pixels_of(self._held[index].message, self._held[index].frame, gray=False)


def pixels_of(message: Message, number: int, *, gray: bool) -> Image:
    """Return an image, (H, W, 3) BGR or (H, W) gray.

    Args:
        number: of the image, for messages.

    Raises:
        TooltipError: it cannot be decoded.
    """
    where = f"{message.topic}: image {number}"
    content = decode_foreign(message.datatype, message.payload, where)
    decode = decode_raw if message.datatype == IMAGE else decode_compressed
    return decode(content, gray, where)
