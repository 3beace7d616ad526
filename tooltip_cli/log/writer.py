"""Writing logs: profile ``ros2``, CDR with ``ros2msg`` schemas, CRCs on everything.

:class:`LogWriter` is for results that can be made again: the file is there whole or not at all.
:class:`tooltip_cli.log.crashsafe.CrashSafeWriter` is for recordings, which cannot.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from mcap.well_known import MessageEncoding, Profile, SchemaEncoding

from tooltip_cli import __version__
from tooltip_cli.errors import TooltipError
from tooltip_cli.log.mcapfile import McapFile
from tooltip_cli.log.messages import Message, schema_text
from tooltip_cli.log.qos import default_qos

_IN_PROGRESS = ".partial"


class MessageWriter:
    """What both kinds of writer do: messages, attachments and metadata into one MCAP file."""

    _mcap: McapFile

    def __init__(self, path: Path, *, overwrite: bool) -> None:
        self._path = path
        self._overwrite = overwrite
        self._channels: dict[str, int] = {}
        self._types: dict[str, str] = {}
        self._schemas: dict[str, int] = {}
        with self._disk_errors():
            self._check_absent()

    def write(self, message: Message) -> None:
        """Append a message; a topic keeps the type and the QoS of its first message.

        Raises:
            TooltipError: the topic has another type, or the disk takes no more.
        """
        with self._writing():
            channel = self._channel(message)
            published = message.publish_time_ns
            self._mcap.add_message(
                channel,
                message.log_time_ns,
                message.log_time_ns if published is None else published,
                message.payload,
            )

    def attach(self, name: str, media_type: str, data: bytes, stamp_ns: int = 0) -> None:
        """Append an attachment."""
        with self._writing():
            self._mcap.add_attachment(name, media_type, data, stamp_ns)

    def metadata(self, name: str, values: dict[str, str]) -> None:
        """Append a metadata record."""
        with self._writing():
            self._mcap.add_metadata(name, values)

    def _start(self, file: BinaryIO) -> None:
        self._mcap = McapFile(file, profile=Profile.ROS2, library=f"tooltip-cli/{__version__}")

    def _writing(self) -> AbstractContextManager[None]:
        """Surround everything that touches the file."""
        return self._disk_errors()

    def _check_absent(self) -> None:
        if self._path.exists() and not self._overwrite:
            raise TooltipError(f"{self._path} exists; give another name, or --force to replace it")

    def _channel(self, message: Message) -> int:
        topic, datatype = message.topic, message.datatype
        if topic in self._channels:
            if self._types[topic] != datatype:
                raise TooltipError(
                    f"{self._path}: topic {topic} carries {self._types[topic]} and cannot also "
                    f"carry {datatype}"
                )
            return self._channels[topic]
        if datatype not in self._schemas:
            self._schemas[datatype] = self._mcap.add_schema(
                datatype, SchemaEncoding.ROS2, schema_text(datatype).encode()
            )
        self._types[topic] = datatype
        qos = default_qos(topic) if message.qos is None else message.qos
        # the MCAP registry requires offered_qos_profiles for the profile ros2
        self._channels[topic] = self._mcap.add_channel(
            topic, MessageEncoding.CDR, self._schemas[datatype], {"offered_qos_profiles": qos}
        )
        return self._channels[topic]

    @contextlib.contextmanager
    def _disk_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise TooltipError(f"{self._path}: cannot be written ({error.strerror})") from error


class LogWriter(MessageWriter):
    """Writes one MCAP file whole or not at all.

    Used as a context manager: the file appears under its name when the block ends well; when it
    ends with an exception nothing remains.

    Raises:
        TooltipError: the file exists and ``overwrite`` is false, or cannot be written.
    """

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        super().__init__(path, overwrite=overwrite)
        self._temporary = path.with_name(f".{path.name}.{os.getpid()}{_IN_PROGRESS}")

    def __enter__(self) -> LogWriter:
        with self._disk_errors():
            self._file: BinaryIO = self._temporary.open("wb", buffering=0)
            try:
                self._start(self._file)
            except OSError:
                self._discard()
                raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                with self._disk_errors():
                    self._mcap.finish()
                    os.fsync(self._file.fileno())
                    self._file.close()
                    self._temporary.replace(self._path)
        finally:
            self._discard()

    def _discard(self) -> None:
        self._file.close()
        with contextlib.suppress(OSError):
            self._temporary.unlink()
