"""Recordings from a video file or a folder of images, with CSV tables of joints or hand poses."""

from __future__ import annotations

import heapq
import re
from collections.abc import Iterator, Mapping
from decimal import Decimal
from itertools import chain
from pathlib import Path

from tooltip_cli.errors import TooltipError
from tooltip_cli.log import messages
from tooltip_cli.log.messages import Message
from tooltip_cli.rig.documents import shown
from tooltip_cli.rig.rigfile import Rig
from tooltip_cli.sources.base import SourceReport
from tooltip_cli.sources.decoding import count_frames, decode_frames, require_av
from tooltip_cli.sources.streams import (
    EPOCH_NS,
    IMAGE_TOPIC,
    POSE_TOPIC,
    check_stamp,
    encode_jpeg,
    image_messages,
    joint_message,
    one_line,
    plural,
    robot_message,
    storable_image,
    with_robot,
)
from tooltip_cli.sources.tables import Table, read_image_stamps, read_joints, read_poses

FEATURE, EXTRA = "record video", "lerobot"  # the extra that brings PyAV
STAMP_TABLE = "stamps.csv"
_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm"})
_NANOSECONDS = re.compile(r"\d{18,19}")  # file names; fewer digits are counters or another unit
_SECONDS = re.compile(r"\d{1,10}\.\d+")
_MAX_IMAGE_BYTES = 1 << 28


class VideoSource:
    """A video file or a folder of images, and tables of where the hand was.

    A video's frames keep the video's own spacing, or that of ``fps``; the first one stands at
    ``start_ns``, or else at the tables' first stamp. Images of a folder have the stamps that
    ``stamps.csv`` in it lists (``file,stamp_ns`` or ``file,stamp``), or those that their names
    are (18 or 19 digits: nanoseconds; with a decimal point: seconds), or ``fps``. JPEG and PNG
    files are stored as they are; video frames become JPEG of quality 95.

    Args:
        path: the video or the folder.
        joints_csv, poses_csv: tables as described in :mod:`tooltip_cli.sources.tables`.
        fps: frames a second; takes the place of all other times.
        start_ns: stamp of the first image.
        pose_frame: frame of the poses; None: the parent of the rig's camera mount, or ``base``.
        rig: stored in the log; its intrinsics are written beside every image.
        urdf: a robot description that takes the place of the rig's.

    Raises:
        TooltipError: no such video, images or table, or a malformed one.
        MissingExtraError: PyAV is needed and not installed.
    """

    def __init__(
        self,
        path: Path,
        joints_csv: Path | None = None,
        poses_csv: Path | None = None,
        fps: float | None = None,
        start_ns: int | None = None,
        pose_frame: str | None = None,
        rig: Rig | None = None,
        urdf: str | None = None,
    ) -> None:
        self._path, self._fps = path, fps
        self._rig = with_robot(rig, urdf)
        self._urdf = urdf if urdf is not None else (rig.urdf if rig is not None else None)
        self._report = SourceReport()
        self._joints = self._table(read_joints(joints_csv), joints_csv) if joints_csv else None
        self._poses = self._table(read_poses(poses_csv), poses_csv) if poses_csv else None
        if self._joints is None and self._poses is None:
            self._report.notes.append(
                "no joint angles and no hand poses: tips can be detected in this recording, not "
                "located"
            )
        self._pose_topic, self._pose_frame = POSE_TOPIC, pose_frame or "base"
        if rig is not None:
            self._pose_topic = rig.pose_topic or POSE_TOPIC
            if pose_frame is None and rig.pose_topic is not None and rig.mount is not None:
                self._pose_frame = rig.mount.parent
        self._files: list[tuple[int, Path]] | None = None
        self._frames: int | None = None
        if path.is_dir():
            self._files = _image_files(path, fps, start_ns, self._first_stamp(), self._report)
            self._frames = len(self._files)
            self._start_ns = self._files[0][0]
        else:
            self._frames = count_frames(require_av(FEATURE, EXTRA), path)
            self._start_ns = self._video_start(start_ns)

    @property
    def frames(self) -> int | None:
        """Number of images, as far as the video's header says."""
        return self._frames

    @property
    def image_topic(self) -> str | None:
        """The topic of the images written."""
        return IMAGE_TOPIC

    @property
    def rig(self) -> Rig | None:
        """The rig that was given."""
        return self._rig

    @property
    def report(self) -> SourceReport:
        """Filled while the messages are taken."""
        return self._report

    def messages(self) -> Iterator[Message]:
        """Yield the robot description, then images, joint states and poses by time.

        Raises:
            TooltipError: an image or the video cannot be read.
        """
        streams = [self._images(), self._joint_states(), self._hand_poses()]
        robot: list[Message] = []
        if self._urdf is not None:
            first = min(self._start_ns, self._first_stamp() or self._start_ns)
            robot.append(robot_message(first, self._urdf))
        for message in chain(robot, heapq.merge(*streams, key=lambda item: item.log_time_ns)):
            self._report.count(message.topic)
            yield message

    def attachments(self) -> Mapping[str, bytes]:
        """Videos and tables are not kept beside what was read from them."""
        return {}

    def _table(self, table: Table, path: Path) -> Table:
        if table.reversals:
            lines = plural(table.reversals, "row")
            self._report.notes.append(f"{path}: {lines} stood before an earlier one; sorted")
        return table

    def _first_stamp(self) -> int | None:
        tables = [table for table in (self._joints, self._poses) if table is not None]
        return min((int(table.stamps_ns[0]) for table in tables), default=None)

    def _video_start(self, start_ns: int | None) -> int:
        if start_ns is not None:
            return check_stamp(start_ns, "--start")
        first = self._first_stamp()
        if first is not None:
            self._report.notes.append(
                f"the first frame is taken to be at the tables' first stamp, {first} ns; --start "
                "gives another"
            )
            return first
        self._report.notes.append(f"the first frame is put at {EPOCH_NS} ns; --start gives another")
        return EPOCH_NS

    def _images(self) -> Iterator[Message]:
        frame_id, camera = "camera", None
        if self._rig is not None:
            frame_id, camera = self._rig.camera_frame or frame_id, self._rig.camera
        images = self._folder_images(self._files) if self._files else self._video_images()
        last_ns = -1
        for stamp_ns, kind, data in images:
            if stamp_ns <= last_ns:
                self._report.drop("images that are not later than the one before")
                continue
            last_ns = check_stamp(stamp_ns, str(self._path))
            yield from image_messages(stamp_ns, frame_id, kind, data, camera)

    def _folder_images(self, files: list[tuple[int, Path]]) -> Iterator[tuple[int, str, bytes]]:
        for stamp_ns, path in files:
            try:
                if path.stat().st_size > _MAX_IMAGE_BYTES:
                    raise TooltipError(f"{path}: too large for an image")
                image = storable_image(path.read_bytes())
            except OSError as error:
                raise TooltipError(f"{path}: cannot be read ({one_line(error)})") from error
            if image is None:
                self._report.drop(f"images that cannot be decoded, as {path.name}")
                continue
            yield stamp_ns, *image

    def _video_images(self) -> Iterator[tuple[int, str, bytes]]:
        first_ns: int | None = None
        frames = decode_frames(require_av(FEATURE, EXTRA), self._path, self._report)
        for index, frame in enumerate(frames):
            if self._fps is not None:
                since_ns = round(index * 1e9 / self._fps)
            elif frame.time_ns is None:
                raise TooltipError(
                    f"{self._path} gives no time for frame {index}; name the rate with --fps"
                )
            else:
                first_ns = frame.time_ns if first_ns is None else first_ns
                since_ns = frame.time_ns - first_ns
            yield self._start_ns + since_ns, "jpeg", encode_jpeg(frame.pixels)

    def _joint_states(self) -> Iterator[Message]:
        if self._joints is not None:
            for stamp_ns, row in zip(self._joints.stamps_ns, self._joints.rows, strict=True):
                yield joint_message(int(stamp_ns), self._joints.columns, row.tolist())

    def _hand_poses(self) -> Iterator[Message]:
        if self._poses is not None:
            for stamp, row in zip(self._poses.stamps_ns, self._poses.rows.tolist(), strict=True):
                stamp_ns = int(stamp)
                payload = messages.pose_stamped(stamp_ns, self._pose_frame, row[:3], row[3:])
                yield Message(self._pose_topic, messages.POSE_STAMPED, stamp_ns, payload)


