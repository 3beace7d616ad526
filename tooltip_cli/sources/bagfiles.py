"""Bags on disk: ROS 1 ``.bag``, ROS 2 folders and their ``.db3`` and ``.mcap`` files.

MCAP is read with our own container, which verifies every checksum and keeps both times of a
message; SQLite and ROS 1 are read with ``rosbags``.
"""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from tooltip_cli.errors import TooltipError
from tooltip_cli.log.container import LoggedMessage, iterate, open_log
from tooltip_cli.log.mcapfile import MAGIC
from tooltip_cli.log.qos import known_qos, latched_qos, qos_of_profiles
from tooltip_cli.log.records import MAX_RECORD_BYTES, unpack_zstd
from tooltip_cli.rig.documents import parse_yaml
from tooltip_cli.sources.ros1types import definition_sum, ros2_name
from tooltip_cli.sources.streams import missing_extra, one_line

if TYPE_CHECKING:
    from rosbags.rosbag1 import Reader as Ros1Reader
    from rosbags.rosbag2 import Reader as Ros2Reader

FEATURE, EXTRA = "record bag", "bag"
_SQLITE_MAGIC = b"SQLite format 3\0"
_SQLITE_FIELDS = ((16, 18), (24, 28), (28, 32), (92, 96))  # page size, changes, pages, valid for
_ROS1_MAGIC = b"#ROSBAG V"
_KINDS = {".mcap": "mcap", ".db3": "sqlite3"}
_COMPRESSED = ".zstd"
_BLOCK_BYTES = 1 << 20
_LEAVE_BYTES = 100_000_000
_QOS = "offered_qos_profiles"
_URI_CHARACTERS = frozenset("?#%")  # rosbags puts the path into an SQLite URI as it is


@dataclass(frozen=True, slots=True)
class StoredTopic:
    """A topic of a bag."""

    datatype: str  # ROS 2 type name; several joined by " and " where publishers disagree
    encoding: str  # "cdr", "ros1" or what the file says
    count: int  # messages
    qos: str | None = None  # offered_qos_profiles as YAML; None: not known


@dataclass(frozen=True, slots=True)
class StoredMessage:
    """A message of a bag, as stored."""

    topic: str
    log_time_ns: int
    publish_time_ns: int
    payload: bytes


class Bag(Protocol):
    """A bag that can be read from the start any number of times."""

    @property
    def notes(self) -> list[str]:
        """What a person should know about the files."""

    def topics(self) -> dict[str, StoredTopic]:
        """Return the topics by name.

        Raises:
            TooltipError: a damaged or foreign file.
        """

    def messages(self, wanted: Collection[str]) -> Iterator[StoredMessage]:
        """Yield the messages of the wanted topics in the bag's order.

        Raises:
            TooltipError: a damaged file.
        """


def open_bag(path: Path) -> Bag:
    """Return a bag by what its files hold.

    Raises:
        TooltipError: there is no such file or folder, or it is no bag.
        MissingExtraError: ``rosbags`` is needed and not installed.
    """
    if path.is_dir():
        return _open_folder(path)
    try:
        with path.open("rb") as file:
            start = file.read(16)
    except OSError as error:
        raise TooltipError(f"{path}: cannot be opened ({error.strerror})") from error
    if start.startswith(_ROS1_MAGIC):
        return Ros1Bag(path)
    if start.startswith(MAGIC) or path.suffix == ".mcap":
        return Ros2Bag((path,), "mcap")
    if start.startswith(_SQLITE_MAGIC):
        return Ros2Bag((path,), "sqlite3")
    kind = _KINDS.get(path.with_suffix("").suffix) if path.suffix == _COMPRESSED else None
    if kind is not None:
        return Ros2Bag((path,), kind)
    what = "is empty" if not start else "is no bag"
    raise TooltipError(
        f"{path} {what}; expected a ROS 1 .bag, a ROS 2 folder, a .db3 or an .mcap file"
    )


