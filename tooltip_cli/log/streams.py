"""Every stream of a log, whatever it carries: type, number, bytes and timing."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from tooltip_cli.log.container import LoggedAttachment, LoggedMessage
from tooltip_cli.log.messages import header_stamp_ns
from tooltip_cli.log.records import LoggedSchema
from tooltip_cli.log.timing import Timing, timing

_END_OF_TIME_NS = 2**63 - 1  # MCAP counts in 64 bits without a sign, arrays with one


@dataclass(frozen=True)
class Stream:
    """One topic of a log."""

    topic: str
    datatype: str
    encoding: str
    size_bytes: int  # of all messages
    clock: str  # "header" stamps where the type has a header, else "log" times
    timing: Timing
    latency_s: float | None  # median of log time minus header stamp; None without header


@dataclass
class _Collected:
    datatype: str
    encoding: str
    has_header: bool
    size: int = 0
    stamps: list[int] = field(default_factory=list)
    log_times: list[int] = field(default_factory=list)


def all_streams(items: Iterable[LoggedMessage | LoggedAttachment]) -> list[Stream]:
    """Return the streams of a log in the order of their first messages.

    Memory: the stamps.
    """
    collected: dict[str, _Collected] = {}
    for item in items:
        if not isinstance(item, LoggedMessage):
            continue
        found = collected.get(item.topic)
        if found is None:
            has_header = item.encoding == "cdr" and _has_header(item.channel.schema)
            found = _Collected(item.datatype, item.encoding, has_header)
            collected[item.topic] = found
        found.size += len(item.payload)
        found.log_times.append(min(item.log_time_ns, _END_OF_TIME_NS))
        stamp_ns = header_stamp_ns(item.payload) if found.has_header else None
        if stamp_ns is not None:
            found.stamps.append(stamp_ns)
    return [_stream(topic, found) for topic, found in collected.items()]


def _has_header(schema: LoggedSchema | None) -> bool:
    """Whether the messages of a type begin with a std_msgs/Header."""
    if schema is None or schema.encoding != "ros2msg":
        return False
    for line in schema.text.decode("utf-8", "replace").splitlines():
        words = line.partition("#")[0].split()
        if words and "=" not in line.partition("#")[0]:
            return words[0] in ("std_msgs/Header", "std_msgs/msg/Header", "Header")
    return False


def _stream(topic: str, found: _Collected) -> Stream:
    log_times = np.array(found.log_times, dtype=np.int64)
    by_header = found.has_header and len(found.stamps) == len(log_times)
    stamps = np.array(found.stamps, dtype=np.int64) if by_header else log_times
    latency_s = float(np.median((log_times - stamps) / 1e9)) if by_header else None
    return Stream(
        topic=topic,
        datatype=found.datatype,
        encoding=found.encoding,
        size_bytes=found.size,
        clock="header" if by_header else "log",
        timing=timing(stamps),
        latency_s=latency_s,
    )