def parse_start(text: str) -> int:
    """Return the nanoseconds that a whole number is, or that seconds with a point or ``s`` are.

    Raises:
        TooltipError: neither.
    """
    match = re.fullmatch(r"(\d{1,19})|(\d{1,10}(?:\.\d*)?)s?", text.strip())
    if match is None:
        raise TooltipError(
            f"{shown(text)} is no stamp: give whole nanoseconds, or seconds with a point or 's'"
        )
    return int(match[1]) if match[1] else round(Decimal(match[2]) * 10**9)


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Return a sort key by which ``2.png`` comes before ``10.png``."""
    parts = re.findall(r"\d+|\D+", name)
    return tuple((0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts)


def _image_files(
    folder: Path,
    fps: float | None,
    start_ns: int | None,
    table_start_ns: int | None,
    report: SourceReport,
) -> list[tuple[int, Path]]:
    """Return the images of a folder with their stamps, by stamp."""
    paths = [path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES]
    paths.sort(key=lambda path: natural_key(path.name))
    if not paths:
        raise TooltipError(f"{folder} holds no images ({', '.join(sorted(_SUFFIXES))})")
    listing = folder / STAMP_TABLE
    if fps is not None:
        begin = start_ns if start_ns is not None else table_start_ns
        begin = EPOCH_NS if begin is None else begin
        report.notes.append(f"the first image is put at {begin} ns, the others at {fps:g} a second")
        files = [(begin + round(index * 1e9 / fps), path) for index, path in enumerate(paths)]
    elif listing.is_file():
        files = _listed_files(listing, paths, report)
    else:
        files = [(_stamp_from_name(path, folder), path) for path in paths]
    files.sort(key=lambda item: item[0])
    shift = start_ns - files[0][0] if start_ns is not None else 0
    return [(check_stamp(stamp_ns + shift, str(path)), path) for stamp_ns, path in files]


def _listed_files(listing: Path, paths: list[Path], report: SourceReport) -> list[tuple[int, Path]]:
    stamps = read_image_stamps(listing)
    known = {path.name: path for path in paths}
    missing = [name for name in stamps if name not in known]
    if missing:
        raise TooltipError(
            f"{listing} lists {plural(len(missing), 'file')} that the folder does not hold as "
            f"images, the first is {shown(missing[0])}"
        )
    for _ in known.keys() - stamps.keys():
        report.drop(f"images that {listing.name} does not list")
    return [(stamp_ns, known[name]) for name, stamp_ns in stamps.items()]


def _stamp_from_name(path: Path, folder: Path) -> int:
    if _NANOSECONDS.fullmatch(path.stem):
        return int(path.stem)
    if _SECONDS.fullmatch(path.stem):
        return round(Decimal(path.stem) * 10**9)
    raise TooltipError(
        f"{path} has no stamp for a name; give --fps, or list the stamps in {folder / STAMP_TABLE} "
        "(file,stamp_ns)"
    )
