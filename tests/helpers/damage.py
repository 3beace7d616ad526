"""Logs to be damaged, and what is left of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from tooltip_cli.errors import TooltipError
from tooltip_cli.log.container import LoggedMessage, iterate
from tooltip_cli.log.salvage import salvage

Row = tuple[str, str, int, bytes]


def content(path: Path) -> list[Row]:
    """Return (topic, type, log time, payload) of every message in file order."""
    return [
        (item.topic, item.datatype, item.log_time_ns, item.payload)
        for item in iterate(path)
        if isinstance(item, LoggedMessage)
    ]


def salvaged(broken: Path, out: Path, **options: Any) -> list[Row] | None:
    """Return what salvage recovers; None where it finds nothing to recover."""
    try:
        salvage(broken, out, overwrite=True, **options)
    except TooltipError as error:
        text = str(error)
        assert any(words in text for words in ("no message", "is empty", "not an MCAP")), text
        return None
    return content(out)


def chunk_ends(path: Path) -> list[tuple[int, int]]:
    """Return where each chunk ends in the file, and how many messages it holds."""
    counts: dict[int, int] = {}
    for item in iterate(path):
        if isinstance(item, LoggedMessage):
            counts[item.chunk_offset] = counts.get(item.chunk_offset, 0) + 1
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return [
        (index.chunk_start_offset + index.chunk_length, counts[index.chunk_start_offset])
        for index in summary.chunk_indexes
    ]


def repacked(
    path: Path,
    out: Path,
    compression: CompressionType,
    *,
    chunked: bool = True,
    chunk_bytes: int = 200_000,
) -> Path:
    """Write the messages of a log again with the library's own writer."""
    with out.open("wb") as file:
        writer = McapWriter(
            file,
            compression=compression,
            use_chunking=chunked,
            chunk_size=chunk_bytes,
            enable_data_crcs=True,
        )
        writer.start("ros2", "test")
        channels: dict[str, int] = {}
        for item in iterate(path):
            if not isinstance(item, LoggedMessage):
                writer.add_attachment(0, 0, item.name, item.media_type, item.data)
                continue
            if item.topic not in channels:
                assert item.channel.schema is not None
                schema = writer.register_schema(item.datatype, "ros2msg", item.channel.schema.text)
                channels[item.topic] = writer.register_channel(
                    item.topic, "cdr", schema, {"offered_qos_profiles": ""}
                )
            writer.add_message(
                channels[item.topic], item.log_time_ns, item.payload, item.publish_time_ns
            )
        writer.finish()  # type: ignore[no-untyped-call]  # the library's own gap
    return out
