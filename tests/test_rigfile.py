"""The rig file: what is read, what is refused, and that it survives its own recording."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers.robot import CAMERA, RIG, URDF
from tooltip_cli.errors import TooltipError
from tooltip_cli.rig.camera import camera_yaml
from tooltip_cli.rig.kinematics import Mount
from tooltip_cli.rig.rigfile import Rig, Sphere, load_rig, parse_rig, rig_files

FILES = {"robot.urdf": URDF, "camera.yaml": camera_yaml(CAMERA)}
FULL: dict[str, Any] = {
    "robot": "robot.urdf",
    "camera": {
        "frame": "camera_optical_frame",
        "info": "camera.yaml",
        "mount": {"parent": "torso_link", "xyz": [0, 0.1, 0], "rpy": [0, 0, 1.5]},
    },
    "hand": {
        "frame": "right_wrist_yaw_link",
        "pose_topic": "/hand_pose",
        "spheres": [{"center": [0, 0, 0.06], "radius": 0.06}],
    },
    "joints": {"kRightWristYaw": "right_wrist_yaw_joint"},
    "time_offset": -0.25,
}


def parse(document: Any) -> Rig:
    text = document if isinstance(document, str) else yaml.safe_dump(document)
    return parse_rig(text, FILES.__getitem__, "my.rig.yaml")


def changed(path: tuple[str | int, ...], value: Any) -> dict[str, Any]:
    """Return the full document with one value replaced or added."""
    document = copy.deepcopy(FULL)
    place: Any = document
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return document


def test_every_key_is_read() -> None:
    rig = parse(FULL)
    assert rig.urdf == URDF
    assert rig.camera_frame == "camera_optical_frame"
    assert rig.camera == CAMERA
    assert rig.mount == Mount("torso_link", (0.0, 0.1, 0.0), (0.0, 0.0, 1.5))
    assert rig.hand_frame == "right_wrist_yaw_link"
    assert rig.pose_topic == "/hand_pose"
    assert rig.spheres == (Sphere((0.0, 0.0, 0.06), 0.06),)
    assert rig.joints == {"kRightWristYaw": "right_wrist_yaw_joint"}
    assert rig.time_offset_s == -0.25
    assert rig.source == "my.rig.yaml"


@pytest.mark.parametrize(
    "document",
    [
        {"hand": {"frame": "h"}},
        {"hand": {"frame": "h", "spheres": []}, "camera": {}, "joints": {}},
        {"hand": {"frame": "h", "spheres": None}, "camera": None, "joints": None, "robot": None},
        {"hand": {"frame": "h"}, "camera": {"mount": None, "info": None}, "time_offset": None},
    ],
)
def test_everything_that_the_log_holds_may_be_left_out(document: dict[str, Any]) -> None:
    assert parse(document) == Rig(hand_frame="h", source="my.rig.yaml")


def test_a_mount_without_numbers_is_at_its_parent() -> None:
    rig = parse({"hand": {"frame": "h"}, "camera": {"mount": {"parent": "neck"}}})
    assert rig.mount == Mount("neck")


@pytest.mark.parametrize(
    "rig", [RIG, parse(FULL), Rig(hand_frame="h")], ids=["wrist", "full", "min"]
)
def test_a_rig_survives_its_own_files(rig: Rig, tmp_path: Path) -> None:
    files = rig_files(rig)
    for name, text in files.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    back = load_rig(tmp_path / "rig.yaml")
    assert back.source == str(tmp_path / "rig.yaml")
    assert back == Rig(**{**vars(rig), "source": back.source})


names = st.text(st.characters(codec="utf-8", categories=["L", "N", "P", "S"]), min_size=1)
lengths = st.floats(-100, 100)
vectors = st.tuples(lengths, lengths, lengths)


@settings(max_examples=100)
@given(
    rig=st.builds(
        Rig,
        hand_frame=names,
        camera_frame=st.none() | names,
        mount=st.none() | st.builds(Mount, names, vectors, vectors),
        pose_topic=st.none() | names,
        spheres=st.lists(st.builds(Sphere, vectors, st.floats(1e-6, 10.0)), max_size=3).map(tuple),
        joints=st.dictionaries(names, names, max_size=3).filter(
            lambda names: len(set(names.values())) == len(names)
        ),
        time_offset_s=st.floats(-4e9, 4e9),
        source=st.just("my.rig.yaml"),
    )
)
def test_any_rig_survives_its_own_files(rig: Rig) -> None:
    files = rig_files(rig)
    assert parse_rig(files["rig.yaml"], files.__getitem__, "my.rig.yaml") == rig


def levels(value: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Yield the path of every mapping in the full document, ``joints`` aside: its keys are free."""
    if isinstance(value, dict) and path != ("joints",):
        yield path
        for key, item in value.items():
            yield from levels(item, (*path, key))
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from levels(item, (*path, index))


LEVELS = {".".join(map(str, path)) or "top": path for path in levels(FULL)}


def test_all_levels_are_tried() -> None:
    assert set(LEVELS) == {"top", "camera", "camera.mount", "hand", "hand.spheres.0"}


@pytest.mark.parametrize("path", LEVELS.values(), ids=LEVELS.keys())
def test_an_unknown_key_is_refused_with_the_known_ones(path: tuple[str | int, ...]) -> None:
    place: Any = FULL
    for key in path:
        place = place[key]
    with pytest.raises(
        TooltipError, match=r"^my\.rig\.yaml: unknown key '.*frmae'; known: "
    ) as caught:
        parse(changed((*path, "frmae"), 1))
    assert all(key in str(caught.value) for key in place)


