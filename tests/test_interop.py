"""Our files open without complaint in readers that this project has no hand in."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Footer, SummaryOffset
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader

from tests.helpers.interop import FILES, one_of_each
from tooltip_cli.log.container import LoggedMessage, iterate

INTEROP = Path(__file__).parent / "interop"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return one_of_each(tmp_path_factory.mktemp("interop"))


def counts(path: Path) -> dict[str, int]:
    return dict(Counter(item.topic for item in iterate(path) if isinstance(item, LoggedMessage)))


@pytest.fixture(scope="module")
def node_results(files: dict[str, Path]) -> dict[str, dict[str, Any]]:
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed")
    if not (INTEROP / "node_modules").is_dir():
        pytest.skip("the node packages are not installed: make interop")
    done = subprocess.run(
        [node, str(INTEROP / "read.mjs"), *map(str, files.values())],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stderr == ""
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    return dict(zip(files, rows, strict=True))


@pytest.mark.parametrize("kind", FILES)
def test_the_node_reader_decodes_every_message(
    kind: str, files: dict[str, Path], node_results: dict[str, dict[str, Any]]
) -> None:
    """By the index and as a stream; and what it encodes again are the same bytes."""
    found = node_results[kind]
    assert found["problems"] == []
    assert found["counts"] == found["stream"] == counts(files[kind])
    assert found["profile"] == "ros2"


@pytest.mark.parametrize("kind", FILES)
def test_rosbags_opens_each_file_as_a_bag(kind: str, files: dict[str, Path]) -> None:
    found: Counter[str] = Counter()
    with AnyReader([files[kind]]) as reader:
        for connection, _, raw in reader.messages():
            reader.deserialize(raw, connection.msgtype)
            found[connection.topic] += 1
    assert dict(found) == counts(files[kind])


@pytest.mark.parametrize("kind", FILES)
def test_the_library_finds_the_same_by_index(kind: str, files: dict[str, Path]) -> None:
    with files[kind].open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        found = Counter(channel.topic for _, channel, _ in reader.iter_messages())
        summary = reader.get_summary()
    assert dict(found) == counts(files[kind])
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == sum(found.values())
    assert summary.statistics.channel_count == len(summary.channels)
    assert summary.statistics.schema_count == len(summary.schemas)


@pytest.mark.parametrize("kind", FILES)
def test_the_rules_of_the_profile_hold(kind: str, files: dict[str, Path]) -> None:
    """MCAP format registry: message encodings, schema encodings, profile ``ros2``."""
    with files[kind].open("rb") as file:
        reader = make_reader(file)
        header, summary = reader.get_header(), reader.get_summary()
    assert header.profile == "ros2"
    assert header.library.startswith("tooltip-cli/")
    assert summary is not None
    for channel in summary.channels.values():
        assert channel.message_encoding == "cdr"
        assert "offered_qos_profiles" in channel.metadata
        assert summary.schemas[channel.schema_id].encoding == "ros2msg"
        package, kind_, _ = summary.schemas[channel.schema_id].name.split("/")
        assert (bool(package), kind_) == (True, "msg")
    groups = {item.group_opcode for item in summary_offsets(files[kind])}
    assert {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS, Opcode.CHUNK_INDEX} <= groups


def summary_offsets(path: Path) -> list[SummaryOffset]:
    with path.open("rb") as file:
        file.seek(-37, os.SEEK_END)
        footer = next(iter(StreamReader(file, skip_magic=True).records))
        assert isinstance(footer, Footer)
        file.seek(footer.summary_offset_start)
        records = StreamReader(file, skip_magic=True).records
        found = []
        for record in records:
            if not isinstance(record, SummaryOffset):
                break
            found.append(record)
    return found
