"""CDR bytes: ours are what another implementation reads, and the other way round."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tests.helpers.robot import CAMERA
from tooltip_cli.errors import TooltipError
from tooltip_cli.log import messages
from tooltip_cli.resources import resource
from tooltip_cli.rig.camera import CameraModel

TYPES = sorted(
    f"{path.parent.parent.name}/msg/{path.stem}" for path in resource("schemas").rglob("*.msg")
)
STORE = get_typestore(Stores.ROS2_HUMBLE)
for name in TYPES:
    if name not in STORE.types:
        STORE.register(get_types_from_msg(messages.definition(name), name))

STAMP = 1_700_000_000_987_654_321
TIME = {"sec": 1_700_000_000, "nanosec": 987_654_321}
HEADER = {"stamp": TIME, "frame_id": "camera"}
VALUES: dict[str, dict[str, Any]] = {
    messages.COMPRESSED_IMAGE: {"header": HEADER, "format": "jpeg", "data": b"\xff\xd8\xff\x00"},
    messages.IMAGE: {
        "header": HEADER,
        "height": 2,
        "width": 3,
        "encoding": "mono8",
        "is_bigendian": 0,
        "step": 4,
        "data": bytes(8),
    },
    messages.CAMERA_INFO: {
        "header": HEADER,
        "height": 480,
        "width": 640,
        "distortion_model": "plumb_bob",
        "d": [0.1, 0.2, 0.3, 0.4, 0.5],
        "k": [float(value) for value in range(9)],
        "r": [float(value) for value in range(9)],
        "p": [float(value) for value in range(12)],
        "binning_x": 1,
        "binning_y": 2,
        "roi": {"x_offset": 1, "y_offset": 2, "height": 3, "width": 4, "do_rectify": True},
    },
    messages.JOINT_STATE: {
        "header": HEADER,
        "name": ["a", "", "ünï"],
        "position": [0.5, float("inf"), -1e300],
        "velocity": [],
        "effort": [1.0],
    },
    messages.POSE_STAMPED: {
        "header": HEADER,
        "pose": {
            "position": {"x": 1.0, "y": 2.0, "z": 3.0},
            "orientation": {"x": 0.0, "y": 0.6, "z": 0.0, "w": 0.8},
        },
    },
    messages.STRING: {"data": "<robot/>"},
    messages.TIP_DETECTION: {
        "header": HEADER,
        "partner": TIME,
        "u": 1.5,
        "v": -2.5,
        "weight": 3.5,
        "affine": [float(value) for value in range(6)],
        "edges": 7,
        "background_edges": 6,
        "flags": ["few_edges", "no_motion"],
    },
    messages.IMAGE_ANNOTATIONS: {
        "circles": [
            {
                "timestamp": TIME,
                "position": {"x": 1.0, "y": 2.0},
                "diameter": 3.0,
                "thickness": 4.0,
                "fill_color": {"r": 0.1, "g": 0.2, "b": 0.3, "a": 0.4},
                "outline_color": {"r": 0.5, "g": 0.6, "b": 0.7, "a": 0.8},
            }
        ],
        "points": [
            {
                "timestamp": TIME,
                "type": 2,
                "points": [{"x": 1.0, "y": 2.0}, {"x": 3.0, "y": 4.0}],
                "outline_color": {"r": 0.5, "g": 0.6, "b": 0.7, "a": 0.8},
                "outline_colors": [],
                "fill_color": {"r": 0.5, "g": 0.6, "b": 0.7, "a": 0.8},
                "thickness": 1.0,
            }
        ],
        "texts": [
            {
                "timestamp": TIME,
                "position": {"x": 1.0, "y": 2.0},
                "text": "tip",
                "font_size": 12.0,
                "text_color": {"r": 0.5, "g": 0.6, "b": 0.7, "a": 0.8},
                "background_color": {"r": 0.5, "g": 0.6, "b": 0.7, "a": 0.8},
            }
        ],
    },
}


def plain(value: Any) -> Any:
    """Return a decoded message as mappings and lists, whoever decoded it."""
    if isinstance(value, (bytes, bytearray, memoryview)):
        return list(bytes(value))
    if isinstance(value, np.ndarray) or type(value).__name__ == "array":
        return [plain(item) for item in value.tolist()]
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    names = getattr(value, "__dataclass_fields__", None) or getattr(value, "__slots__", None)
    if names:
        fields = [key for key in names if not key.startswith("__") and not key.isupper()]
        return {key: plain(getattr(value, key)) for key in fields}  # constants are no fields
    return value


@pytest.mark.parametrize("datatype", VALUES)
def test_every_message_reads_back_the_same(datatype: str) -> None:
    payload = messages.encode(datatype, VALUES[datatype])
    assert plain(messages.decode(datatype, payload)) == plain(VALUES[datatype])


@pytest.mark.parametrize("datatype", VALUES)
def test_another_implementation_reads_our_bytes(datatype: str) -> None:
    payload = messages.encode(datatype, VALUES[datatype])
    assert plain(STORE.deserialize_cdr(payload, datatype)) == plain(VALUES[datatype])


@pytest.mark.parametrize("datatype", VALUES)
@pytest.mark.parametrize("little_endian", [True, False])
def test_we_read_its_bytes_in_either_order(datatype: str, little_endian: bool) -> None:
    ours = messages.encode(datatype, VALUES[datatype])
    value = STORE.deserialize_cdr(ours, datatype)
    payload = bytes(STORE.serialize_cdr(value, datatype, little_endian=little_endian))
    assert payload[1] == int(little_endian)
    assert plain(messages.decode(datatype, payload)) == plain(VALUES[datatype])


@pytest.mark.parametrize("datatype", TYPES)
def test_schema_texts_carry_all_that_they_need(datatype: str) -> None:
    text = messages.schema_text(datatype)
    types = get_types_from_msg(text, datatype)
    needed = {datatype}
    pending = [datatype]
    while pending:
        for line in messages.definition(pending.pop()).splitlines():
            words = line.partition("#")[0].split()
            if words and "/" in words[0]:
                name = words[0].partition("[")[0].replace("/", "/msg/")
                if name not in needed:
                    needed.add(name)
                    pending.append(name)
    assert set(types) == needed


@pytest.mark.parametrize(
    "datatype", [name for name in TYPES if not name.startswith(("tooltip_msgs", "foxglove_msgs"))]
)
def test_definitions_are_those_of_ros(datatype: str) -> None:
    ours = get_types_from_msg(messages.definition(datatype), datatype)
    assert ours[datatype][1] == get_typestore(Stores.ROS2_HUMBLE).fielddefs[datatype][1]


def test_a_type_without_definition_is_a_key_error() -> None:
    with pytest.raises(KeyError, match="sensor_msgs/msg/Imu"):
        messages.definition("sensor_msgs/msg/Imu")


def test_missing_fields_are_zero() -> None:
    message = messages.decode(messages.JOINT_STATE, messages.encode(messages.JOINT_STATE, {}))
    assert plain(message) == {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""},
        "name": [],
        "position": [],
        "velocity": [],
        "effort": [],
    }


@settings(max_examples=200)
@given(stamp_ns=st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1))
def test_stamps_keep_every_nanosecond(stamp_ns: int) -> None:
    time = messages.time_from_ns(stamp_ns)
    assert 0 <= time["nanosec"] < 10**9
    payload = messages.joint_state(stamp_ns, [], [])
    assert messages.ns_from_time(messages.decode(messages.JOINT_STATE, payload).header.stamp) == (
        stamp_ns
    )


def test_the_short_forms_equal_the_long_ones() -> None:
    assert messages.compressed_image(STAMP, "camera", "jpeg", b"\xff\xd8\xff\x00") == (
        messages.encode(messages.COMPRESSED_IMAGE, VALUES[messages.COMPRESSED_IMAGE])
    )
    assert messages.string("<robot/>") == messages.encode(messages.STRING, VALUES[messages.STRING])
    pose = messages.pose_stamped(STAMP, "camera", (1, 2, 3), (0, 0.6, 0, 0.8))
    assert pose == messages.encode(messages.POSE_STAMPED, VALUES[messages.POSE_STAMPED])
    joints = messages.decode(messages.JOINT_STATE, messages.joint_state(STAMP, ["b", "a"], [1, 2]))
    assert (joints.name, list(joints.position)) == (["b", "a"], [1.0, 2.0])


def info(**changes: Any) -> Any:
    """Return a decoded CameraInfo with some fields changed."""
    message = messages.decode(messages.CAMERA_INFO, messages.camera_info(STAMP, "camera", CAMERA))
    for key, value in changes.items():
        setattr(message, key, value)
    return message


def test_projection_matrix_is_that_of_a_single_camera() -> None:
    p = np.array(info().p).reshape(3, 4)
    assert np.array_equal(p, np.hstack([CAMERA.matrix, np.zeros((3, 1))]))
    assert np.array_equal(np.array(info().r).reshape(3, 3), np.eye(3))


def test_zero_focal_length_means_uncalibrated() -> None:
    assert messages.camera_from_info(info(k=[0.0] * 9), "log: /info") is None


def test_an_empty_model_name_is_plumb_bob() -> None:
    camera = messages.camera_from_info(info(distortion_model="", d=[]), "log: /info")
    assert camera is not None
    assert camera.distortion_model == "plumb_bob"


K = CAMERA.matrix.ravel().tolist()


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"distortion_model": "kb4"}, "unknown distortion model 'kb4'; known: equidistant"),
        ({"d": [0.1, 0.2]}, "2 distortion coefficients"),
        ({"k": [-1.0, *K[1:]]}, "focal lengths"),
        ({"k": [float("nan"), *K[1:]]}, "finite"),
        ({"d": [float("inf")] * 5}, "finite"),
        ({"width": 0, "height": 0}, "image size 0x0"),
        ({"width": 2**32 - 1, "height": 2**32 - 1}, "image size 4294967295x4294967295"),
    ],
)
def test_impossible_intrinsics_are_refused(changes: dict[str, Any], expected: str) -> None:
    with pytest.raises(TooltipError) as caught:
        messages.camera_from_info(info(**changes), "log: /info")
    assert str(caught.value).startswith("log: /info")
    assert expected in str(caught.value)


def test_header_is_first_in_every_stamped_type() -> None:
    """Stamps of images are read without decoding the message."""
    for datatype in (messages.IMAGE, messages.COMPRESSED_IMAGE):
        payload = messages.encode(datatype, VALUES[datatype])
        assert struct.unpack_from("<iI", payload, 4) == (TIME["sec"], TIME["nanosec"])


def test_definitions_lie_where_the_type_says() -> None:
    for datatype in TYPES:
        package, _, name = datatype.partition("/msg/")
        assert Path(resource("schemas", package, "msg", f"{name}.msg")).is_file()


def test_camera_info_of_every_model() -> None:
    for model, count in (("plumb_bob", 5), ("rational_polynomial", 8), ("equidistant", 4)):
        camera = CameraModel(64, 48, 50.0, 51.0, 31.0, 23.0, model, (0.01,) * count)
        message = messages.decode(messages.CAMERA_INFO, messages.camera_info(1, "c", camera))
        assert messages.camera_from_info(message, "x") == camera
