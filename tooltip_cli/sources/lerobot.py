"""Recordings from LeRobot data sets, versions 2.0, 2.1 and 3.0."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tooltip_cli.errors import TooltipError
from tooltip_cli.log.messages import Message
from tooltip_cli.rig.rigfile import Rig
from tooltip_cli.sources.base import SourceReport
from tooltip_cli.sources.decoding import decode_frames, require_av
from tooltip_cli.sources.lerobot_meta import (
    EpisodeFiles,
    choose_camera,
    joint_names,
    load_info,
    locate_episode,
)
from tooltip_cli.sources.streams import (
    EPOCH_NS,
    IMAGE_TOPIC,
    check_stamp,
    encode_jpeg,
    image_messages,
    joint_message,
    missing_extra,
    one_line,
    plural,
    robot_message,
    storable_image,
    with_robot,
)

FEATURE, EXTRA = "record lerobot", "lerobot"
_BATCH_ROWS = 32  # images in a table are read this many at a time


@dataclass(frozen=True)
class _Rows:
    times_ns: npt.NDArray[np.int64]  # (N,) strictly increasing, from the episode's start
    states: npt.NDArray[np.float64]  # (N, J)


class LeRobotSource:
    """One episode of a LeRobot data set.

    Stamps are the table's own timestamps, which count from zero, after ``streams.EPOCH_NS``.
    Video frames become JPEG of quality 95; images stored in the table stay as they are. Frames
    and rows are paired by time, within half a frame. Joint values are taken as they stand, in rad
    and m if the data set's are.

    Args:
        root: the local folder with ``meta``, ``data`` and ``videos``.
        episode: its index.
        camera_key: the image feature; None: the only one.
        state_key: the feature that holds the joint positions.
        rig: stored in the log; its intrinsics are written beside every image.
        urdf: a robot description that takes the place of the rig's.

    Raises:
        TooltipError: no such data set, episode, camera or feature, or malformed files.
        MissingExtraError: PyArrow or PyAV is not installed.
    """

    def __init__(
        self,
        root: Path,
        episode: int,
        camera_key: str | None = None,
        state_key: str = "observation.state",
        rig: Rig | None = None,
        urdf: str | None = None,
    ) -> None:
        self._info = load_info(root)
        self._camera_key = choose_camera(self._info, camera_key)
        self._names, named = joint_names(self._info, state_key)
        pq = _require_parquet()
        self._files = locate_episode(self._info, episode, self._camera_key, pq)
        self._episode = episode
        self._rows = _read_rows(pq, self._files, episode, state_key, len(self._names))
        self._rig = with_robot(rig, urdf)
        self._urdf = urdf if urdf is not None else (rig.urdf if rig is not None else None)
        self._report = SourceReport()
        self._report.notes.append(
            f"stamps are the table's timestamps after {EPOCH_NS // 10**9} s; the data set has no "
            "time of day"
        )
        if not named:
            self._report.notes.append(
                f"'{state_key}' has no names; its values are recorded as joints state_0 to "
                f"state_{len(self._names) - 1}"
            )

    @property
    def frames(self) -> int | None:
        """Number of rows, which is the number of images of a sound data set."""
        return len(self._rows.times_ns)

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
        """Yield the robot description, then joint states and images by time.

        Raises:
            TooltipError: a table or a video that cannot be read.
        """
        for message in self._unreported():
            self._report.count(message.topic)
            yield message

    def attachments(self) -> Mapping[str, bytes]:
        """A data set brings no files of its own."""
        return {}

    def _unreported(self) -> Iterator[Message]:
        rows = self._rows
        if self._urdf is not None:
            yield robot_message(EPOCH_NS + int(rows.times_ns[0]), self._urdf)
        frame_id, camera = "camera", None
        if self._rig is not None:
            frame_id, camera = self._rig.camera_frame or frame_id, self._rig.camera
        written = 0
        for row, kind, data in self._images():
            yield from self._joints(written, row + 1)
            written = row + 1
            stamp_ns = EPOCH_NS + int(rows.times_ns[row])
            yield from image_messages(stamp_ns, frame_id, kind, data, camera)
        yield from self._joints(written, len(rows.times_ns))

    def _joints(self, start: int, end: int) -> Iterator[Message]:
        for row in range(start, end):
            stamp_ns = EPOCH_NS + int(self._rows.times_ns[row])
            yield joint_message(stamp_ns, self._names, self._rows.states[row].tolist())

    def _images(self) -> Iterator[tuple[int, str, bytes]]:
        """Yield (row, format, data) by ascending rows."""
        if self._files.video is not None:
            yield from self._video_images(self._files.video)
        else:
            yield from self._table_images()

    def _video_images(self, video: Path) -> Iterator[tuple[int, str, bytes]]:
        av = require_av(FEATURE, EXTRA)
        times = self._rows.times_ns
        half_ns = round(0.5e9 / self._info.fps)
        start_ns = round(self._files.video_start_s * 1e9)
        span_ns = None
        if self._files.video_is_shared:
            span_ns = start_ns + int(times[0]) - half_ns, start_ns + int(times[-1]) + half_ns
        seen, paired, last = 0, 0, -1
        for frame in decode_frames(av, video, self._report, span_ns):
            seen += 1
            if frame.time_ns is None:
                self._report.drop("video frames without a time")
                continue
            row = _nearest(times, frame.time_ns - start_ns)
            if row <= last or abs(int(times[row]) + start_ns - frame.time_ns) > half_ns:
                self._report.drop("video frames without a row of the table")
                continue
            last = row
            paired += 1
            yield row, "jpeg", encode_jpeg(frame.pixels)
        if not seen == paired == len(times):
            self._report.notes.append(
                f"{video} has {plural(seen, 'frame')} for the {plural(len(times), 'row')} of "
                f"{self._files.table}; {paired} could be paired"
            )

    def _table_images(self) -> Iterator[tuple[int, str, bytes]]:
        import pyarrow.dataset as ds

        try:
            scanner = ds.dataset(self._files.table, format="parquet").scanner(
                columns=[self._camera_key],
                filter=ds.field("episode_index") == self._episode,
                batch_size=_BATCH_ROWS,
            )
            cells = (cell for batch in scanner.to_batches() for cell in batch.column(0).to_pylist())
            for row, cell in enumerate(cells):
                image = storable_image(self._image_bytes(cell))
                if image is None:
                    self._report.drop("images that cannot be decoded")
                    continue
                yield row, *image
        except TooltipError:
            raise
        except Exception as error:  # Arrow's errors have no common root but this
            raise TooltipError(f"{self._files.table}: {one_line(error)}") from error

    def _image_bytes(self, cell: Any) -> bytes:
        """Return what an image cell holds: its bytes, or those of the file that it names."""
        if isinstance(cell, dict) and cell.get("bytes"):
            return bytes(cell["bytes"])
        if isinstance(cell, dict) and cell.get("path"):
            path = self._info.root / str(cell["path"])
            if path.is_file() and ".." not in path.parts:
                return path.read_bytes()
        return cell if isinstance(cell, bytes) else b""


def _require_parquet() -> Any:
    try:
        import pyarrow.parquet
    except ImportError as error:
        raise missing_extra(FEATURE, EXTRA, error) from error
    return pyarrow.parquet


def _read_rows(pq: Any, files: EpisodeFiles, episode: int, state_key: str, width: int) -> _Rows:
    """Read an episode's timestamps and joint values."""
    path = files.table
    columns = ["timestamp", "episode_index", state_key]
    try:
        known = pq.read_schema(path).names
        missing = [name for name in columns if name not in known]
        if missing:
            raise TooltipError(
                f"{path} lacks the columns {', '.join(missing)}; it has {', '.join(known)}"
            )
        table = pq.read_table(path, columns=columns, filters=[("episode_index", "=", episode)])
        seconds = np.array(table.column("timestamp").to_pylist(), dtype=float).reshape(-1)
        cells = table.column(state_key).to_pylist()
        states = np.array(cells, dtype=float).reshape(len(cells), -1 if cells else 0)
    except TooltipError:
        raise
    except Exception as error:  # Arrow's errors have no common root but this
        raise TooltipError(f"{path} cannot be read as a table ({one_line(error)})") from error
    if not len(seconds):
        raise TooltipError(f"{path} has no rows of episode {episode}")
    if states.shape[1] != width:
        raise TooltipError(f"{path}: '{state_key}' has {states.shape[1]} values, expected {width}")
    if not np.isfinite(seconds).all():
        row = int(np.flatnonzero(~np.isfinite(seconds))[0])
        raise TooltipError(f"{path}: the timestamp of row {row} is no number")
    if (np.abs(seconds) > 1e9).any():
        farthest = np.abs(seconds).max()
        raise TooltipError(f"{path}: timestamps reach {farthest:g} s; check their unit")
    times_ns = np.round(seconds * 1e9).astype(np.int64)
    if (np.diff(times_ns) <= 0).any():
        row = int(np.flatnonzero(np.diff(times_ns) <= 0)[0]) + 1
        raise TooltipError(f"{path}: the timestamp of row {row} is not later than the one before")
    for edge in (times_ns[0], times_ns[-1]):
        check_stamp(EPOCH_NS + int(edge), str(path))
    return _Rows(times_ns, states)


def _nearest(times_ns: npt.NDArray[np.int64], query_ns: int) -> int:
    after = int(np.searchsorted(times_ns, query_ns))
    if after == 0:
        return 0
    if after == len(times_ns):
        return after - 1
    before = after - 1
    return before if query_ns - times_ns[before] <= times_ns[after] - query_ns else after