def _open_folder(folder: Path) -> Bag:
    description = folder / "metadata.yaml"
    if description.exists():
        return _described_folder(folder, description)
    # a recorder that crashed leaves its files without the description
    for suffix, kind in _KINDS.items():
        files = sorted([*folder.glob(f"*{suffix}"), *folder.glob(f"*{suffix}{_COMPRESSED}")])
        if files:
            bag = Ros2Bag(tuple(files), kind)
            bag.notes.append(f"{folder} has no metadata.yaml; read {len(files)} {suffix} files")
            return bag
    bags = sorted(folder.glob("*.bag"))
    found = f"; it holds ROS 1 bags, give one of them: {bags[0]}" if bags else ""
    raise TooltipError(f"{folder} is no ROS 2 bag: neither metadata.yaml nor .db3 or .mcap{found}")


def _described_folder(folder: Path, description: Path) -> Bag:
    try:
        document = parse_yaml(description.read_text(encoding="utf-8"), str(description))
        metadata: dict[str, Any] = document["rosbag2_bagfile_information"]
        # early versions wrote the folder's name before the file's
        names = [Path(str(name)).name for name in metadata["relative_file_paths"]]
        kind = str(metadata["storage_identifier"])
        mode = str(metadata.get("compression_mode") or "").lower()
        scheme = str(metadata.get("compression_format") or "")
    except (OSError, UnicodeDecodeError) as error:
        raise TooltipError(f"{description}: cannot be read ({one_line(error)})") from error
    except (KeyError, TypeError, AttributeError) as error:
        raise TooltipError(
            f"{description} is no description of a ROS 2 bag ({one_line(error)}); expected "
            "rosbag2_bagfile_information with relative_file_paths and storage_identifier"
        ) from error
    if kind not in _KINDS.values():
        raise TooltipError(f"{description}: storage '{kind}' is not read; known: mcap, sqlite3")
    if mode not in ("", "none") and scheme != "zstd":
        raise TooltipError(f"{description}: compression '{scheme}' is not read; known: zstd")
    missing = [name for name in names if not (folder / name).is_file()]
    if missing or not names:
        raise TooltipError(f"{description} names files that are not there: {', '.join(missing)}")
    return Ros2Bag(tuple(folder / name for name in names), kind, per_message=mode == "message")


class Ros2Bag:
    """One or more files of a ROS 2 bag, or any MCAP file, in the order given."""

    def __init__(self, files: tuple[Path, ...], kind: str, *, per_message: bool = False) -> None:
        self._files, self._kind, self._per_message = files, kind, per_message
        self.notes: list[str] = []
        for file in files:
            journal = file.with_name(f"{file.name}-wal")
            if kind == "sqlite3" and journal.is_file() and journal.stat().st_size:
                self.notes.append(
                    f"{journal} holds messages that the recorder had not merged; they are not "
                    f"read until 'sqlite3 {file} \"PRAGMA wal_checkpoint\"' merges them"
                )

    def topics(self) -> dict[str, StoredTopic]:
        """Return the topics of all files."""
        merged: dict[str, StoredTopic] = {}
        scan = _mcap_topics if self._kind == "mcap" else _sqlite_topics
        for path in self._files:
            with _plain(path) as plain:
                for topic, found in scan(plain, path):
                    merged[topic] = _merge(merged.get(topic), found)
        return merged

    def messages(self, wanted: Collection[str]) -> Iterator[StoredMessage]:
        """Yield the messages of the files, one file after the other."""
        read = _mcap_messages if self._kind == "mcap" else _sqlite_messages
        for path in self._files:
            with _plain(path) as plain:
                for message in read(plain, path, wanted):
                    yield self._unpacked(message, path) if self._per_message else message

    def _unpacked(self, message: StoredMessage, path: Path) -> StoredMessage:
        with _reading(path, "zstd-compressed ROS 2 bag"):
            payload = unpack_zstd(message.payload, MAX_RECORD_BYTES)
            if len(payload) > MAX_RECORD_BYTES:
                raise ValueError(f"a message of more than {MAX_RECORD_BYTES} bytes")
        times = message.log_time_ns, message.publish_time_ns
        return StoredMessage(message.topic, *times, payload)


