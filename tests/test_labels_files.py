"""Label files: read back the same, matched by exact stamp, refused by line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.helpers import refusal
from tests.helpers.robot import CAMERA
from tooltip_cli.errors import TooltipError
from tooltip_cli.labels.files import (
    STATES,
    TipLabels,
    match_labels,
    read_labels,
    write_labels,
)

HEADER = "stamp_ns,u,v,state,labeler\n"
STAMPS = np.array([10, 20, 30, 40], dtype=np.int64)


def labels(*rows: tuple[int, float, float, str]) -> TipLabels:
    stamps, us, vs, states = zip(*rows, strict=True) if rows else ((), (), (), ())
    pixels = np.array([us, vs], dtype=float).T.reshape(-1, 2)
    names = ("ann",) * len(rows)
    return TipLabels(np.array(stamps, dtype=np.int64), pixels, states, names, "x.csv")


def read_text(tmp_path: Path, text: str | bytes) -> TipLabels:
    path = tmp_path / "a.labels.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_labels(path)


def test_a_file_as_the_contract_shows_it(tmp_path: Path) -> None:
    found = read_text(
        tmp_path, HEADER + "1700000000123456789,1.5,-0.25,visible,ann\n20,,,occluded,bob\n"
    )
    assert found.stamps_ns.tolist() == [1_700_000_000_123_456_789, 20]
    assert found.pixels[0].tolist() == [1.5, -0.25]
    assert np.isnan(found.pixels[1]).all()
    assert found.states == ("visible", "occluded")
    assert found.labelers == ("ann", "bob")
    assert len(found) == 2


@pytest.mark.parametrize(
    "text",
    [
        "\ufeff" + HEADER + "10,1,2,visible,ann\n",
        HEADER.replace("\n", "\r\n") + "10,1,2,visible,ann\r\n\r\n",
        HEADER + "\n10,1,2,visible,ann",
        HEADER + '10,1,2,visible,"ann"\n',
    ],
    ids=["byte order mark", "windows", "blank lines", "quotes"],
)
def test_what_spreadsheets_do_to_files(text: str, tmp_path: Path) -> None:
    found = read_text(tmp_path, text)
    assert found.stamps_ns.tolist() == [10]
    assert found.labelers == ("ann",)


def test_an_empty_table_is_no_labels(tmp_path: Path) -> None:
    found = read_text(tmp_path, HEADER)
    assert len(found) == 0
    matched = match_labels(found, STAMPS, CAMERA)
    assert len(matched.frames) == len(matched.visible.frames) == 0
    assert matched.labelers == ()


names = st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"]), max_size=10)
rows = st.tuples(
    st.integers(-(2**63), 2**63 - 1),
    st.floats(-1e4, 1e4),
    st.floats(-1e4, 1e4),
    st.sampled_from(STATES),
    names,
)


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(table=st.lists(rows, max_size=8, unique_by=lambda row: row[0]))
def test_labels_read_back_the_same_to_a_hundredth(
    table: list[tuple[int, float, float, str, str]], tmp_path: Path
) -> None:
    path = tmp_path / "a.labels.csv"
    pixels = np.array([row[1:3] for row in table], dtype=float).reshape(-1, 2)
    states = tuple(row[3] for row in table)
    visible = np.array([state == "visible" for state in states], dtype=bool)
    pixels[~visible] = np.nan
    written = TipLabels(
        np.array([row[0] for row in table], dtype=np.int64),
        pixels,
        states,
        tuple(row[4] for row in table),
    )
    write_labels(path, written)
    found = read_labels(path)
    assert found.stamps_ns.tolist() == written.stamps_ns.tolist()
    assert found.states == states
    assert found.labelers == written.labelers
    assert np.allclose(found.pixels, pixels, atol=0.0050001, rtol=0, equal_nan=True)


@pytest.mark.parametrize("pixel", [(159.4999, 119.4999), (-0.4999, -0.4999), (159.5, -0.5)])
def test_a_pixel_on_the_images_rim_survives_its_file(
    pixel: tuple[float, float], tmp_path: Path
) -> None:
    assert CAMERA.contains(pixel)
    write_labels(tmp_path / "a.csv", labels((10, *pixel, "visible")))
    assert len(match_labels(read_labels(tmp_path / "a.csv"), STAMPS, CAMERA).visible.frames) == 1


BAD_ROWS: dict[str, tuple[str, str]] = {
    "too few columns": ("10,1,2,visible", "line 2: expected 5 columns, found 4"),
    "too many columns": ("10,1,2,visible,ann,x", "line 2: expected 5 columns, found 6"),
    "unknown state": ("10,1,2,seen,ann", "unknown state 'seen'; known: occluded, out_of_view"),
    "no state": ("10,1,2,,ann", "unknown state ''"),
    "stamp is a fraction": ("10.5,1,2,visible,ann", "expected an integer stamp_ns"),
    "stamp is in words": ("now,1,2,visible,ann", "expected an integer stamp_ns"),
    "no stamp": (",1,2,visible,ann", "expected an integer stamp_ns"),
    "stamp too large": (f"{2**63},1,2,visible,ann", "expected an integer stamp_ns"),
    "stamp endless": ("9" * 5000 + ",1,2,visible,ann", "expected an integer stamp_ns"),
    "no pixel": ("10,,,visible,ann", "numbers u, v"),
    "half a pixel": ("10,1,,visible,ann", "numbers u, v"),
    "pixel in words": ("10,left,top,visible,ann", "numbers u, v"),
    "pixel is no number": ("10,nan,2,visible,ann", "finite u, v"),
    "pixel without end": ("10,inf,2,visible,ann", "finite u, v"),
    "occluded with a pixel": ("10,1,2,occluded,ann", "leave them empty"),
    "out of view with a pixel": ("10,1,,out_of_view,ann", "leave them empty"),
    "the same frame twice": (
        "10,1,2,visible,ann\n10,1,2,visible,ann",
        "already labelled in line 2",
    ),
}


@pytest.mark.parametrize(("row", "expected"), BAD_ROWS.values(), ids=BAD_ROWS.keys())
def test_bad_rows_are_named_by_line(row: str, expected: str, tmp_path: Path) -> None:
    with pytest.raises(TooltipError) as caught:
        read_text(tmp_path, HEADER + row + "\n")
    message = str(caught.value)
    assert message.startswith(str(tmp_path / "a.labels.csv, line "))
    assert expected in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (b"", "expected the header stamp_ns,u,v,state,labeler, found an empty file"),
        (b"hello", "found hello"),
        (b"stamp_ns,u,v,state\n", "found stamp_ns,u,v,state"),
        (b"u,v,stamp_ns,state,labeler\n", "expected the header"),
        (b"x" * 100_000, "expected the header"),
        (b"\xff\xfe\x00", "not UTF-8"),
        (b"\x89MCAP0\r\n\x01\x02", "not UTF-8"),
        (b'"' + b"x" * 200_000, "not a CSV file"),
    ],
)
def test_files_that_hold_something_else(text: bytes, expected: str, tmp_path: Path) -> None:
    with pytest.raises(TooltipError) as caught:
        read_text(tmp_path, text)
    assert str(caught.value).startswith(str(tmp_path / "a.labels.csv"))
    assert expected in str(caught.value)
    assert len(str(caught.value)) < 500


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(TooltipError, match=r"x\.csv: labels cannot be read \(No such file"):
        read_labels(tmp_path / "x.csv")
    with pytest.raises(TooltipError, match="Is a directory"):
        read_labels(tmp_path)
    with (tmp_path / "large.csv").open("wb") as file:
        file.truncate(65 * 2**20)
    with pytest.raises(TooltipError, match="too large"):
        read_labels(tmp_path / "large.csv")


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(text=st.text(max_size=60), prefix=st.sampled_from(["", HEADER, HEADER + "10,1,2,"]))
def test_arbitrary_text_is_read_or_refused(text: str, prefix: str, tmp_path: Path) -> None:
    data = (prefix + text).encode("utf-8", "surrogatepass")
    message = refusal(lambda: read_text(tmp_path, data))
    assert message is None or message.startswith(str(tmp_path))


def test_places_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(TooltipError, match=r"cannot be written \(No such file"):
        write_labels(tmp_path / "missing" / "a.csv", labels())
    (tmp_path / "folder").mkdir()
    with pytest.raises(TooltipError, match="cannot be written"):
        write_labels(tmp_path / "folder", labels())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder"]


def test_labels_find_their_frames_by_exact_stamp() -> None:
    matched = match_labels(
        labels(
            (40, 4.0, 5.0, "visible"),
            (10, np.nan, np.nan, "occluded"),
            (30, 1.0, 2.0, "visible"),
        ),
        STAMPS,
        CAMERA,
    )
    assert matched.frames.tolist() == [0, 2, 3]
    assert matched.visible.frames.tolist() == [2, 3]
    assert matched.visible.pixels.tolist() == [[1.0, 2.0], [4.0, 5.0]]
    assert matched.visible.weights.tolist() == [1.0, 1.0]
    assert matched.labelers == ("ann",)


@pytest.mark.parametrize("stamp", [9, 11, 25, 41, -(2**63), 2**63 - 1])
def test_labels_of_another_recording(stamp: int) -> None:
    given_labels = labels((10, 1.0, 1.0, "visible"), (stamp, 1.0, 1.0, "visible"))
    with pytest.raises(TooltipError) as caught:
        match_labels(given_labels, STAMPS, CAMERA)
    message = str(caught.value)
    assert message.startswith("x.csv: 1 of 2 labels have stamps")
    assert f"first: {stamp}" in message
    assert "another recording" in message


@pytest.mark.parametrize("pixel", [(-0.6, 5.0), (159.6, 5.0), (5.0, -1.0), (5.0, 1e9)])
def test_labels_outside_the_image(pixel: tuple[float, float]) -> None:
    with pytest.raises(TooltipError) as caught:
        match_labels(labels((10, 1.0, 1.0, "visible"), (30, *pixel, "visible")), STAMPS, CAMERA)
    message = str(caught.value)
    assert message.startswith("x.csv: the label (")
    assert "at stamp 30 lies outside the 160x120 image" in message


def test_a_hidden_tip_is_nowhere_outside() -> None:
    matched = match_labels(labels((10, np.nan, np.nan, "out_of_view")), STAMPS, CAMERA)
    assert matched.frames.tolist() == [0]
    assert len(matched.visible.frames) == 0
