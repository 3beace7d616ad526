"""The metadata of a LeRobot data set: which files hold an episode, and what its columns mean.

Layouts: ``meta/info.json`` with path templates in all versions; v2.0 and v2.1 keep one table and
one video an episode and list them in ``meta/episodes.jsonl``; v3.0 packs episodes into shared
files and lists them, with the video's from and to times, under ``meta/episodes/``. Source:
LeRobot's documentation of its data set format and ``lerobot/datasets/dataset_metadata.py``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from tooltip_cli.errors import TooltipError, one_of
from tooltip_cli.rig.documents import shown
from tooltip_cli.sources.streams import one_line

_V2_DATA = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
_V2_VIDEO = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
_V3_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_V3_VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_MAX_JSON_BYTES = 64 * 2**20
_MAX_VIDEO_S = 1e7
_MAX_JOINTS = 10_000


@dataclass(frozen=True)
class DatasetInfo:
    """What ``meta/info.json`` says."""

    root: Path
    version: tuple[int, int]  # (2, 0), (2, 1) or (3, 0)
    fps: float
    features: Mapping[str, Mapping[str, Any]]
    fields: Mapping[str, Any]  # all of the file

    def cameras(self) -> dict[str, str]:
        """Return ``video`` or ``image`` by camera key, depth cameras left out."""
        return {
            key: str(feature["dtype"])
            for key, feature in self.features.items()
            if feature.get("dtype") in ("video", "image") and not _is_depth(feature)
        }


@dataclass(frozen=True)
class EpisodeFiles:
    """Where one episode's data are."""

    table: Path
    video: Path | None  # None: the images are in the table
    video_start_s: float  # time of the first frame on the video's clock
    video_is_shared: bool  # the video goes on with other episodes' frames


def load_info(root: Path) -> DatasetInfo:
    """Read ``meta/info.json``.

    Raises:
        TooltipError: no such data set, a malformed file, or a version that is not read.
    """
    path = root / "meta" / "info.json"
    if not path.is_file():
        raise TooltipError(
            f"{root} is no LeRobot data set: {path} is missing; give the local folder that holds "
            "meta, data and videos"
        )
    fields = _load_json(path)
    version = re.fullmatch(r"v?(\d+)\.(\d+).*", str(fields.get("codebase_version")))
    if version is None or version.group(1) not in ("2", "3"):
        raise TooltipError(
            f"{path}: data set version {shown(fields.get('codebase_version'))} is not read; known: "
            "v2.0, v2.1, v3.0"
        )
    features, fps = fields.get("features"), fields.get("fps")
    if not isinstance(features, dict) or not all(isinstance(f, dict) for f in features.values()):
        raise TooltipError(f"{path}: 'features' must map names to their descriptions")
    if not isinstance(fps, (int, float)) or isinstance(fps, bool) or not 0 < fps < 1e5:
        raise TooltipError(f"{path}: 'fps' must be a positive number, found {shown(fps)}")
    numbers = int(version.group(1)), int(version.group(2))
    return DatasetInfo(root, numbers, float(fps), features, fields)


def choose_camera(info: DatasetInfo, wanted: str | None) -> str:
    """Return the wanted camera's key, or the only one.

    Raises:
        TooltipError: an unknown key, no camera, or several to choose from; lists the valid keys.
    """
    cameras = info.cameras()
    if wanted is not None:
        if wanted not in cameras:
            raise TooltipError(f"{info.root}: {one_of('camera', wanted, cameras)}")
        return wanted
    if len(cameras) != 1:
        what = f"several cameras: {', '.join(sorted(cameras))}" if cameras else "no camera"
        raise TooltipError(
            f"{info.root} has {what}" + ("; choose one with --camera" if cameras else "")
        )
    return next(iter(cameras))


