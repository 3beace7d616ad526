"""The result for viewers and robots: what is exported is what was estimated, where it belongs."""

from __future__ import annotations

import json
import shlex
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pinocchio
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.cli import tooltip
from tests.helpers.logs import (
    FRAMES,
    IMAGE_TOPIC,
    JOINT_TOPIC,
    POSE_TOPIC,
    Log,
    angles,
    stamp_of,
    true_pixels,
    wrist_parts,
    write_log,
    write_true_labels,
)
from tests.helpers.robot import (
    CAMERA,
    CAMERA_FRAME,
    HAND_FRAME,
    RIG,
    TIP,
    URDF,
    camera_from_hand,
)
from tooltip_cli.errors import TooltipError
from tooltip_cli.log import messages
from tooltip_cli.log.annotations import GREEN, WHITE, cross, rings
from tooltip_cli.log.container import LoggedAttachment, LoggedMessage, iterate
from tooltip_cli.log.messages import Message
from tooltip_cli.log.scene import ellipsoid
from tooltip_cli.method.types import Candidate, TipEstimate
from tooltip_cli.rig.kinematics import (
    Mount,
    inverse_transform,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_rpy,
)
from tooltip_cli.rig.tool_tip import urdf_with_tip
from tooltip_cli.rig.tree import KinematicTree
from tooltip_cli.stages.estimate import Estimated, tip_document

Array = npt.NDArray[np.float64]
COVARIANCE = np.diag([4e-6, 1e-6, 9e-6])
OK = TipEstimate("voting", TIP, COVARIANCE, (Candidate(TIP, 0.9), Candidate(TIP / 2, 0.4)), (), 40)
REFUSED = TipEstimate("voting", None, None, (), (), 0)


@pytest.fixture
def estimated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the estimate be the truth: what is exported can then be computed by hand."""
    use(monkeypatch, OK)


def use(monkeypatch: pytest.MonkeyPatch, estimate: TipEstimate) -> None:
    document = tip_document(estimate, {"key": "k"})

    def fake(recording: Any, *arguments: object, **options: object) -> Estimated:
        return Estimated(recording.path, "k", False, estimate, document, None)

    monkeypatch.setattr("tooltip_cli.stages.export.estimate_from_images", fake)


def by_topic(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Return (log time, decoded message) of every topic."""
    found = defaultdict(list)
    for item in iterate(path):
        if isinstance(item, LoggedMessage):
            decoded = messages.decode(item.datatype, item.payload)
            found[item.topic].append((item.log_time_ns, decoded))
    return found


def matrix(stamped: Any) -> Array:
    transform = np.eye(4)
    rotation, place = stamped.transform.rotation, stamped.transform.translation
    quaternion = [rotation.x, rotation.y, rotation.z, rotation.w]
    transform[:3, :3] = rotation_from_quaternion(quaternion)
    transform[:3, 3] = place.x, place.y, place.z
    return transform


def look_up(transforms: dict[str, tuple[str, Array]], child: str) -> tuple[str, Array]:
    """Return the root above a frame, and root_from_frame."""
    total = np.eye(4)
    while child in transforms:
        child, parent_from_child = transforms[child]
        total = parent_from_child @ total
    return child, total


def test_everything_is_in_one_file(wrist: Log, estimated: None, tmp_path: Path) -> None:
    write_true_labels(wrist.labels, [3, 7])
    out = tmp_path / "out.mcap"
    done = tooltip("export", wrist.path, out)
    assert done.code == 0, done.err
    assert done.out == f"{out}\n"
    found = by_topic(out)
    source = by_topic(wrist.path)
    for topic in (IMAGE_TOPIC, JOINT_TOPIC):
        assert len(found[topic]) == len(source[topic])
    assert len(found["/tf"]) == FRAMES
    assert len(found["/robot_description"]) == 1
    assert len(found["/tooltip/prediction_annotations"]) == FRAMES
    assert len(found["/tooltip/detection_annotations"]) == FRAMES - 1
    attached = {item.name: item for item in iterate(out) if isinstance(item, LoggedAttachment)}
    assert {"rig.yaml", "camera.yaml", "robot.urdf", "tip.json"} == set(attached)
    assert json.loads(attached["tip.json"].data)["status"] == "ok"
    labelled = [
        messages.ns_from_time(message.circles[0].timestamp)
        for _, message in found["/tooltip/label_annotations"]
        if message.circles
    ]
    assert labelled == [stamp_of(3), stamp_of(7)]


