"""``tooltip record``: from options to files, one line on stdout, the rest on stderr."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.helpers.cli import tooltip
from tests.helpers.logs import IMAGE_TOPIC, INFO_TOPIC, JOINT_TOPIC, ROBOT_TOPIC, Log
from tests.helpers.robot import URDF
from tooltip_cli.labels.files import read_labels
from tooltip_cli.log.recording import Recording, read_recording
from tooltip_cli.log.views import resolve_rig, resolve_views
from tooltip_cli.method.evaluation import split_frames
from tooltip_cli.sources.sim import BACKGROUNDS, MOTIONS, TOOLS, SimFrame
from tooltip_cli.sources.simulated import label_state

START = 1_700_000_000_000_000_000
RIG = """
camera:
  frame: optical
  info: camera.yaml
  mount: {parent: base, xyz: [0, 0, 1]}
hand: {frame: hand, pose_topic: /tracker}
"""
CAMERA = """
image_width: 64
image_height: 48
camera_matrix: {rows: 3, cols: 3, data: [50, 0, 31.5, 0, 50, 23.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}
"""


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a simulated recording that nobody may change."""
    out = tmp_path_factory.mktemp("sim") / "pen.mcap"
    options = ("--tool", "pen", "--frames", 30, "--seed", 3, "--size", "320x240", "--jobs", 2)
    done = tooltip("record", "sim", out, *options)
    assert (done.code, done.out) == (0, f"{out}\n")
    assert "30 /camera/image/compressed" in done.err
    assert str(out.with_name("pen.labels.csv")) in done.err
    return out


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    folder = tmp_path / "frames"
    folder.mkdir()
    for index in range(5):
        pixels = np.full((48, 64, 3), 40 * index, dtype=np.uint8)
        (folder / f"{index}.png").write_bytes(cv2.imencode(".png", pixels)[1].tobytes())
    rows = "".join(f"{START + 50_000_000 * row},{0.1 * row:.1f}\n" for row in range(20))
    (tmp_path / "joints.csv").write_text("stamp_ns,wrist\n" + rows)
    rows = "".join(f"{START + 50_000_000 * row},0,0,{row},0,0,0,1\n" for row in range(20))
    (tmp_path / "poses.csv").write_text("stamp_ns,x,y,z,qx,qy,qz,qw\n" + rows)
    (tmp_path / "rig.yaml").write_text(RIG)
    (tmp_path / "camera.yaml").write_text(CAMERA)
    (tmp_path / "robot.urdf").write_text(URDF)
    return folder


def test_help_shows_examples_for_every_source() -> None:
    assert tooltip("record", "--help").code == 0
    for source in ("sim", "bag", "lerobot", "video"):
        text = tooltip("record", source, "--help").out
        assert f"tooltip record {source} " in text
        assert "Examples:" in text
        assert "--force" in text
        assert "--json" in text
    text = " ".join(tooltip("record", "sim", "--help").out.split())
    for name in (*TOOLS, *MOTIONS, *BACKGROUNDS):
        assert name in text


def read(path: Path) -> tuple[Recording, dict[str, list[float]]]:
    recording = read_recording(path)
    return recording, json.loads(recording.attachments["truth.json"])


def test_a_simulated_recording_agrees_with_its_truth(simulated: Path) -> None:
    recording, truth = read(simulated)
    assert not recording.notes
    assert recording.image_stamps_ns.tolist() == truth["stamps_ns"]
    assert recording.urdf is not None
    views = resolve_views(recording, resolve_rig(recording, None))
    assert (views.camera.width, views.camera.height) == (320, 240)
    assert views.known.all()
    tip_hand = np.append(truth["tip_in_hand_m"], 1.0)
    tips_camera = np.linalg.inv(views.hand_from_camera) @ tip_hand
    errors = np.linalg.norm(views.camera.project(tips_camera[:, :3]) - truth["uv"], axis=1)
    # the stamp is the exposure's end, the true pixel its middle: at most some pixels of motion
    assert np.median(errors) < 2
    assert errors.max() < 8


def test_simulated_labels_are_the_test_frames_with_noise(simulated: Path) -> None:
    recording, truth = read(simulated)
    labels = read_labels(simulated.with_name("pen.labels.csv"))
    test = split_frames(30).test
    assert labels.stamps_ns.tolist() == recording.image_stamps_ns[test].tolist()
    assert set(labels.labelers) == {"sim"}
    visible = np.array(truth["visible"])[test]
    assert [state == "visible" for state in labels.states] == visible.tolist()
    noise = (labels.pixels - np.array(truth["uv"])[test])[visible]
    assert 0.3 < noise.std() < 4
    assert np.abs(noise).max() < 8


def test_hidden_tips_are_labelled_so(tmp_path: Path) -> None:
    out = tmp_path / "bottle.mcap"
    options = ("--tool", "bottle", "--frames", 40, "--size", "64x48", "--motion", "fast")
    assert tooltip("record", "sim", out, *options).code == 0
    _, truth = read(out)
    labels = read_labels(out.with_name("bottle.labels.csv"))
    for index, state, pixel in zip(
        split_frames(40).test, labels.states, labels.pixels, strict=True
    ):
        assert state == ("visible" if truth["visible"][index] else "occluded")
        assert np.isfinite(pixel).all() == (state == "visible")
    assert set(labels.states) == {"visible", "occluded"}


@pytest.mark.parametrize(
    ("visible", "in_view", "state"),
    [
        (True, True, "visible"),
        (False, True, "occluded"),
        (False, False, "out_of_view"),
    ],
)
def test_label_states(visible: bool, in_view: bool, state: str) -> None:
    assert label_state(SimFrame(0, 0, b"", np.zeros(2), visible, in_view)) == state


def test_equal_options_give_equal_recordings(tmp_path: Path) -> None:
    options = ("--tool", "pen", "--frames", 4, "--size", "64x48")
    files = []
    for name, jobs in (("a", 1), ("b", 2)):
        out = tmp_path / name / "pen.mcap"
        out.parent.mkdir()
        assert tooltip("record", "sim", out, *options, "--jobs", jobs).code == 0
        files.append((out.read_bytes(), out.with_name("pen.labels.csv").read_bytes()))
    assert files[0] == files[1]
    assert tooltip("record", "sim", out, *options, "--seed", 1, "--force").code == 0
    assert out.read_bytes() != files[0][0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--tool", "spoon"), "unknown tool 'spoon'; known: bottle"),
        (("--motion", "dance"), "unknown motion 'dance'"),
        (("--background", "beach"), "unknown background 'beach'"),
        (("--frames", 0), "frames is 0; expected 1 to"),
        (("--size", "10x10"), "size is 10x10; expected"),
        (("--fps", "nan"), "fps is nan; expected"),
        (("--jpeg-quality", 101), "jpeg_quality is 101; expected"),
    ],
)
def test_wrong_simulations_are_one_line(
    tmp_path: Path, options: tuple[object, ...], message: str
) -> None:
    done = tooltip("record", "sim", tmp_path / "x.mcap", *options)
    assert done.code == 1
    assert message in done.error
    assert not list(tmp_path.iterdir())