def joint_names(info: DatasetInfo, state_key: str) -> tuple[tuple[str, ...], bool]:
    """Return the names of a state feature's values, and whether the data set gives them.

    Data sets give a list, a list in a list, a mapping of groups to lists (``{"motors": [...]}``)
    or of names to places; without names the values are called ``state_0``, ``state_1``, ...

    Raises:
        TooltipError: an unknown feature, or names that do not fit its values.
    """
    if state_key not in info.features:
        known = [key for key in info.features if key not in info.cameras()]
        raise TooltipError(f"{info.root}: {one_of('feature', state_key, known)}")
    feature = info.features[state_key]
    where = f"{info.root}: feature '{state_key}'"
    shape = feature.get("shape")
    width = shape[0] if isinstance(shape, list) and len(shape) == 1 else None
    if not isinstance(width, int) or not 0 < width <= _MAX_JOINTS:
        raise TooltipError(
            f"{where} has the shape {shown(shape)}; joint values are a row of numbers"
        )
    names = _flat_names(feature.get("names"))
    if not names:
        return tuple(f"state_{index}" for index in range(width)), False
    if len(names) != width:
        raise TooltipError(f"{where} has {width} values but {len(names)} names")
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise TooltipError(f"{where} names joints more than once: {', '.join(repeated)}")
    return tuple(names), True


def locate_episode(info: DatasetInfo, episode: int, camera: str, pq: Any) -> EpisodeFiles:
    """Return the files of an episode, which exist.

    Args:
        pq: the module ``pyarrow.parquet``.

    Raises:
        TooltipError: the episode is not listed, or its files are not there.
    """
    with_video = info.cameras()[camera] == "video"
    if info.version[0] == 2:
        files = _locate_v2(info, episode, camera if with_video else None)
    else:
        files = _locate_v3(info, episode, camera if with_video else None, pq)
    absent = [path for path in (files.table, files.video) if path and not path.is_file()]
    if absent:
        raise TooltipError(
            f"{info.root}: episode {episode} is listed, but its files are not there: "
            f"{', '.join(str(path.relative_to(info.root)) for path in absent)}; download them, or "
            "take another episode"
        )
    return files


def _locate_v2(info: DatasetInfo, episode: int, camera: str | None) -> EpisodeFiles:
    listing = info.root / "meta" / "episodes.jsonl"
    if listing.is_file():
        listed = _listed_v2(listing)
    else:
        listed = list(range(_whole(info, "total_episodes", 0)))
    _check_listed(info, episode, listed)
    values = {
        "episode_chunk": episode // max(_whole(info, "chunks_size", 1000), 1),
        "episode_index": episode,
    }
    video = _fill(info, "video_path", _V2_VIDEO, {**values, "video_key": camera})
    table = _fill(info, "data_path", _V2_DATA, values)
    return EpisodeFiles(table, video if camera is not None else None, 0.0, False)


def _listed_v2(listing: Path) -> list[int]:
    listed = []
    for number, line in enumerate(_read_text(listing).splitlines(), start=1):
        if not line.strip():
            continue
        try:
            listed.append(int(json.loads(line)["episode_index"]))
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise TooltipError(f"{listing}:{number}: not an episode's description") from error
    return listed