TEXTS = [("robot",), ("camera", "frame"), ("camera", "info"), ("camera", "mount", "parent")]
TEXTS += [("hand", "frame"), ("hand", "pose_topic")]
SECTIONS = [("camera",), ("camera", "mount"), ("hand",), ("joints",)]
VECTORS: list[tuple[str | int, ...]] = [("camera", "mount", "xyz"), ("camera", "mount", "rpy")]
VECTORS += [("hand", "spheres", 0, "center")]
NUMBERS: list[tuple[str | int, ...]] = [("time_offset",), ("hand", "spheres", 0, "radius")]
NO_NUMBER = ["1", True, [1.0], {"a": 1}, float("nan"), float("inf"), float("-inf"), 10**400]
WRONG: list[tuple[tuple[str | int, ...], Any]] = [
    *((path, value) for path in TEXTS for value in (3, 2.5, True, ["a"], {"a": "b"}, "")),
    *((path, value) for path in SECTIONS for value in ("text", 3, [1, 2], True)),
    *(
        (path, value)
        for path in VECTORS
        for value in (
            "1 2 3",
            3,
            [],
            [1, 2],
            [1, 2, 3, 4],
            {"x": 1},
            *([0, 0, n] for n in NO_NUMBER),
        )
    ),
    *((path, value) for path in NUMBERS for value in NO_NUMBER),
    (("time_offset",), 1e10),
    (("time_offset",), -(10**30)),
    (("camera", "mount", "xyz"), [1e7, 0, 0]),
    (("hand", "spheres", 0, "radius"), 0),
    (("hand", "spheres", 0, "radius"), -0.1),
    (("hand", "spheres"), {"center": [0, 0, 0], "radius": 1}),
    (("hand", "spheres"), "none"),
    (("hand", "spheres"), 3),
    (("hand", "spheres"), [3]),
    (("hand", "spheres"), [None]),
    (("hand", "spheres"), [{"radius": 0.1}]),
    (("hand", "spheres"), [{"center": [0, 0, 0]}]),
    (("joints",), {"a": 3}),
    (("joints",), {3: "a"}),
    (("joints",), {"a": None}),
    (("joints",), {"a": "x", "b": "x"}),
    (("hand",), None),
    (("hand", "frame"), None),
    (("camera", "mount", "parent"), None),
]


@pytest.mark.parametrize(
    ("path", "value"),
    WRONG,
    ids=[f"{'.'.join(map(str, path))}={str(value)[:20]}" for path, value in WRONG],
)
def test_a_value_of_the_wrong_kind_is_refused_by_name(
    path: tuple[str | int, ...], value: Any
) -> None:
    with pytest.raises(TooltipError) as caught:
        parse(changed(path, value))
    message = str(caught.value)
    assert message.startswith("my.rig.yaml: ")
    assert [part for part in path if isinstance(part, str)][-1] in message
    assert len(message) < 300


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "must be a mapping"),
        ("~", "must be a mapping"),
        ("[]", "must be a mapping"),
        ("hello", "must be a mapping"),
        ("{}", "hand must be a mapping"),
        ("hand: {frame: h", "not YAML"),
        ("hand:\n\t- x", "not YAML"),
        ("hand: {frame: h}\ntime_offset: 2020-99-99", "not YAML"),
        ("!!python/object/apply:os.getcwd []", "not YAML"),
        ("{" * 1100, "nested too deeply"),
        ("<robot/>", "must be a mapping"),
        ("\x89MCAP0\r\n", "not YAML"),
    ],
)
def test_text_that_is_no_rig_file(text: str, expected: str) -> None:
    with pytest.raises(TooltipError, match=r"^my\.rig\.yaml: ") as caught:
        parse(text)
    assert expected in str(caught.value)


def test_aliases_that_unfold_without_end_make_a_short_message() -> None:
    lines = ["[&a0 [x, x, x, x, x, x, x, x]"]
    lines += [f"&a{i} [{', '.join([f'*a{i - 1}'] * 8)}]" for i in range(1, 12)]
    bomb = ", ".join(lines) + "]"
    for key in ("frame", "pose_topic"):
        with pytest.raises(TooltipError, match="aliases stand for more than 1000000") as caught:
            parse(f"hand: {{frame: h, {key}: {bomb}}}")
        assert len(str(caught.value)) < 300


@pytest.mark.parametrize("key", ["robot", "camera"])
def test_files_that_a_rig_names_must_be_there(key: str, tmp_path: Path) -> None:
    document = {"hand": {"frame": "h"}, **({"robot": "gone"} if key == "robot" else {})}
    if key == "camera":
        document["camera"] = {"info": "gone"}
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(document))
    with pytest.raises(TooltipError, match=r"gone: cannot be read \(No such file"):
        load_rig(tmp_path / "rig.yaml")


@pytest.mark.parametrize("name", ["nothing.yaml", "folder", "binary.yaml", "large.yaml"])
def test_rig_files_that_cannot_be_read(name: str, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    with (tmp_path / "large.yaml").open("wb") as file:
        file.truncate(33 * 2**20)
    with pytest.raises(TooltipError, match=rf"{name}: (cannot be read|too large)"):
        load_rig(tmp_path / name)


def test_files_are_found_beside_the_rig_file(tmp_path: Path) -> None:
    (tmp_path / "robot.urdf").write_text("<robot/>")
    (tmp_path / "rig.yaml").write_text("{robot: robot.urdf, hand: {frame: h}}")
    assert load_rig(tmp_path / "rig.yaml").urdf == "<robot/>"


@settings(max_examples=150, deadline=None)
@given(text=st.text(max_size=120))
def test_arbitrary_text_is_refused(text: str) -> None:
    with pytest.raises(TooltipError, match=r"^my\.rig\.yaml: "):
        parse(text)
