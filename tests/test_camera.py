"""Pixels to rays and back, against OpenCV and against themselves; camera files."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers import refusal
from tooltip_cli.errors import TooltipError
from tooltip_cli.log import messages
from tooltip_cli.rig.camera import CameraModel, camera_yaml, load_camera_yaml

K = np.array([[512.0, 0.0, 321.5], [0.0, 498.0, 236.25], [0.0, 0.0, 1.0]])
# distortions as calibrations of real lenses give them
LENSES: dict[str, tuple[str, tuple[float, ...]]] = {
    "pinhole": ("plumb_bob", ()),
    "barrel": ("plumb_bob", (-0.31, 0.11, 8e-4, -5e-4, -0.02)),
    "cushion": ("plumb_bob", (0.12, -0.05, -1e-3, 2e-3)),
    "rational": ("rational_polynomial", (0.9, 0.3, 5e-4, -3e-4, 0.02, 1.2, 0.45, 0.05)),
    "fisheye": ("equidistant", (-0.012, 0.03, -0.02, 0.004)),
    "ideal fisheye": ("equidistant", (0.0, 0.0, 0.0, 0.0)),
}


def camera_of(lens: str) -> CameraModel:
    model, distortion = LENSES[lens]
    return CameraModel.create(
        width=640,
        height=480,
        matrix=K,
        distortion_model=model,
        distortion=distortion,
        source="test",
    )


def in_view(camera: CameraModel, count: int = 400) -> np.ndarray[Any, np.dtype[np.float64]]:
    rng = np.random.default_rng(1)
    return rng.uniform((-0.5, -0.5), (camera.width - 0.5, camera.height - 0.5), (count, 2))


@pytest.mark.parametrize("lens", LENSES)
def test_directions_undo_projection(lens: str) -> None:
    camera = camera_of(lens)
    pixels = in_view(camera)
    directions = camera.directions(pixels)
    assert np.allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-12)
    assert np.abs(camera.project(directions * 0.7) - pixels).max() < 1e-6


@pytest.mark.parametrize("lens", LENSES)
@settings(max_examples=60, deadline=None)
@given(
    x=st.floats(-0.55, 0.55),
    y=st.floats(-0.4, 0.4),
    depth=st.floats(0.01, 50.0),
)
def test_projection_undoes_directions(lens: str, x: float, y: float, depth: float) -> None:
    camera = camera_of(lens)
    point = np.array([x, y, 1.0]) * depth
    back = camera.directions(camera.project(point))
    assert np.abs(back - point / np.linalg.norm(point)).max() < 1e-9


@pytest.mark.parametrize("lens", ["pinhole", "barrel", "cushion", "rational"])
def test_projection_equals_opencv(lens: str) -> None:
    camera = camera_of(lens)
    points = np.random.default_rng(2).uniform((-0.5, -0.4, 1.0), (0.5, 0.4, 1.0), (200, 3))
    points *= np.linspace(0.1, 9.0, 200)[:, None]
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(camera.distortion))
    assert np.abs(camera.project(points) - expected[0][:, 0]).max() < 1e-9


@pytest.mark.parametrize("lens", ["fisheye", "ideal fisheye"])
def test_fisheye_projection_equals_opencv(lens: str) -> None:
    camera = camera_of(lens)
    angle = np.random.default_rng(3).uniform(0, 1.2, 200)
    around = np.random.default_rng(4).uniform(0, 2 * np.pi, 200)
    points = np.stack(
        [np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], axis=1
    )
    expected = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), K, np.array(camera.distortion)
    )
    assert np.abs(camera.project(points) - expected[0][:, 0]).max() < 1e-9


def test_the_optical_centre_looks_straight_ahead() -> None:
    for lens in LENSES:
        assert camera_of(lens).directions([321.5, 236.25]).tolist() == [0.0, 0.0, 1.0]


def test_a_wide_fisheye_is_inverted_to_its_rim() -> None:
    camera = camera_of("ideal fisheye")
    angles = np.linspace(0.0, 1.55, 60)
    points = np.stack([np.sin(angles), np.zeros(60), np.cos(angles)], axis=1)
    assert np.abs(camera.directions(camera.project(points)) - points).max() < 1e-9


def test_points_at_or_behind_the_camera_have_no_pixel() -> None:
    for lens in LENSES:
        points = [[0.0, 0.0, 0.0], [0.1, 0.1, -1.0], [1.0, 0.0, 0.0], [np.nan, 0.0, 1.0]]
        assert np.isnan(camera_of(lens).project(points)).any(axis=1).all()
        assert np.isfinite(camera_of(lens).project([0.0, 0.0, 1e-300])).all()


def test_points_beyond_the_fold_have_no_pixel_instead_of_a_wrong_one() -> None:
    # r (1 - 0.3 r^2) turns back at r = 1.054; at r = 2 it would land left of the centre
    camera = CameraModel(640, 480, 500, 500, 320, 240, "plumb_bob", (-0.3, 0, 0, 0, 0))
    ahead = camera.project([[1.05, 0.0, 1.0], [1.06, 0.0, 1.0], [2.0, 0.0, 1.0]])
    assert np.isfinite(ahead[0]).all()
    assert np.isnan(ahead[1:]).all()


def test_pixels_that_no_direction_reaches_have_no_mirrored_ray() -> None:
    # the farthest reachable pixel is 0.7027 focal lengths out; beyond, only mirrored solutions
    camera = CameraModel(2000, 2000, 500, 500, 999, 999, "plumb_bob", (-0.3, 0, 0, 0, 0))
    radii = np.array([0.70, 0.71, 0.75, 0.9, 1.0, 1.5])
    directions = camera.directions(np.stack([999 + 500 * radii, np.full(6, 999.0)], axis=1))
    assert directions[0, 0] > 0.69
    assert np.isnan(directions[1:]).all()


def test_the_rational_models_pole_is_a_fold() -> None:
    camera = CameraModel(
        640, 480, 500, 500, 320, 240, "rational_polynomial", (0, 0, 0, 0, 0, -1.0, 0, 0)
    )
    assert np.isfinite(camera.project([0.9, 0.0, 1.0])).all()
    assert np.isnan(camera.project([1.1, 0.0, 1.0])).all()


def test_one_bad_pixel_does_not_spoil_its_neighbours() -> None:
    camera = camera_of("barrel")
    pixels = in_view(camera, 50)
    mixed = np.concatenate([[[np.nan, 3.0]], [[1e9, 1e9]], pixels])
    directions = camera.directions(mixed)
    assert np.isnan(directions[:2]).all()
    assert np.abs(directions[2:] - camera.directions(pixels)).max() < 1e-12


def test_the_image_reaches_half_a_pixel_around_its_centres() -> None:
    camera = camera_of("pinhole")
    inside = [[-0.5, -0.5], [639.5, 479.5], [0.0, 0.0]]
    outside = [[-0.51, 0.0], [639.51, 0.0], [0.0, 479.51], [np.nan, 0.0], [np.inf, 0.0]]
    assert camera.contains(inside).tolist() == [True] * 3
    assert camera.contains(outside).tolist() == [False] * 5


@pytest.mark.parametrize("lens", LENSES)
def test_camera_files_read_back_the_same(lens: str) -> None:
    camera = camera_of(lens)
    assert load_camera_yaml(camera_yaml(camera), "camera.yaml") == camera


@pytest.mark.parametrize("lens", LENSES)
def test_camera_info_reads_back_the_same(lens: str) -> None:
    camera = camera_of(lens)
    message = messages.decode(messages.CAMERA_INFO, messages.camera_info(5, "cam", camera))
    assert messages.camera_from_info(message, "test") == camera


def test_unused_thin_prism_coefficients_are_dropped_and_used_ones_refused() -> None:
    def create(distortion: list[float]) -> CameraModel:
        return CameraModel.create(
            width=640,
            height=480,
            matrix=K,
            distortion_model="rational_polynomial",
            distortion=distortion,
            source="test",
        )

    assert create([0.1] * 8 + [0.0] * 6).distortion == (0.1,) * 8
    with pytest.raises(TooltipError, match="thin-prism"):
        create([0.1] * 8 + [0.0, 0.1, 0.0, 0.0])


def document(**changes: Any) -> dict[str, Any]:
    """Return a good camera file's content with some keys changed; None drops one."""
    content: dict[str, Any] = yaml.safe_load(camera_yaml(camera_of("barrel")))
    content.update(changes)
    return {key: value for key, value in content.items() if value is not None}