def _locate_v3(info: DatasetInfo, episode: int, camera: str | None, pq: Any) -> EpisodeFiles:
    tables = sorted((info.root / "meta" / "episodes").glob("chunk-*/file-*.parquet"))
    if not tables:
        raise TooltipError(f"{info.root}: no list of episodes under meta/episodes")
    columns = ["episode_index", "data/chunk_index", "data/file_index"]
    prefix = f"videos/{camera}"
    if camera is not None:
        columns += [f"{prefix}/{name}" for name in ("chunk_index", "file_index", "from_timestamp")]
    rows: dict[int, dict[str, Any]] = {}
    for path in tables:
        try:
            table = pq.read_table(path, columns=columns)
        except Exception as error:  # Arrow's errors have no common root but this
            raise TooltipError(f"{path} cannot be read ({one_line(error)})") from error
        missing = [name for name in columns if name not in table.column_names]
        if missing:
            raise TooltipError(f"{path} lacks the columns {', '.join(missing)}")
        rows.update({row["episode_index"]: row for row in table.to_pylist()})
    _check_listed(info, episode, list(rows))
    row = rows[episode]
    empty = [name for name in columns if row[name] is None]
    if empty:
        raise TooltipError(f"{info.root}: episode {episode} is listed without {', '.join(empty)}")
    values = {"chunk_index": row["data/chunk_index"], "file_index": row["data/file_index"]}
    table_path = _fill(info, "data_path", _V3_DATA, values)
    if camera is None:
        return EpisodeFiles(table_path, None, 0.0, False)
    values = {name: row[f"{prefix}/{name}"] for name in ("chunk_index", "file_index")}
    video = _fill(info, "video_path", _V3_VIDEO, {**values, "video_key": camera})
    start_s = float(row[f"{prefix}/from_timestamp"])
    if not 0 <= start_s < _MAX_VIDEO_S:
        raise TooltipError(f"{info.root}: episode {episode} starts at {start_s} s of its video")
    return EpisodeFiles(table_path, video, start_s, True)


def _check_listed(info: DatasetInfo, episode: int, listed: list[int]) -> None:
    if episode not in listed:
        raise TooltipError(
            f"{info.root} has no episode {episode}; listed: {_ranges(listed) or 'none'}"
        )


def _ranges(numbers: list[int]) -> str:
    """Return e.g. ``0-3, 7`` for 0, 1, 2, 3, 7."""
    spans: list[tuple[int, int]] = []
    for number in sorted(set(numbers)):
        if spans and spans[-1][1] == number - 1:
            spans[-1] = (spans[-1][0], number)
        else:
            spans.append((number, number))
    return ", ".join(str(low) if low == high else f"{low}-{high}" for low, high in spans)


def _fill(info: DatasetInfo, key: str, default: str, values: Mapping[str, Any]) -> Path:
    """Return the path that a template of the data set gives, inside the data set."""
    template = info.fields.get(key) or default
    try:
        path = PurePosixPath(str(template).format(**values))
    except (KeyError, IndexError, ValueError, TypeError, AttributeError) as error:
        raise TooltipError(
            f"{info.root}: '{key}' in meta/info.json is no path template: {shown(template)}"
        ) from error
    if path.is_absolute() or ".." in path.parts:
        raise TooltipError(f"{info.root}: '{key}' in meta/info.json leads out of the data set")
    return info.root / path


def _flat_names(names: Any) -> list[str]:
    if isinstance(names, dict):
        if names and all(isinstance(place, int) for place in names.values()):
            return [str(name) for name in sorted(names, key=lambda name: names[name])]
        return [name for group in names.values() for name in _flat_names(group)]
    if isinstance(names, (list, tuple)):
        return [name for item in names for name in _flat_names(item)]
    return [] if names is None else [str(names)]


def _is_depth(feature: Mapping[str, Any]) -> bool:
    for name in ("info", "video_info"):
        details = feature.get(name)
        if isinstance(details, dict) and (
            details.get("is_depth_map") or details.get("video.is_depth_map")
        ):
            return True
    return False


def _whole(info: DatasetInfo, key: str, default: int) -> int:
    value = info.fields.get(key, default)
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise TooltipError(
            f"{info.root}: '{key}' in meta/info.json must be a whole number, found {shown(value)}"
        )
    return value


def _load_json(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(_read_text(path))
    except (ValueError, RecursionError) as error:
        raise TooltipError(f"{path}: not JSON ({one_line(error)})") from error
    if not isinstance(value, dict):
        raise TooltipError(f"{path}: expected a JSON object, found {type(value).__name__}")
    return value


def _read_text(path: Path) -> str:
    try:
        if path.stat().st_size > _MAX_JSON_BYTES:
            raise TooltipError(f"{path}: too large for a data set's description")
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise TooltipError(f"{path}: cannot be read ({one_line(error)})") from error