def test_wrong_usage_is_2(tmp_path: Path) -> None:
    out = tmp_path / "x.mcap"
    assert tooltip("record", "sim", out, "--size", "wide").code == 2
    assert tooltip("record", "lerobot", tmp_path, out).code == 2
    assert tooltip("record", "video", tmp_path, out, "--fps", 0).code == 2
    assert tooltip("record", "nothing").code == 2


def test_nothing_is_replaced_without_force(wrist: Log, tmp_path: Path) -> None:
    out = tmp_path / "x.mcap"
    out.write_bytes(b"mine")
    done = tooltip("record", "bag", wrist.path, out)
    assert done.code == 1
    assert f"{out} exists" in done.error
    assert out.read_bytes() == b"mine"
    assert tooltip("record", "bag", wrist.path, out, "--force").code == 0
    labels = tmp_path / "pen.labels.csv"
    labels.write_text("mine")
    done = tooltip("record", "sim", tmp_path / "pen.mcap", "--tool", "pen", "--frames", 2)
    assert f"{labels} exists" in done.error
    assert labels.read_text() == "mine"
    assert not (tmp_path / "pen.mcap").exists()


def test_bag_imports_a_foreign_log(wrist: Log, tmp_path: Path) -> None:
    out = tmp_path / "x.mcap"
    done = tooltip("record", "bag", wrist.path, out)
    assert (done.code, done.out) == (0, f"{out}\n")
    before, after = read_recording(wrist.path), read_recording(out)
    assert after.image_stamps_ns.tolist() == before.image_stamps_ns.tolist()
    assert after.camera == before.camera
    assert after.urdf == before.urdf
    assert f"{len(before.image_stamps_ns)} {IMAGE_TOPIC}" in done.err


def test_json_says_what_was_read(wrist: Log, tmp_path: Path) -> None:
    done = tooltip("record", "bag", wrist.path, tmp_path / "x.mcap", "--json")
    document = json.loads(done.out)
    assert document["recording"] == str(tmp_path / "x.mcap")
    assert {IMAGE_TOPIC, INFO_TOPIC, JOINT_TOPIC, ROBOT_TOPIC} == set(document["read"])
    assert document["dropped"] == {}


def test_a_missing_topic_is_one_line(wrist: Log, tmp_path: Path) -> None:
    done = tooltip("record", "bag", wrist.path, tmp_path / "x.mcap", "--image", "/nowhere")
    assert done.code == 1
    assert f"found: {IMAGE_TOPIC}" in done.error
    done = tooltip("record", "bag", tmp_path / "absent.bag", tmp_path / "x.mcap")
    assert (done.code, done.out) == (1, "")
    assert "absent.bag: cannot be opened" in done.error