def matrix(*values: float) -> dict[str, Any]:
    return {"rows": 3, "cols": 3, "data": list(values)}


GOOD = (500.0, 0.0, 320.0, 0.0, 500.0, 240.0, 0.0, 0.0, 1.0)
MALFORMED: dict[str, tuple[str, str]] = {
    "empty": ("", "lacks image_width"),
    "text": ("hello", "lacks image_width"),
    "list": ("[1, 2]", "lacks image_width"),
    "null": ("~", "lacks image_width"),
    "not yaml": ("a: [1", "not YAML"),
    "tabs": ("a:\n\t- b", "not YAML"),
    "binary": ("\x00\x01\x02", "not YAML"),
    "object": ("!!python/object/apply:os.getcwd []", "not YAML"),
    "bad date": ("image_width: 2020-99-99", "not YAML"),
    "bad boolean": ("image_width: !!bool maybe", "not YAML"),
    "bad stamp": ("image_width: !!timestamp soon", "not YAML"),
    "endless number": ("image_width: " + "9" * 5000, "not YAML"),
    "deep": ("[" * 1100, "nested too deeply"),
    "two documents": ("a: 1\n---\nb: 2", "not YAML"),
    **{
        f"without {key}": (yaml.safe_dump(document(**{key: None})), f"lacks {key}")
        for key in ("image_width", "image_height", "camera_matrix", "distortion_model")
    },
    **{
        f"width {value!r}": (yaml.safe_dump(document(image_width=value)), "image_width")
        for value in ("wide", 640.5, True, [640], float("inf"), float("nan"))
    },
    "no width": (yaml.safe_dump(document(image_width=0)), "0x480"),
    "negative height": (yaml.safe_dump(document(image_height=-480)), "640x-480"),
    "huge height": (yaml.safe_dump(document(image_height=10**9)), "is not a camera's"),
    "matrix is a list": (yaml.safe_dump(document(camera_matrix=list(GOOD))), "camera_matrix"),
    "matrix is text": (yaml.safe_dump(document(camera_matrix="K")), "camera_matrix"),
    "matrix without data": (yaml.safe_dump(document(camera_matrix={"rows": 3})), "camera_matrix"),
    "matrix of eight": (yaml.safe_dump(document(camera_matrix=matrix(*GOOD[:8]))), "9 numbers"),
    "matrix of words": (
        yaml.safe_dump(document(camera_matrix={"data": ["fx"] * 9})),
        "camera_matrix",
    ),
    "matrix of lists": (
        yaml.safe_dump(document(camera_matrix={"data": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]})),
        "camera_matrix",
    ),
    "matrix of giants": (
        yaml.safe_dump(document(camera_matrix={"data": [10**400] * 9})),
        "camera_matrix",
    ),
    "no focal length": (
        yaml.safe_dump(document(camera_matrix=matrix(0.0, *GOOD[1:]))),
        "focal lengths",
    ),
    "negative focal length": (
        yaml.safe_dump(document(camera_matrix=matrix(*GOOD[:4], -500.0, *GOOD[5:]))),
        "focal lengths",
    ),
    "endless focal length": (
        yaml.safe_dump(document(camera_matrix=matrix(float("inf"), *GOOD[1:]))),
        "finite",
    ),
    "centre is no number": (
        yaml.safe_dump(document(camera_matrix=matrix(*GOOD[:2], float("nan"), *GOOD[3:]))),
        "finite",
    ),
    "skewed": (
        yaml.safe_dump(document(camera_matrix=matrix(GOOD[0], 3.0, *GOOD[2:]))),
        "skewed",
    ),
    "scaled": (yaml.safe_dump(document(camera_matrix=matrix(*GOOD[:8], 2.0))), "form"),
    "unknown model": (
        yaml.safe_dump(document(distortion_model="thin_prism")),
        "known: equidistant, plumb_bob, rational_polynomial",
    ),
    "no such model": (yaml.safe_dump(document(distortion_model=[1])), "known: equidistant"),
    "three coefficients": (
        yaml.safe_dump(document(distortion_coefficients={"data": [0.1] * 3})),
        "expected 0 or 4 or 5",
    ),
    "coefficients are a list": (
        yaml.safe_dump(document(distortion_coefficients=[0.1] * 5)),
        "distortion_coefficients",
    ),
    "coefficients are words": (
        yaml.safe_dump(document(distortion_coefficients={"data": ["k"] * 5})),
        "distortion_coefficients",
    ),
    "coefficients are no numbers": (
        yaml.safe_dump(document(distortion_coefficients={"data": [float("nan")] * 5})),
        "finite",
    ),
    "coefficients are nothing": (
        yaml.safe_dump(document(distortion_coefficients={"data": None})),
        "distortion_coefficients",
    ),
}