class Ros1Bag:
    """A ROS 1 bag, format 2.0."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.notes: list[str] = []

    def topics(self) -> dict[str, StoredTopic]:
        """Return the topics of all connections."""
        merged: dict[str, StoredTopic] = {}
        with _reading(self._path, "ROS 1 bag"), self._reader() as reader:
            for connection in reader.connections:
                # a default serves publishers that do not latch
                qos = latched_qos() if getattr(connection.ext, "latching", None) else None
                found = StoredTopic(connection.msgtype, "ros1", connection.msgcount, qos)
                merged[connection.topic] = _merge(merged.get(connection.topic), found)
        return merged

    def messages(self, wanted: Collection[str]) -> Iterator[StoredMessage]:
        """Yield the messages by the bag's time."""
        with _reading(self._path, "ROS 1 bag"), self._reader() as reader:
            connections = [item for item in reader.connections if item.topic in wanted]
            for item in connections:
                _check_definition(item.topic, item.msgtype, item.digest, self._path)
            for item, time_ns, payload in reader.messages(connections) if connections else ():
                yield StoredMessage(item.topic, time_ns, time_ns, payload)

    def _reader(self) -> Ros1Reader:
        try:
            from rosbags.rosbag1 import Reader
        except ImportError as error:
            raise missing_extra(FEATURE, EXTRA, error) from error
        return Reader(self._path)


def _check_definition(topic: str, datatype: str, digest: str, path: Path) -> None:
    expected = definition_sum(datatype)
    # writers that copy unknown types note the sum as "*"
    if digest not in (expected, "*", ""):
        raise TooltipError(
            f"{path}: {datatype} on {topic} has another definition (MD5 {digest}) than in ROS 1 "
            f"({expected}) and cannot be converted"
        )


def _merge(known: StoredTopic | None, found: StoredTopic) -> StoredTopic:
    if known is None:
        return found
    return StoredTopic(
        " and ".join(dict.fromkeys([*known.datatype.split(" and "), found.datatype])),
        " and ".join(dict.fromkeys([*known.encoding.split(" and "), found.encoding])),
        known.count + found.count,
        known.qos or found.qos,
    )


def _mcap_topics(plain: Path, path: Path) -> Iterator[tuple[str, StoredTopic]]:
    summary = _mcap_summary(plain)
    if summary is not None:
        yield from summary
        return
    for item in iterate(plain):
        if isinstance(item, LoggedMessage):
            qos = known_qos(item.channel.metadata.get(_QOS, ""))
            yield item.topic, StoredTopic(ros2_name(item.datatype), item.encoding, 1, qos)


def _mcap_summary(plain: Path) -> list[tuple[str, StoredTopic]] | None:
    """Return the topics by the file's own summary; None where it has none that is complete."""
    from mcap.reader import make_reader

    with open_log(plain) as file:
        try:
            summary = make_reader(file).get_summary()
        except Exception:  # whatever is wrong, reading all of the file says it better
            return None
    if summary is None or summary.statistics is None:
        return None
    topics = []
    for channel_id, count in summary.statistics.channel_message_counts.items():
        channel = summary.channels.get(channel_id)
        schema = summary.schemas.get(channel.schema_id) if channel is not None else None
        if channel is None or (schema is None and channel.schema_id):
            return None
        datatype = ros2_name(schema.name) if schema is not None else ""
        qos = known_qos(channel.metadata.get(_QOS, ""))
        topics.append((channel.topic, StoredTopic(datatype, channel.message_encoding, count, qos)))
    return topics


