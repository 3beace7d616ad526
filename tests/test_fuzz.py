"""Input from strangers: every reader takes it or refuses it in one line, whatever it is."""

from __future__ import annotations

import io
import random
import struct
import zlib
from pathlib import Path

import cv2
import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.helpers.fuzz import Target, attempt, mutate, targets
from tests.helpers.logs import encoded, image_of, robot_message
from tooltip_cli.errors import DamagedLogError, TooltipError
from tooltip_cli.log.container import iterate
from tooltip_cli.log.imagefiles import declared_size
from tooltip_cli.log.records import MAX_CHUNK_BYTES, RecordError, chunk_head, unpack
from tooltip_cli.log.salvage import salvage
from tooltip_cli.log.writer import LogWriter
from tooltip_cli.rig.camera import load_camera_yaml

NAMES = (
    *("log", "recording", "views", "salvage", "info", "bag import", "detections", "edges"),
    *("compressed image", "raw image", "rig file", "camera file", "URDF", "URDF with tip"),
    *("labels", "joints table", "poses table", "stamps table", "tip file"),
)


@pytest.fixture(scope="module")
def readers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Target]:
    return targets(tmp_path_factory.mktemp("seeds"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("inputs")


def test_every_reader_is_tried(readers: dict[str, Target]) -> None:
    assert set(readers) == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_good_inputs_are_read(name: str, readers: dict[str, Target], folder: Path) -> None:
    for seed in readers[name].seeds:
        assert attempt(readers[name], seed, folder) is None


@pytest.mark.parametrize("name", NAMES)
@settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(number=st.integers(0, 2**63))
def test_nonsense_is_refused_in_one_line(
    number: int, name: str, readers: dict[str, Target], folder: Path
) -> None:
    target, rng = readers[name], random.Random(number)
    data = mutate(rng.choice(target.seeds), target.seeds, rng, text=target.text)
    message = attempt(target, data, folder)
    if message is not None:
        assert message.strip()
        assert len(message) < 3000


def chunk(compression: bytes, data: bytes, size: int, crc: int = 0) -> memoryview:
    head = struct.pack("<QQQII", 0, 0, size, crc, len(compression)) + compression
    return memoryview(head + struct.pack("<Q", len(data)) + data)


def zeros(size: int, *, tell: bool) -> bytes:
    """Return a zstd frame of zeros that does or does not say how many."""
    packer = zstandard.ZstdCompressor(write_content_size=tell)
    out = io.BytesIO()
    with packer.stream_writer(out, size=size if tell else -1, closefd=False) as writer:
        block = bytes(1 << 20)
        for _ in range(size >> 20):
            writer.write(block)
    return out.getvalue()


@pytest.mark.parametrize("tell", [True, False])
def test_a_bomb_is_unpacked_to_what_it_claims_and_no_further(tell: bool) -> None:
    bomb = zeros(1 << 30, tell=tell)
    assert len(bomb) < 100_000
    with pytest.raises(RecordError, match="another size than it claims"):
        unpack(chunk_head(chunk(b"zstd", bomb, 1000)))


def test_an_lz4_bomb_is_not_unpacked_either() -> None:
    bomb = lz4.frame.compress(bytes(1 << 26))
    with pytest.raises(RecordError, match="another size than it claims"):
        unpack(chunk_head(chunk(b"lz4", bomb, 1000)))


def test_a_giant_claim_is_refused_before_it_is_unpacked() -> None:
    with pytest.raises(RecordError, match="more than 128 MiB"):
        chunk_head(chunk(b"zstd", b"", MAX_CHUNK_BYTES + 1))


def test_a_giant_record_is_refused_in_a_file_that_has_room_for_it(tmp_path: Path) -> None:
    path = tmp_path / "sparse.mcap"
    with path.open("wb") as file:
        file.write(b"\x89MCAP0\r\n" + struct.pack("<BQ", 5, 1 << 40))
        file.truncate(1 << 41)
    with pytest.raises(DamagedLogError, match="a record claims 1099511627776 bytes"):
        list(iterate(path))


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_the_size_of_an_image_is_read_from_its_head(suffix: str) -> None:
    height, width = image_of(0).shape
    assert declared_size(memoryview(encoded(image_of(0), suffix))) == (width, height)
    color = np.zeros((33, 77, 3), np.uint8)
    progressive = cv2.imencode(".jpg", color, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    assert declared_size(memoryview(progressive)) == (77, 33)


def test_a_png_that_claims_more_than_it_has_is_not_given_to_a_decoder() -> None:
    data = bytearray(encoded(image_of(0), ".png"))
    assert data[37:41] == b"IDAT"
    data[33:37] = b"\xff" * 4  # a decoder would make four gigabytes of room
    assert declared_size(memoryview(data)) is None


@given(data=st.binary(max_size=200))
def test_a_head_of_anything_is_no_size_or_two_numbers(data: bytes) -> None:
    for start in (b"", b"\xff\xd8", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"):
        size = declared_size(memoryview(start + data))
        assert size is None or (len(size) == 2 and min(size) >= 0)


@pytest.mark.parametrize("key", ["distortion_model", "image_width", "camera_matrix"])
def test_aliases_do_not_unfold(key: str) -> None:
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)]
    with pytest.raises(TooltipError, match="aliases stand for more than 1000000 values"):
        load_camera_yaml("\n".join([*lines, f"{key}: *a11"]), "camera")


def test_a_circle_of_aliases() -> None:
    with pytest.raises(TooltipError, match="or for themselves"):
        load_camera_yaml("a: &a [*a]", "camera")


def test_names_out_of_a_log_are_no_paths(tmp_path: Path) -> None:
    """An attachment named like a file elsewhere stays an attachment."""
    inside = tmp_path / "a" / "b"
    inside.mkdir(parents=True)
    with LogWriter(inside / "log.mcap") as writer:
        writer.write(robot_message())
        writer.attach("../../escaped", "text/plain", b"x")
        writer.attach(str(tmp_path / "escaped"), "text/plain", b"x")
    salvage(inside / "log.mcap", inside / "out.mcap")
    names = sorted(path.name for path in tmp_path.rglob("*") if path.is_file())
    assert names == ["log.mcap", "out.mcap"]
    assert not (tmp_path / "escaped").exists()


def test_chunks_with_a_crc_of_other_bytes() -> None:
    data = b"\x05" + bytes(8)
    assert unpack(chunk_head(chunk(b"", data, len(data), zlib.crc32(data)))) == data
    with pytest.raises(RecordError, match="fails its CRC"):
        unpack(chunk_head(chunk(b"", data, len(data), 1)))
