"""Writing logs: profile ``ros2``, CDR with ``ros2msg`` schemas, CRCs on everything.

:class:`LogWriter` is for results that can be made again: the file is there whole or not at all.
:class:`tooltip_cli.log.crashsafe.CrashSafeWriter` is for recordings, which cannot.
"""

from __future__ import annotations

import contextlib
from contextlib import AbstractContextManager
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from mcap.well_known import MessageEncoding, Profile, SchemaEncoding

from tooltip_cli import __version__
from tooltip_cli.errors import TooltipError
from tooltip_cli.log.container import LoggedMessage
from tooltip_cli.log.copier import Copier
from tooltip_cli.log.mcapfile import McapFile
from tooltip_cli.log.messages import Message, schema_text
from tooltip_cli.log.qos import default_qos
from tooltip_cli.log.whole import check_absent, disk_errors, whole_file


class MessageWriter:
    """What both kinds of writer do: messages, attachments and metadata into one MCAP file."""

    _mcap: McapFile

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        self._path = path
        self._channels: dict[str, int] = {}
        self._types: dict[str, str] = {}
        self._schemas: dict[str, int] = {}
        check_absent(path, overwrite=overwrite)

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

    def copy(self, message: LoggedMessage) -> None:
        """Append a message of another log with its own definition and QoS."""
        with self._writing():
            self._copier.copy(message)

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
        self._copier = Copier(self._mcap, plain_qos=True)

    def _writing(self) -> AbstractContextManager[None]:
        """Surround everything that touches the file."""
        return disk_errors(self._path)

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


class LogWriter(MessageWriter):
    """Writes one MCAP file whole or not at all.

    Used as a context manager: the file appears under its name when the block ends well; when it
    ends with an exception nothing remains.

    Raises:
        TooltipError: the file exists and ``overwrite`` is false, or cannot be written.
    """

    def __enter__(self) -> LogWriter:
        with contextlib.ExitStack() as stack:
            file = stack.enter_context(whole_file(self._path))
            with self._writing():
                self._start(file)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with self._stack:
            if error is not None:
                raise error  # for the file to see it, and to leave nothing
            with self._writing():
                self._mcap.finish()