def _mcap_messages(plain: Path, path: Path, wanted: Collection[str]) -> Iterator[StoredMessage]:
    for item in iterate(plain):
        if isinstance(item, LoggedMessage) and item.topic in wanted:
            yield StoredMessage(item.topic, item.log_time_ns, item.publish_time_ns, item.payload)


def _sqlite_topics(plain: Path, path: Path) -> Iterator[tuple[str, StoredTopic]]:
    with _reading(path, "ROS 2 SQLite bag"), _sqlite_reader(plain) as reader:
        for item in reader.connections:
            encoding = str(getattr(item.ext, "serialization_format", ""))
            qos = qos_of_profiles(getattr(item.ext, "offered_qos_profiles", None) or [])
            yield item.topic, StoredTopic(ros2_name(item.msgtype), encoding, item.msgcount, qos)


def _sqlite_messages(plain: Path, path: Path, wanted: Collection[str]) -> Iterator[StoredMessage]:
    with _reading(path, "ROS 2 SQLite bag"), _sqlite_reader(plain) as reader:
        connections = [item for item in reader.connections if item.topic in wanted]
        for item, time_ns, payload in reader.messages(connections) if connections else ():
            yield StoredMessage(item.topic, time_ns, time_ns, payload)


def _check_sqlite_size(path: Path) -> None:
    """Refuse a file that is shorter than its header says: SQLite would read zeros there.

    Source: SQLite's "Database File Format", section 1.3.

    Raises:
        TooltipError: the file is truncated.
    """
    with path.open("rb") as file:
        header = file.read(100)
    if len(header) < 100:
        raise TooltipError(f"{path} is truncated: it ends inside its header")
    page, changes, pages, valid_for = (
        int.from_bytes(header[start:end], "big") for start, end in _SQLITE_FIELDS
    )
    wanted = (1 << 16 if page == 1 else page) * pages
    size = path.stat().st_size
    if changes == valid_for and size < wanted:
        raise TooltipError(f"{path} is truncated: it has {size} bytes of {wanted}")


@contextlib.contextmanager
def _sqlite_reader(path: Path) -> Iterator[Ros2Reader]:
    try:
        from rosbags.rosbag2 import Reader
    except ImportError as error:
        raise missing_extra(FEATURE, EXTRA, error) from error
    _check_sqlite_size(path)
    with contextlib.ExitStack() as stack:
        target = path.resolve()
        if target.suffix != ".db3" or _URI_CHARACTERS & set(str(target)):
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            target = folder / "bag.db3"
            target.symlink_to(path.resolve())
        yield stack.enter_context(Reader(target))


@contextlib.contextmanager
def _plain(path: Path) -> Iterator[Path]:
    """Provide a file of which the whole may be zstd-compressed."""
    if path.suffix != _COMPRESSED:
        yield path
        return
    import zstandard

    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / path.stem
        with _reading(path, "zstd file"), path.open("rb") as packed, plain.open("wb") as out:
            frame = zstandard.ZstdDecompressor().decompressobj()
            while block := packed.read(_BLOCK_BYTES):
                out.write(frame.decompress(block))
                if shutil.disk_usage(folder).free < _LEAVE_BYTES:
                    raise ValueError("it unpacks to more than the temporary directory can hold")
        if not frame.eof:
            raise TooltipError(f"{path} is truncated: its compressed data do not end")
        try:
            yield plain
        except TooltipError as error:
            raise type(error)(str(error).replace(str(plain), str(path))) from error


@contextlib.contextmanager
def _reading(path: Path, kind: str) -> Iterator[None]:
    """Turn what a library meets in a damaged file into one line."""
    try:
        yield
    except TooltipError:
        raise
    except Exception as error:  # assertions, codec, struct and index errors all occur
        text = one_line(error)
        advice = ""
        if kind == "ROS 1 bag":
            advice = "; it is damaged or was not closed, 'rosbag reindex' mends a missing index"
        raise TooltipError(f"{path} cannot be read as a {kind} ({text}){advice}") from error