def test_transforms_chain_from_the_camera_to_the_tip(
    wrist: Log, estimated: None, tmp_path: Path
) -> None:
    out = tmp_path / "out.mcap"
    assert tooltip("export", wrist.path, out).code == 0
    found = by_topic(out)
    fixed = {
        item.child_frame_id: (item.header.frame_id, matrix(item))
        for item in found["/tf_static"][0][1].transforms
    }
    for index in (0, 11, FRAMES - 1):
        message = found["/tf"][index][1]
        assert {messages.ns_from_time(item.header.stamp) for item in message.transforms} == {
            stamp_of(index)
        }
        moving = {
            item.child_frame_id: (item.header.frame_id, matrix(item)) for item in message.transforms
        }
        root_1, base_from_tip = look_up({**fixed, **moving}, "tool_tip")
        root_2, base_from_camera = look_up({**fixed, **moving}, CAMERA_FRAME)
        assert root_1 == root_2 == "base"
        camera_from_tip = inverse_transform(base_from_camera) @ base_from_tip
        expected = camera_from_hand(*angles(stamp_of(index)))
        np.testing.assert_allclose(camera_from_tip[:3, 3], (expected @ [*TIP, 1])[:3], atol=2e-4)
        # and lies where the mark is, half a pixel from the corner that viewers count from
        mark = found["/tooltip/prediction_annotations"][index][1].points[0]
        middle = np.mean([[point.x, point.y] for point in mark.points], axis=0) - 0.5
        np.testing.assert_allclose(middle, CAMERA.project(camera_from_tip[:3, 3]), atol=1e-6)
        np.testing.assert_allclose(middle, true_pixels()[index], atol=0.1)


def test_the_computed_stands_before_its_image_at_its_time(
    wrist: Log, estimated: None, tmp_path: Path
) -> None:
    out = tmp_path / "out.mcap"
    assert tooltip("export", wrist.path, out).code == 0
    order = [
        (item.log_time_ns, item.topic) for item in iterate(out) if isinstance(item, LoggedMessage)
    ]
    times = [time for time, _ in order]
    assert times == sorted(times)
    places = [place for place, (_, topic) in enumerate(order) if topic == IMAGE_TOPIC]
    assert all("/tf" in [topic for _, topic in order[place - 5 : place]] for place in places)


def test_the_scene_holds_rays_candidates_hand_and_tip(
    wrist: Log, estimated: None, tmp_path: Path
) -> None:
    out = tmp_path / "out.mcap"
    assert tooltip("export", wrist.path, out).code == 0
    (_, scene) = by_topic(out)["/tooltip/scene"][0]
    entities = {item.id: item for item in scene.entities}
    assert set(entities) == {"hand", "rays", "candidates", "tip"}
    assert {(item.frame_id, item.frame_locked) for item in scene.entities} == {(HAND_FRAME, True)}
    tip = entities["tip"].spheres[0]
    assert [tip.pose.position.x, tip.pose.position.y, tip.pose.position.z] == pytest.approx(TIP)
    sizes = sorted([tip.size.x, tip.size.y, tip.size.z])
    assert sizes == pytest.approx([0.004, 0.008, 0.012])  # two standard deviations each way
    points = [[p.x, p.y, p.z] for p in entities["rays"].lines[0].points]
    starts, ends = np.array(points[::2]), np.array(points[1::2])
    rays = ends - starts
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    distances = np.linalg.norm(np.cross(TIP - starts, rays), axis=1)
    assert np.median(distances) < 0.02
    assert len(entities["candidates"].spheres) == 1
    assert len(entities["hand"].spheres) == len(RIG.spheres)


