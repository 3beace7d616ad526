"""``STEM.edges.mcap``: what is written is read, and nothing else is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from tests.helpers import refusal
from tooltip_cli.log import messages
from tooltip_cli.log.detections import read_provenance
from tooltip_cli.log.edges import SILHOUETTE_TOPIC, TOPIC, read_edges, write_edges
from tooltip_cli.log.messages import MOVING_EDGES, SILHOUETTE, Message
from tooltip_cli.log.writer import LogWriter
from tooltip_cli.method.voting.moving import MovingEdges
from tooltip_cli.method.voting.silhouette import BACKGROUND, FOREGROUND, UNKNOWN, Silhouettes

STAMPS = 1_700_000_000_123_456_789 + 33_333_333 * np.arange(40, dtype=np.int64)
FIELDS = ("frames", "partners", "affines", "counts", "pixels", "translations", "covariances")


def some_edges(counts: tuple[int, ...] = (5, 0, 300)) -> MovingEdges:
    rng = np.random.default_rng(3)
    rows, total = len(counts), sum(counts)
    frames = 4 + 7 * np.arange(rows)
    affines = rng.normal(size=(rows, 2, 2, 3))
    affines[1:2] = np.nan  # no model
    pixels = rng.integers(0, 2**16, (total, 2)).astype(np.uint16)
    pixels[:1] = (0, 65535)
    pixels[1:2] = (65535, 0)
    translations = rng.integers(-128, 128, (total, 2, 2)).astype(np.int8)
    return MovingEdges(
        frames,
        np.stack([frames - 3, frames + 2], axis=1),
        affines,
        np.array(counts, dtype=np.int64),
        pixels,
        translations,
        rng.normal(size=(total, 2, 3)).astype(np.float32),
    )


def some_silhouettes(count: int = 3) -> Silhouettes:
    rng = np.random.default_rng(9)
    values = np.array([UNKNOWN, BACKGROUND, FOREGROUND], np.uint8)
    counts = np.arange(count)[::-1] * 40
    return Silhouettes(
        rng.choice(values, (count, 24, 33)),
        3,
        counts,
        rng.uniform(-1, 99, (int(counts.sum()), 2)).astype(np.float32),
    )


def written(path: Path, edges: MovingEdges | None = None) -> Path:
    write_edges(path, edges or some_edges(), STAMPS, "camera", {"key": "k", "version": "v"})
    return path


def spoilt(path: Path, silhouette: dict[str, Any] | None = None, **changes: Any) -> Path:
    """Write one frame of two edges, with some fields of the messages changed."""
    fields = {
        "header": messages.header(int(STAMPS[4]), "camera"),
        "partners": [messages.time_from_ns(int(STAMPS[i])) for i in (1, 6)],
        "affines": [0.0] * 12,
        "count": 2,
        "edge_step": 32,
        "data": bytes(64),
        **changes,
    }
    with LogWriter(path) as writer:
        payload = messages.encode(MOVING_EDGES, fields)
        writer.write(Message(TOPIC, MOVING_EDGES, int(STAMPS[4]), payload))
        if silhouette is not None:
            mask = bytes(cv2.imencode(".png", np.full((4, 6), FOREGROUND, np.uint8))[1])
            fields = {"scale": 1, "mask": mask, "count": 2, "contour": bytes(16), **silhouette}
            fields["header"] = messages.header(int(STAMPS[4]), "camera")
            payload = messages.encode(SILHOUETTE, fields)
            writer.write(Message(SILHOUETTE_TOPIC, SILHOUETTE, int(STAMPS[4]), payload))
    return path


def refused(path: Path, stamps: npt.NDArray[np.int64] = STAMPS) -> str:
    message = refusal(lambda: read_edges(path, stamps))
    assert message is not None
    assert str(path) in message
    return message


@pytest.mark.parametrize("counts", [(5, 0, 300), (2,), (0,)])
def test_what_is_written_is_read(tmp_path: Path, counts: tuple[int, ...]) -> None:
    edges = some_edges(counts)
    back = read_edges(written(tmp_path / "a.edges.mcap", edges), STAMPS)
    for name in FIELDS:
        first, second = getattr(edges, name), getattr(back, name)
        assert second.dtype == first.dtype, name
        np.testing.assert_array_equal(second, first, name)


@pytest.mark.parametrize("count", [3, 1])
def test_silhouettes_are_read_as_they_were(tmp_path: Path, count: int) -> None:
    silhouettes = some_silhouettes(count)
    edges = replace(some_edges((5, 0, 300)[:count]), silhouettes=silhouettes)
    back = read_edges(written(tmp_path / "a.edges.mcap", edges), STAMPS).silhouettes
    assert back is not None
    assert back.scale == silhouettes.scale
    for name in ("masks", "counts", "contours"):
        np.testing.assert_array_equal(getattr(back, name), getattr(silhouettes, name), name)


def test_edges_of_some_frames_have_their_silhouettes() -> None:
    edges = replace(some_edges(), silhouettes=some_silhouettes())
    part = edges.of_frames(edges.frames[[0, 2]])
    assert part.counts.tolist() == [5, 300]
    np.testing.assert_array_equal(part.pixels, edges.pixels)  # the frame between has none
    assert part.silhouettes is not None
    assert part.silhouettes.counts.tolist() == [80, 0]


@pytest.mark.parametrize(
    "changes",
    [{"scale": 0}, {"mask": b""}, {"mask": b"no image"}, {"count": 3}, {"contour": bytes(15)}],
)
def test_another_layout_of_silhouettes_is_refused(tmp_path: Path, changes: dict[str, Any]) -> None:
    good = read_edges(spoilt(tmp_path / "good.edges.mcap", {}), STAMPS).silhouettes
    assert good is not None
    assert (good.masks == FOREGROUND).all()
    assert "silhouettes in a layout" in refused(spoilt(tmp_path / "a.edges.mcap", changes))


def test_frames_are_found_by_their_stamps(tmp_path: Path) -> None:
    path = written(tmp_path / "a.edges.mcap")
    longer = np.sort(np.concatenate([STAMPS, STAMPS[:10] - 10**9]))
    np.testing.assert_array_equal(read_edges(path, longer).frames, some_edges().frames + 10)


def test_an_older_file_is_replaced_and_says_where_it_comes_from(tmp_path: Path) -> None:
    path = tmp_path / "a.edges.mcap"
    path.write_bytes(b"something else")
    assert read_provenance(written(path)) == {"key": "k", "version": "v"}
    assert read_edges(path, STAMPS).counts.tolist() == [5, 0, 300]
    assert list(tmp_path.iterdir()) == [path]


def test_no_edges_at_all(tmp_path: Path) -> None:
    back = read_edges(written(tmp_path / "a.edges.mcap", some_edges(())), STAMPS)
    assert back.partners.shape == (0, 2)
    assert back.affines.shape == (0, 2, 2, 3)
    assert back.pixels.shape == (0, 2)


def test_edges_of_another_recording_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "a.edges.mcap")
    assert "another recording" in refused(path, STAMPS + 1)
    assert "another recording" in refused(path, np.delete(STAMPS, 6))  # a partner
    assert "another recording" in refused(path, STAMPS[:0])


@pytest.mark.parametrize(
    "changes",
    [
        {"edge_step": 31},
        {"edge_step": 33, "data": bytes(66)},
        {"count": 3},
        {"count": 1},
        {"data": bytes(63)},
        {"data": b""},
    ],
)
def test_another_layout_is_refused(tmp_path: Path, changes: dict[str, Any]) -> None:
    assert "layout" in refused(spoilt(tmp_path / "a.edges.mcap", **changes))


def test_the_layout_is_what_the_definition_says(tmp_path: Path) -> None:
    data = b"".join(
        [
            np.array([300, 7], "<u2").tobytes(),
            np.array([-1, 2, 3, -4], "i1").tobytes(),
            np.array([1, 2, 3, 4, 5, 6], "<f4").tobytes(),
        ]
    )
    back = read_edges(spoilt(tmp_path / "a.edges.mcap", count=1, data=data), STAMPS)
    assert back.pixels.tolist() == [[300, 7]]
    assert back.translations.tolist() == [[[-1, 2], [3, -4]]]
    assert back.covariances.tolist() == [[[1, 2, 3], [4, 5, 6]]]
    assert back.partners.tolist() == [[1, 6]]
    assert "C_uu" in messages.definition(MOVING_EDGES)


def test_a_damaged_file_is_refused(tmp_path: Path) -> None:
    whole = written(tmp_path / "a.edges.mcap").read_bytes()
    path = tmp_path / "b.edges.mcap"
    for share in (0.1, 0.5, 0.9):
        path.write_bytes(whole[: int(share * len(whole))])
        refused(path)
    flipped = bytearray(whole)
    flipped[len(whole) // 3] ^= 0x40
    path.write_bytes(flipped)
    refused(path)
    path.write_bytes(b"")
    refused(path)
    path.unlink()
    refused(path)


def test_a_message_of_another_kind_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.edges.mcap"
    with LogWriter(path) as writer:
        payload = messages.string("not edges")
        writer.write(Message(TOPIC, messages.STRING, int(STAMPS[0]), payload))
    assert "MovingEdges" in refused(path)
