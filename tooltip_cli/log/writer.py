"""Writing MCAP: profile ``ros2``, CDR with ``ros2msg`` schemas, CRCs on everything."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

import mcap
from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from tooltip_cli import __version__
from tooltip_cli.errors import TooltipError
from tooltip_cli.log.messages import Message, schema_text

_CHUNK_BYTES = 1024 * 1024
_IN_PROGRESS = ".partial"


class LogWriter:
    """Writes one MCAP file whole or not at all.

    Used as a context manager: the file appears under its name when the block ends well; when it
    ends with an exception nothing remains.

    Raises:
        TooltipError: the file exists and ``overwrite`` is false, or cannot be written.
    """

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        self._path = path
        with self._disk_errors():
            exists = path.exists()
        if exists and not overwrite:
            raise TooltipError(f"{path} exists; give another name, or --force to replace it")
        self._temporary = path.with_name(f".{path.name}.{os.getpid()}{_IN_PROGRESS}")
        self._channels: dict[str, int] = {}
        self._types: dict[str, str] = {}
        self._schemas: dict[str, int] = {}

    def __enter__(self) -> LogWriter:
        with self._disk_errors():
            self._file: BinaryIO = self._temporary.open("wb")
        # CRCs over the data section too: a flipped bit outside the chunks is then found as well
        self._writer = McapWriter(
            self._file,
            chunk_size=_CHUNK_BYTES,
            compression=CompressionType.ZSTD,
            enable_crcs=True,
            enable_data_crcs=True,
        )
        self._writer.start(Profile.ROS2, f"tooltip-cli/{__version__} mcap/{_mcap_version()}")
        return self

    def write(self, message: Message) -> None:
        """Append a message; a topic keeps the type of its first message.

        Raises:
            TooltipError: the topic has another type, or the disk takes no more.
        """
        channel = self._channel(message.topic, message.datatype)
        published = message.publish_time_ns
        with self._disk_errors():
            self._writer.add_message(
                channel,
                log_time=message.log_time_ns,
                data=message.payload,
                publish_time=message.log_time_ns if published is None else published,
            )

    def attach(self, name: str, media_type: str, data: bytes, stamp_ns: int = 0) -> None:
        """Append an attachment."""
        with self._disk_errors():
            self._writer.add_attachment(stamp_ns, stamp_ns, name, media_type, data)

    def metadata(self, name: str, values: dict[str, str]) -> None:
        """Append a metadata record."""
        with self._disk_errors():
            self._writer.add_metadata(name, values)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                with self._disk_errors():
                    self._writer.finish()  # type: ignore[no-untyped-call]  # the library's own gap
                    self._file.flush()
                    os.fsync(self._file.fileno())
                    self._file.close()
                    self._temporary.replace(self._path)
        finally:
            # on a full disk closing fails too, on what is still buffered
            with contextlib.suppress(OSError):
                self._file.close()
            with contextlib.suppress(OSError):
                self._temporary.unlink()

    def _channel(self, topic: str, datatype: str) -> int:
        if topic in self._channels:
            if self._types[topic] != datatype:
                raise TooltipError(
                    f"{self._path}: topic {topic} carries {self._types[topic]} and cannot also "
                    f"carry {datatype}"
                )
            return self._channels[topic]
        if datatype not in self._schemas:
            self._schemas[datatype] = self._writer.register_schema(
                datatype, SchemaEncoding.ROS2, schema_text(datatype).encode()
            )
        self._types[topic] = datatype
        # The MCAP registry requires offered_qos_profiles for the profile ros2; empty: unknown
        self._channels[topic] = self._writer.register_channel(
            topic, MessageEncoding.CDR, self._schemas[datatype], {"offered_qos_profiles": ""}
        )
        return self._channels[topic]

    @contextlib.contextmanager
    def _disk_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise TooltipError(f"{self._path}: cannot be written ({error.strerror})") from error


def _mcap_version() -> str:
    return str(mcap.__version__)