def test_a_refused_estimate_is_viewed_without_a_tip(
    wrist: Log, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    use(monkeypatch, REFUSED)
    out = tmp_path / "out.mcap"
    assert tooltip("export", wrist.path, out).code == 0
    found = by_topic(out)
    assert "/tooltip/prediction_annotations" not in found
    frames = {item.child_frame_id for item in found["/tf_static"][0][1].transforms}
    assert "tool_tip" not in frames
    for option in (["--tf"], ["--urdf", tmp_path / "a.urdf"]):
        done = tooltip("export", wrist.path, *option)
        assert done.code == 3
        assert "has no estimate to export" in done.error
    assert not (tmp_path / "a.urdf").exists()


def test_hand_poses_instead_of_joints(estimated: None, tmp_path: Path) -> None:
    mount = Mount("base", (0.1, 0.2, 0.3), (0.1, -0.2, 0.3))
    parts = wrist_parts()
    poses = []
    for frame in range(FRAMES):
        pose = mount.parent_from_camera @ camera_from_hand(*angles(stamp_of(frame)))
        payload = messages.pose_stamped(
            stamp_of(frame),
            "base",
            pose[:3, 3].tolist(),
            quaternion_from_rotation(pose[:3, :3]).tolist(),
        )
        poses.append(Message(POSE_TOPIC, messages.POSE_STAMPED, stamp_of(frame), payload))
    rig = replace(RIG, urdf=None, mount=mount, pose_topic=POSE_TOPIC)
    path = write_log(
        tmp_path / "a.mcap", {"images": parts["images"], "info": parts["info"], "p": poses}, rig=rig
    )
    done = tooltip("export", path, tmp_path / "out.mcap")
    assert done.code == 0, done.err
    found = by_topic(tmp_path / "out.mcap")
    fixed = {
        item.child_frame_id: (item.header.frame_id, matrix(item))
        for item in found["/tf_static"][0][1].transforms
    }
    (item,) = found["/tf"][4][1].transforms
    moving = {item.child_frame_id: (item.header.frame_id, matrix(item))}
    _, base_from_tip = look_up({**fixed, **moving}, "tool_tip")
    _, base_from_camera = look_up({**fixed, **moving}, CAMERA_FRAME)
    found_tip = (inverse_transform(base_from_camera) @ base_from_tip)[:3, 3]
    expected = camera_from_hand(*angles(stamp_of(4))) @ [*TIP, 1]
    np.testing.assert_allclose(found_tip, expected[:3], atol=1e-6)
    assert "logs hand poses" in tooltip("export", path, "--urdf", tmp_path / "a.urdf").error


def test_the_recordings_own_transforms_are_replaced(estimated: None, tmp_path: Path) -> None:
    parts = wrist_parts()
    empty = messages.encode(messages.TF_MESSAGE, {})
    parts["tf"] = [Message("/tf", messages.TF_MESSAGE, stamp_of(1), empty)]
    path = write_log(tmp_path / "a.mcap", parts)
    done = tooltip("export", path, tmp_path / "out.mcap")
    assert "/tf is computed anew, and the recording's own is left out" in done.err
    assert len(by_topic(tmp_path / "out.mcap")["/tf"]) == FRAMES


def test_nothing_to_export_is_wrong_usage(wrist: Log) -> None:
    done = tooltip("export", wrist.path)
    assert done.code == 2
    assert "nothing to export; give OUT.mcap" in done.err


def test_nothing_is_overwritten(wrist: Log, estimated: None, tmp_path: Path) -> None:
    for option in ([], ["--urdf"]):
        place = tmp_path / "precious"
        place.write_text("precious")
        done = tooltip("export", wrist.path, *option, place)
        assert "exists; give another name, or --force" in done.error
        assert place.read_text() == "precious"
        assert tooltip("export", wrist.path, *option, place, "--force").code == 0
        assert place.read_bytes() != b"precious"


def test_the_transform_as_command_and_as_yaml(wrist: Log, estimated: None) -> None:
    done = tooltip("export", wrist.path, "--tf")
    assert done.code == 0, done.err
    command, transform = yaml.safe_load_all(done.out)
    words = shlex.split(command)
    assert words[:4] == ["ros2", "run", "tf2_ros", "static_transform_publisher"]
    options = dict(zip(words[4::2], words[5::2], strict=True))
    assert [float(options[f"--{axis}"]) for axis in "xyz"] == pytest.approx(TIP)
    assert [float(options[f"--q{axis}"]) for axis in "xyzw"] == [0, 0, 0, 1]
    assert (options["--frame-id"], options["--child-frame-id"]) == (HAND_FRAME, "tool_tip")
    payload = messages.encode(messages.TF_MESSAGE, {"transforms": [transform]})
    (stamped,) = messages.decode(messages.TF_MESSAGE, payload).transforms
    np.testing.assert_allclose(matrix(stamped)[:3, 3], TIP)
    document = json.loads(tooltip("export", wrist.path, "--tf", "--json").out)
    assert document["transform"] == transform


def test_the_urdf_has_a_tip_where_pinocchio_finds_it(
    wrist: Log, estimated: None, tmp_path: Path
) -> None:
    path = tmp_path / "robot.urdf"
    assert tooltip("export", wrist.path, "--urdf", path).code == 0
    text = path.read_text()
    model = pinocchio.buildModelFromXML(text)
    data = model.createData()
    q = pinocchio.neutral(model)
    q[model.joints[model.getJointId("wrist_pitch")].idx_q] = 0.3
    q[model.joints[model.getJointId("wrist_roll")].idx_q] = -0.2
    pinocchio.framesForwardKinematics(model, data, q)
    tip = data.oMf[model.getFrameId("tool_tip")].translation
    expected = camera_from_hand(0.3, -0.2) @ [*TIP, 1]  # the camera stands at the base
    np.testing.assert_allclose(tip, expected[:3], atol=1e-6)
    addition = text[text.index('  <link name="tool_tip"/>') : text.rindex("</robot>")]
    assert text.replace(addition, "") == URDF


@pytest.mark.parametrize(
    ("urdf", "hand", "expected"),
    [
        (URDF, "palm", "unknown hand frame 'palm'"),
        (urdf_with_tip(URDF, HAND_FRAME, TIP, "x"), HAND_FRAME, "already has a link 'tool_tip'"),
        ("<robot", HAND_FRAME, "not a URDF"),
        (URDF + "<!-- </robot> -->", HAND_FRAME, "cannot be added"),
        (f"<!DOCTYPE r>{URDF}", HAND_FRAME, "declares a document type or entities"),
    ],
)
def test_urdfs_that_take_no_tip(urdf: str, hand: str, expected: str) -> None:
    with pytest.raises(TooltipError, match=expected):
        urdf_with_tip(urdf, hand, TIP, "a.urdf")


def test_the_tree_of_a_robot() -> None:
    tree = KinematicTree.from_urdf(URDF, "x")
    assert tree.root == "base"
    assert {(link.name, link.parent, link.fixed) for link in tree.links} == {
        (CAMERA_FRAME, "base", True),
        ("forearm", "base", False),
        (HAND_FRAME, "forearm", False),
        ("finger", HAND_FRAME, False),
    }
    assert set(tree.joint_names) == {"wrist_pitch", "wrist_roll", "grip"}
    found = dict(
        zip(
            [link.name for link in tree.links],
            tree.parent_from_link({"wrist_pitch": 0.3, "wrist_roll": -0.2, "grip": 0.05}),
            strict=True,
        )
    )
    camera = found["forearm"] @ found[HAND_FRAME]
    np.testing.assert_allclose(camera, camera_from_hand(0.3, -0.2), atol=1e-12)
    np.testing.assert_allclose(found["finger"][:3, 3], [0, 0, 0.05], atol=1e-12)


@given(st.tuples(*[st.floats(-3.1, 3.1)] * 3))
def test_quaternions_and_rotations_agree(rpy: tuple[float, float, float]) -> None:
    rotation = rotation_from_rpy(rpy)
    quaternion = quaternion_from_rotation(rotation)
    assert np.linalg.norm(quaternion) == pytest.approx(1.0)
    assert quaternion[3] >= 0
    np.testing.assert_allclose(rotation_from_quaternion(quaternion), rotation, atol=1e-9)
    reference = pinocchio.Quaternion(rotation).coeffs()
    assert abs(reference @ quaternion) == pytest.approx(1.0)


@pytest.mark.parametrize("axis", range(3))
def test_quaternions_of_half_turns(axis: int) -> None:
    rotation = -np.eye(3)
    rotation[axis, axis] = 1.0
    quaternion = quaternion_from_rotation(rotation)
    assert abs(quaternion[axis]) == pytest.approx(1.0)


def test_quaternions_of_many_rotations_at_once() -> None:
    angles_ = np.random.default_rng(0).uniform(-3, 3, (5, 4, 3))
    rotations = np.array([[rotation_from_rpy(item) for item in row] for row in angles_])
    found = quaternion_from_rotation(rotations)
    assert found.shape == (5, 4, 4)
    np.testing.assert_allclose(rotation_from_quaternion(found), rotations, atol=1e-9)


def test_an_ellipsoid_has_the_covariances_axes() -> None:
    turn = rotation_from_rpy((0.3, -0.5, 1.0))
    covariance = turn @ np.diag([1e-6, 4e-6, 9e-6]) @ turn.T
    shape = ellipsoid(np.zeros(3), covariance, 1.0, WHITE)
    quaternion = [shape["pose"]["orientation"][axis] for axis in "xyzw"]
    axes = rotation_from_quaternion(quaternion)
    sizes = np.array([shape["size"][axis] for axis in "xyz"]) / 2
    np.testing.assert_allclose(axes @ np.diag(sizes**2) @ axes.T, covariance, atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)


@pytest.mark.parametrize("pixel", [(np.nan, 5.0), (5.0, np.inf)])
def test_marks_without_a_pixel_clear_what_was_there(pixel: tuple[float, float]) -> None:
    for payload in (rings(5, *pixel, WHITE, GREEN), cross(5, *pixel, GREEN)):
        message = messages.decode(messages.IMAGE_ANNOTATIONS, payload)
        assert [*message.circles, *message.points, *message.texts] == []


def test_a_real_estimate_is_made_where_it_is_missing(wrist: Log, tmp_path: Path) -> None:
    """No part replaced: the wrist's motion is too slow for voting, so take the paper's method."""
    done = tooltip("export", wrist.path, "--tf", "--method", "kmeans")
    assert (wrist.path.parent / "wrist.tip.json").exists()
    document = json.loads((wrist.path.parent / "wrist.tip.json").read_text())
    assert done.code == (0 if document["status"] == "ok" else 3)