@pytest.mark.parametrize(("text", "expected"), MALFORMED.values(), ids=MALFORMED.keys())
def test_malformed_camera_files_are_refused_in_one_line(text: str, expected: str) -> None:
    with pytest.raises(TooltipError) as caught:
        load_camera_yaml(text, "cam.yaml")
    message = str(caught.value)
    assert message.startswith("cam.yaml")
    assert expected in message
    assert "\n" not in message
    assert len(message) < 500


def test_a_file_without_coefficients_is_a_pinhole() -> None:
    camera = load_camera_yaml(yaml.safe_dump(document(distortion_coefficients=None)), "cam.yaml")
    assert camera.distortion == ()


@settings(max_examples=150, deadline=None)
@given(text=st.text(max_size=200))
def test_arbitrary_text_is_refused(text: str) -> None:
    with pytest.raises(TooltipError, match=r"^cam\.yaml"):
        load_camera_yaml(text, "cam.yaml")


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=9) | st.dictionaries(st.text(max_size=4), inner),
    max_leaves=10,
)


@settings(max_examples=150, deadline=None)
@given(
    key=st.sampled_from(sorted(document())),
    value=VALUES | st.fixed_dictionaries({"data": VALUES}),
)
def test_arbitrary_values_are_read_or_refused(key: str, value: Any) -> None:
    text = yaml.safe_dump(document(**{key: value}))
    message = refusal(lambda: load_camera_yaml(text, "cam.yaml"))
    if message is not None:
        assert message.startswith("cam.yaml")
    else:
        camera = load_camera_yaml(text, "cam.yaml")
        assert np.isfinite(camera.matrix).all()
        assert np.isfinite(camera.distortion).all()