def test_video_with_joints_and_a_robot(frames: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.mcap"
    done = tooltip(
        *("record", "video", frames, out, "--joints", tmp_path / "joints.csv"),
        *("--fps", 20, "--start", "1700000000.25s", "--robot", tmp_path / "robot.urdf"),
    )
    assert (done.code, done.out) == (0, f"{out}\n")
    recording = read_recording(out)
    first = START + 250_000_000
    assert recording.image_stamps_ns.tolist() == [first + 50_000_000 * i for i in range(5)]
    assert recording.joints["wrist"].positions.tolist() == [round(0.1 * i, 1) for i in range(20)]
    assert recording.urdf == URDF


def test_video_with_poses_needs_no_rig_later(frames: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.mcap"
    done = tooltip(
        *("record", "video", frames, out, "--poses", tmp_path / "poses.csv"),
        *("--fps", 20, "--rig", tmp_path / "rig.yaml"),
    )
    assert done.code == 0
    assert "no robot description" not in done.err
    recording = read_recording(out)
    views = resolve_views(recording, resolve_rig(recording, None))
    assert views.hand_from_camera[:, 2, 3].tolist() == [1.0 - row for row in range(5)]


def test_a_rig_without_a_robot_is_said(frames: Path, tmp_path: Path) -> None:
    rig = tmp_path / "arm.yaml"
    rig.write_text("hand: {frame: hand}")
    arguments = ("record", "video", frames, tmp_path / "x.mcap", "--fps", 20, "--rig", rig)
    assert "holds no robot description; give --robot" in tooltip(*arguments).err
    done = tooltip(*arguments, "--force", "--robot", tmp_path / "robot.urdf")
    assert "no robot description" not in done.err
    assert read_recording(tmp_path / "x.mcap").attachments["robot.urdf"] == URDF.encode()


@pytest.mark.parametrize(
    ("option", "name", "text", "message"),
    [
        ("--robot", "x.urdf", None, "x.urdf: cannot be read"),
        ("--robot", "x.urdf", "hand: {frame: a}", "x.urdf is no URDF"),
        ("--rig", "x.yaml", None, "x.yaml: cannot be read"),
        ("--rig", "x.yaml", "hands: {}", "unknown key 'hands'"),
        ("--joints", "x.csv", "stamp_ns,a\n1\n", "x.csv:2: 1 values"),
        ("--poses", "x.csv", "stamp_ns,x\n1,2\n", "x.csv:1: expected the columns"),
        ("--start", "x", None, "is no stamp"),
    ],
)
def test_wrong_files_are_one_line(
    frames: Path, tmp_path: Path, option: str, name: str, text: str | None, message: str
) -> None:
    path = tmp_path / name
    if text is not None:
        path.write_text(text)
    done = tooltip("record", "video", frames, tmp_path / "out.mcap", "--fps", 20, option, path)
    assert done.code == 1
    assert message in done.error
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize(
    ("module", "arguments", "extra"),
    [
        ("rosbags.rosbag1", ("bag", "in.bag"), "bag"),
        ("rosbags.rosbag2", ("bag", "in.db3"), "bag"),
        ("av", ("video", "in.mp4"), "lerobot"),
        ("pyarrow", ("lerobot", "set", "--episode", 0), "lerobot"),
    ],
)
def test_a_missing_extra_names_the_install_command(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    module: str,
    arguments: tuple[str, ...],
    extra: str,
) -> None:
    (tmp_path / "in.bag").write_bytes(b"#ROSBAG V2.0\n")
    (tmp_path / "in.db3").write_bytes(b"SQLite format 3\0")
    (tmp_path / "set" / "meta").mkdir(parents=True)
    (tmp_path / "set" / "meta" / "info.json").write_text(
        '{"codebase_version": "v2.1", "fps": 30, "features": {"camera": {"dtype": "video"}, '
        '"observation.state": {"shape": [1], "names": ["a"]}}}'
    )
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.chdir(tmp_path)
    source, path, *options = arguments
    done = tooltip("record", source, path, tmp_path / "out.mcap", *options)
    assert done.code == 1
    assert f"record {source} needs the package '{module.split('.')[0]}'" in done.error
    assert f"pip install 'tooltip-cli[{extra}]'" in done.error


def test_lerobot_lists_what_is_there(reference_data: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.mcap"
    g1 = reference_data / "g1"
    done = tooltip("record", "lerobot", g1, out, "--episode", 2)
    assert "has no episode 2; listed: 1, 33, 40, 80" in done.error
    done = tooltip("record", "lerobot", g1, out, "--episode", 1, "--camera", "top")
    assert "known: observation.images.cam_high" in done.error
    rig = Path(__file__).parents[1] / "calib" / "g1" / "rig.yaml"
    robot = g1 / "g1_body29_hand14.urdf"
    options = ("--episode", 33, "--rig", rig, "--robot", robot)
    done = tooltip("record", "lerobot", g1, out, *options)
    assert (done.code, done.out) == (0, f"{out}\n")
    recording = read_recording(out)
    views = resolve_views(recording, resolve_rig(recording, None))
    assert views.known.all()
    assert len(views.spheres) == 4
