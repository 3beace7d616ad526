"""A recording: the streams of one log, read once, images on demand."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, BinaryIO, Literal, TypeVar

import numpy as np
import numpy.typing as npt

from tooltip_cli.errors import TooltipError
from tooltip_cli.log import messages
from tooltip_cli.log.container import LoggedAttachment, LoggedMessage, iterate, read_chunk
from tooltip_cli.log.images import decode_compressed, decode_raw
from tooltip_cli.log.joints import joint_samples
from tooltip_cli.log.messages import decode_foreign
from tooltip_cli.log.sync import sorted_unique
from tooltip_cli.log.topics import choose_info, choose_topic
from tooltip_cli.rig.camera import CameraModel

Array = npt.NDArray[np.float64]
Stamps = npt.NDArray[np.int64]
Image = npt.NDArray[np.uint8]
_T = TypeVar("_T")

IMAGE_TYPES = (messages.COMPRESSED_IMAGE, messages.IMAGE)
_SMALL_TYPES = (messages.JOINT_STATE, messages.POSE_STAMPED, messages.CAMERA_INFO)
_CACHED_CHUNKS = 4


class _Made:
    """What was made of something, for others who want the same."""

    def __init__(self) -> None:
        self._by_key: dict[Hashable, Any] = {}

    def once(self, key: Hashable, make: Callable[[], _T]) -> _T:
        """Return what ``make`` returned to the first who asked for ``key``."""
        if key not in self._by_key:
            self._by_key[key] = make()
        made: _T = self._by_key[key]
        return made


@dataclass(frozen=True)
class Topics:
    """Which topic to take for each role; None: the only one of its type."""

    image: str | None = None
    joints: str | None = None
    info: str | None = None
    pose: str | None = None


@dataclass(frozen=True)
class JointTrack:
    """One joint over time."""

    stamps_ns: Stamps  # (M,) strictly increasing
    positions: Array  # (M,) rad or m


@dataclass(frozen=True)
class PoseTrack:
    """Hand poses over time: frame_id_from_hand."""

    frame_id: str
    stamps_ns: Stamps  # (M,) strictly increasing
    positions: Array  # (M, 3) metres
    quaternions: Array  # (M, 4) x, y, z, w, unit norm


@dataclass(frozen=True)
class Recording:
    """The streams of one log that the stages need, on their own clocks."""

    path: Path
    sha256: str  # of the file
    image_topic: str
    image_type: str
    image_frame: str  # frame_id of the images
    image_stamps_ns: Stamps  # (N,) strictly increasing header stamps
    camera: CameraModel | None  # from CameraInfo; None: absent or uncalibrated
    joints: Mapping[str, JointTrack]  # by the log's joint names; empty: none logged
    joint_topic: str | None
    poses: Mapping[str, PoseTrack]  # by topic
    pose_topic: str | None  # the one that was asked for; None: the rig file says
    urdf: str | None
    attachments: Mapping[str, bytes]
    notes: tuple[str, ...]  # what was odd: duplicates, reversals, unreadable messages
    unusable: Mapping[str, str]  # joints, info, robot or a pose topic -> why it is left out
    _places: tuple[tuple[int, int, int], ...] = field(repr=False)  # chunk, offset, length
    _made: _Made = field(default_factory=_Made, repr=False, compare=False)

    def once(self, key: Hashable, make: Callable[[], _T]) -> _T:
        """Return what ``make`` returned to the first who asked this recording for ``key``."""
        return self._made.once(key, make)

    def images(self, indices: Iterable[int], *, gray: bool = False) -> Iterator[Image]:
        """Yield decoded images by index, (H, W, 3) BGR or (H, W) gray, uint8, of one size.

        Memory: one image and a few chunks. Ascending indices read the file once.

        Raises:
            TooltipError: an image that cannot be decoded, or of another size than the first.
        """
        for image in self.logged_images(indices):
            yield image.decode(gray=gray)

    def logged_images(self, indices: Iterable[int]) -> Iterator[LoggedImage]:
        """Yield images by index, to be decoded by whoever gets them; otherwise as `images`.

        Raises:
            TooltipError: a message that is not what its topic says.
        """
        chosen = list(indices)
        sizes: set[tuple[int, int]] = set()
        for index, message in zip(chosen, self.image_messages(chosen), strict=True):
            yield LoggedImage(self, index, message, sizes)

    def image_messages(self, indices: Iterable[int]) -> Iterator[Any]:
        """Yield the messages of images as logged, CompressedImage or Image by ``image_type``.

        Raises:
            TooltipError: a message that is not what its topic says.
        """
        cache: OrderedDict[int, bytes] = OrderedDict()
        with self.path.open("rb") as file:
            for index in indices:
                payload = _payload(file, self._places[index], cache, self.path)
                yield decode_foreign(self.image_type, payload, f"{self.path}: image {index}")


class LoggedImage:
    """An image of a recording.

    Args:
        sizes: of those decoded before, which must be the same.
    """

    def __init__(
        self, recording: Recording, index: int, message: Any, sizes: set[tuple[int, int]]
    ) -> None:
        self._recording, self._index, self._message = recording, index, message
        self._sizes = sizes
        self.once = _Made().once

    @cached_property
    def gray(self) -> Image:
        """(H, W) grey levels, decoded once.

        Raises:
            TooltipError: it cannot be decoded, or has another size than those before.
        """
        return self.decode(gray=True)

    def decode(self, *, gray: bool) -> Image:
        """Return (H, W, 3) BGR or (H, W) gray, uint8.

        Raises:
            TooltipError: it cannot be decoded, or has another size than those before.
        """
        path, raw = self._recording.path, self._recording.image_type == messages.IMAGE
        decode = decode_raw if raw else decode_compressed
        image = decode(self._message, gray, f"{path}: image {self._index}")
        height, width = image.shape[:2]
        self._sizes.add((width, height))
        if len(self._sizes) > 1:
            raise TooltipError(
                f"{path}: the image size changes to {width}x{height} at image {self._index}; "
                "record each resolution on its own"
            )
        return image


def _payload(
    file: BinaryIO, place: tuple[int, int, int], cache: OrderedDict[int, bytes], path: Path
) -> bytes:
    chunk_offset, offset, length = place
    if chunk_offset < 0:
        file.seek(offset)
        return file.read(length)
    if chunk_offset not in cache:
        while len(cache) >= _CACHED_CHUNKS:
            cache.popitem(last=False)
        cache[chunk_offset] = read_chunk(file, chunk_offset, path)
    return cache[chunk_offset][offset : offset + length]


def read_recording(
    path: Path,
    topics: Topics = Topics(),
    items: Iterable[LoggedMessage | LoggedAttachment] | None = None,
) -> Recording:
    """Read one log: all small streams into memory, images as places in the file.

    What not every stage needs (joints, intrinsics, poses, robot) and cannot be taken is left out,
    and ``unusable`` says why, unless its topic was asked for by name.

    Args:
        items: what is left of a damaged file; default: the file, which must be whole.

    Raises:
        TooltipError: not a readable MCAP log; no image topic or several; a named topic that is
            absent or cannot be used.
        DamagedLogError: truncated, or a checksum fails.
    """
    index = _Index(path)
    for item in iterate(path) if items is None else items:
        index.add(item)
    image_topic = index.image_topic(topics.image)
    stamps, places, frame = index.image_stream(image_topic)
    joint_topic, joints = index.joints(topics.joints)
    return Recording(
        path=path,
        sha256=sha256_of(path),
        image_topic=image_topic,
        image_type=index.types[image_topic],
        image_frame=frame,
        image_stamps_ns=stamps,
        camera=index.attempt("info", topics.info, lambda: index.camera(image_topic, topics.info)),
        joints=joints,
        joint_topic=joint_topic,
        poses=index.poses(topics.pose),
        pose_topic=topics.pose,
        urdf=index.attempt("robot", None, index.robot_description),
        attachments=index.attachments,
        notes=tuple(index.notes),
        unusable=index.unusable,
        _places=places,
    )


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file's bytes as hexadecimal digits."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


class _Index:
    """What one pass over a log found."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.source = str(path)
        self.types: dict[str, str] = {}
        self.attachments: dict[str, bytes] = {}
        self.notes: list[str] = []
        self.unusable: dict[str, str] = {}
        self._payloads: dict[str, list[bytes]] = {}
        self._images: dict[str, list[tuple[int, int, int, int]]] = {}
        self._frames: dict[str, str] = {}
        self._foreign: set[str] = set()

    def add(self, item: LoggedMessage | LoggedAttachment) -> None:
        if isinstance(item, LoggedAttachment):
            self.attachments[item.name] = item.data
            return
        if item.encoding != "cdr":
            if item.topic not in self._foreign:
                self._foreign.add(item.topic)
                self.notes.append(
                    f"topic {item.topic} is encoded as {item.encoding or 'nothing'}, not ROS 2 "
                    "CDR, and is not read"
                )
            return
        known = self.types.setdefault(item.topic, item.datatype)
        if known != item.datatype:
            raise TooltipError(
                f"{self.path}: topic {item.topic} carries both {known} and {item.datatype}; record "
                "them on topics of their own"
            )
        if item.datatype in IMAGE_TYPES:
            stamp_ns, frame = _read_header(item, self.path)
            self._frames.setdefault(item.topic, frame)
            self._images.setdefault(item.topic, []).append(
                (stamp_ns, item.chunk_offset, item.offset, len(item.payload))
            )
        elif item.datatype in _SMALL_TYPES or _is_description(item.topic, item.datatype):
            self._payloads.setdefault(item.topic, []).append(item.payload)

    def image_topic(self, wanted: str | None) -> str:
        topic = choose_topic(
            self.types,
            "image",
            IMAGE_TYPES,
            wanted,
            self.source,
            required=True,
            notes=self.notes,
        )
        assert topic is not None  # noqa: S101 - required
        return topic

    def attempt(self, role: str, wanted: str | None, take: Callable[[], _T]) -> _T | None:
        """Return what ``take`` gives; where it fails and was not asked for by name, note why."""
        try:
            return take()
        except TooltipError as error:
            if wanted is not None:
                raise
            self.unusable[role] = str(error)
            return None

    def image_stream(self, topic: str) -> tuple[Stamps, tuple[tuple[int, int, int], ...], str]:
        rows = self._images[topic]
        stamps = np.array([row[0] for row in rows], dtype=np.int64)
        order = self._order(topic, stamps)
        return stamps[order], tuple(rows[i][1:] for i in order), self._frames[topic]

    def camera(self, image_topic: str, wanted: str | None) -> CameraModel | None:
        """Return the camera of a CameraInfo topic; a change during the log is an error."""
        topic = choose_info(self.types, image_topic, wanted, self.source)
        if topic is None:
            return None
        cameras = []
        for payload in dict.fromkeys(map(_without_stamp, self._payloads[topic])):
            message = decode_foreign(messages.CAMERA_INFO, payload, f"{self.path}: {topic}")
            cameras.append(messages.camera_from_info(message, f"{self.path}: {topic}"))
        if any(camera != cameras[0] for camera in cameras):
            raise TooltipError(
                f"{self.path}: the intrinsics on {topic} change during the recording; record each "
                "zoom or resolution on its own"
            )
        return cameras[0]

    def joints(self, wanted: str | None) -> tuple[str | None, dict[str, JointTrack]]:
        """Return the topic of the joints and their tracks."""
        types = (messages.JOINT_STATE,)
        topic = self.attempt(
            "joints", wanted, lambda: choose_topic(self.types, "joints", types, wanted, self.source)
        )
        if topic is None:
            return None, {}
        tracks = self.attempt("joints", wanted, lambda: self._joint_tracks(topic))
        return topic, tracks or {}

    def _joint_tracks(self, topic: str) -> dict[str, JointTrack]:
        samples: dict[str, tuple[list[int], list[float]]] = {}
        for sample in joint_samples(self._payloads[topic], f"{self.path}: {topic}"):
            # positions may be left empty by a controller that reports only effort
            for name, position in zip(sample.names, sample.positions, strict=False):
                stamps, positions = samples.setdefault(name, ([], []))
                stamps.append(sample.stamp_ns)
                positions.append(position)
        tracks: dict[str, JointTrack] = {}
        for name, (stamps, positions) in samples.items():
            values = np.array(positions)
            stamps_ns = np.array(stamps, dtype=np.int64)
            # joints share their messages' stamps, so what is odd is said for the first alone
            order = self._order(topic, stamps_ns, quiet=bool(tracks))
            finite = order[np.isfinite(values[order])]
            if len(finite) < len(order):
                self.notes.append(
                    f"{topic}: {len(order) - len(finite)} positions of joint {name} are not finite "
                    "and are left out"
                )
            tracks[name] = JointTrack(stamps_ns[finite], values[finite])
        return tracks

    def poses(self, wanted: str | None) -> dict[str, PoseTrack]:
        """Return the tracks of the wanted topic, or of all: the rig file names the one to take."""
        types = (messages.POSE_STAMPED,)
        topics = [topic for topic, kind in self.types.items() if kind in types]
        if wanted is not None:
            choose_topic(self.types, "pose", types, wanted, self.source)
            topics = [wanted]
        tracks: dict[str, PoseTrack] = {}
        for topic in topics:
            track = self.attempt(topic, wanted, partial(self._pose_track, topic))
            if track is not None:
                tracks[topic] = track
        return tracks

    def _pose_track(self, topic: str) -> PoseTrack:
        stamps, rows, frames, left_out = [], [], set(), 0
        for payload in self._payloads[topic]:
            message = decode_foreign(messages.POSE_STAMPED, payload, f"{self.path}: {topic}")
            frames.add(str(message.header.frame_id))
            p, q = message.pose.position, message.pose.orientation
            row = np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w])
            norm = float(np.linalg.norm(row[3:]))
            if not np.isfinite(row).all() or abs(norm - 1) > 0.01:
                left_out += 1
                continue
            stamps.append(messages.ns_from_time(message.header.stamp))
            rows.append([*row[:3], *row[3:] / norm])
        if len(frames) > 1:
            raise TooltipError(
                f"{self.path}: the poses on {topic} are given in several frames: "
                f"{', '.join(sorted(frames))}; record each on a topic of its own"
            )
        if left_out:
            self.notes.append(
                f"{topic}: {left_out} poses without finite numbers and a unit quaternion are left "
                "out"
            )
        stamps_ns = np.array(stamps, dtype=np.int64)
        order = self._order(topic, stamps_ns)
        values = np.array(rows, dtype=float).reshape(-1, 7)[order]
        return PoseTrack(frames.pop(), stamps_ns[order], values[:, :3], values[:, 3:])

    def robot_description(self) -> str | None:
        """Return the URDF: the last message of the only topic of that name."""
        texts = {}
        for topic in filter(lambda name: _is_description(name, self.types[name]), self.types):
            where = f"{self.path}: {topic}"
            texts[topic] = str(
                decode_foreign(messages.STRING, self._payloads[topic][-1], where).data
            )
        if len(set(texts.values())) > 1:
            raise TooltipError(
                f"{self.path} has several robot descriptions: {', '.join(sorted(texts))}; name the "
                "URDF under 'robot' in the rig file"
            )
        return next(iter(texts.values()), None)

    def _order(self, topic: str, stamps_ns: Stamps, *, quiet: bool = False) -> npt.NDArray[np.intp]:
        order, reversals, duplicates = sorted_unique(stamps_ns)
        if reversals and not quiet:
            self.notes.append(f"{topic}: {reversals} stamps run backwards; sorted by header stamp")
        if duplicates and not quiet:
            self.notes.append(f"{topic}: {duplicates} duplicate stamps; the first of each is kept")
        return order


def _is_description(topic: str, datatype: str) -> bool:
    return datatype == messages.STRING and topic.rsplit("/", 1)[-1] == "robot_description"


def _without_stamp(payload: bytes) -> bytes:
    """Blank the header stamp, which alone differs between the repeats of a CameraInfo."""
    return payload[:4] + bytes(8) + payload[12:]


def _read_header(item: LoggedMessage, path: Path) -> tuple[int, str]:
    """Return stamp and frame of a message that begins with a std_msgs/Header, nothing more.

    Decoding the whole message would copy every image twice.
    """
    stamp_ns = messages.header_stamp_ns(item.payload)
    try:
        order: Literal["little", "big"] = "little" if item.payload[1] & 1 else "big"
        length = int.from_bytes(item.payload[12:16], order)
        frame = item.payload[16 : 16 + max(length - 1, 0)].decode("utf-8")
        if stamp_ns is None or len(item.payload) < 16 + length:
            raise ValueError("too short")
    except (IndexError, ValueError) as error:
        raise TooltipError(
            f"{path}: a message on {item.topic} is not a {item.datatype}; record it again, or "
            "leave the topic out"
        ) from error
    return stamp_ns, frame
