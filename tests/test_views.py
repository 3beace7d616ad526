"""Where the camera was, seen from the hand: from joints, from poses, or a clear refusal."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.helpers.logs import (
    FRAMES,
    JOINT_TOPIC,
    POSE_TOPIC,
    START_NS,
    Log,
    Parts,
    angles,
    info_message,
    joint_message,
    robot_message,
    stamp_of,
    wrist_parts,
    write_log,
)
from tests.helpers.robot import (
    CAMERA,
    HAND_FRAME,
    JOINTS,
    RIG,
    SPHERES,
    camera_from_hand,
)
from tooltip_cli.errors import TooltipError
from tooltip_cli.log import messages
from tooltip_cli.log.messages import Message
from tooltip_cli.log.recording import Topics, read_recording
from tooltip_cli.log.views import Views, resolve_camera, resolve_rig, resolve_views
from tooltip_cli.rig.camera import CameraModel
from tooltip_cli.rig.kinematics import Mount
from tooltip_cli.rig.rigfile import Rig, rig_files

BARE = Rig(hand_frame=HAND_FRAME)
MOUNT = Mount("tracker", (0.1, -0.2, 0.3), (0.4, 0.5, -0.6))
POSED = Rig(hand_frame=HAND_FRAME, pose_topic=POSE_TOPIC, mount=MOUNT)


def views_of(
    path: Path, parts: Parts, rig: Rig | None = RIG, topics: Topics | None = None
) -> Views:
    recording = read_recording(write_log(path / "a.mcap", parts, rig=rig), topics or Topics())
    return resolve_views(recording, resolve_rig(recording, None) if rig else BARE)


def refused(path: Path, parts: Parts, rig: Rig | None = RIG, **topics: str) -> str:
    with pytest.raises(TooltipError) as caught:
        views_of(path, parts, rig, Topics(**topics))
    return str(caught.value)


def assert_true_poses(views: Views, offset_ns: int = 0) -> None:
    """The joints are logged every 10 ms and interpolated, hence the tolerance."""
    for frame in np.flatnonzero(views.known):
        wanted = camera_from_hand(*angles(stamp_of(int(frame)) + offset_ns))
        assert np.abs(views.hand_from_camera[frame] @ wanted - np.eye(4)).max() < 2e-4


def test_joints_of_the_chain_give_the_poses(wrist: Log) -> None:
    recording = read_recording(wrist.path)
    views = resolve_views(recording, resolve_rig(recording, None))
    assert views.known.all()
    assert len(views.known) == FRAMES
    assert views.camera == CAMERA
    assert views.spheres == SPHERES
    assert np.array_equal(views.stamps_ns, recording.image_stamps_ns)
    assert_true_poses(views)


def test_the_log_alone_is_enough_for_a_least_rig(tmp_path: Path) -> None:
    views = views_of(tmp_path, wrist_parts(5), rig=None)
    assert views.camera == CAMERA  # from CameraInfo
    assert_true_poses(views)  # the URDF from the log, the camera's frame from the images


def test_a_rig_file_wins_over_the_stored_one(wrist: Log, tmp_path: Path) -> None:
    recording = read_recording(wrist.path)
    (tmp_path / "rig.yaml").write_text("hand: {frame: forearm}")
    rig = resolve_rig(recording, tmp_path / "rig.yaml")
    assert rig.hand_frame == "forearm"
    assert rig.source == str(tmp_path / "rig.yaml")


def test_the_rigs_camera_wins_over_the_logs(tmp_path: Path) -> None:
    parts = wrist_parts(2)
    parts["info"] = [info_message(replace(CAMERA, fx=99.0))]
    assert views_of(tmp_path, parts).camera == CAMERA
    assert views_of(tmp_path / "least", parts, rig=None).camera.fx == 99.0


def test_images_outside_the_joints_are_unknown(tmp_path: Path) -> None:
    parts = wrist_parts(10)
    stop = stamp_of(6)
    parts["joints"] = [message for message in parts["joints"] if message.log_time_ns < stop]
    views = views_of(tmp_path, parts)
    assert views.known.tolist() == [True] * 6 + [False] * 4
    assert_true_poses(views)


def test_gaps_longer_than_a_tenth_of_a_second_are_unknown(tmp_path: Path) -> None:
    parts = wrist_parts(12)
    low, high = stamp_of(3) + 10_000_000, stamp_of(7) - 10_000_000
    parts["joints"] = [m for m in parts["joints"] if not low < m.log_time_ns < high]
    assert views_of(tmp_path, parts).known.tolist() == [True] * 4 + [False] * 3 + [True] * 5


def test_the_time_offset_is_added_to_image_stamps(tmp_path: Path) -> None:
    offset = 0.025
    rig = replace(RIG, time_offset_s=offset)
    views = views_of(tmp_path, wrist_parts(10), rig)
    assert_true_poses(views, round(offset * 1e9))
    assert views.stamps_ns.tolist() == [stamp_of(frame) for frame in range(10)]


@pytest.mark.parametrize("offset", [1e9, -1e9, 4e9, -4e9])
def test_offsets_beyond_the_recording_leave_nothing(offset: float, tmp_path: Path) -> None:
    message = refused(tmp_path, wrist_parts(2), replace(RIG, time_offset_s=offset))
    assert f"after the time offset of {offset} s" in message
    assert "set time_offset in the rig file" in message


def test_mapped_names_stand_for_the_urdfs_joints(tmp_path: Path) -> None:
    parts = wrist_parts(4)
    names = {"kPitch": JOINTS[0], "kRoll": JOINTS[1]}
    parts["joints"] = [
        joint_message(stamp, names, angles(stamp))
        for stamp in range(START_NS, stamp_of(6), 10_000_000)
    ]
    assert "lacks wrist_pitch, wrist_roll" in refused(tmp_path, parts)
    assert_true_poses(views_of(tmp_path / "mapped", parts, replace(RIG, joints=names)))


def test_a_mapped_name_wins_over_a_logged_joint_of_that_name(tmp_path: Path) -> None:
    parts = wrist_parts(4)
    # the log's own wrist_pitch is something else, e.g. a motor's side of a gear
    parts["joints"] = [
        joint_message(stamp, (*JOINTS, "true_pitch"), (9.0, angles(stamp)[1], angles(stamp)[0]))
        for stamp in range(START_NS, stamp_of(6), 10_000_000)
    ]
    assert_true_poses(views_of(tmp_path, parts, replace(RIG, joints={"true_pitch": JOINTS[0]})))


def test_swapped_names_are_swapped_back(tmp_path: Path) -> None:
    parts = wrist_parts(4)
    parts["joints"] = [
        joint_message(stamp, JOINTS[::-1], angles(stamp))
        for stamp in range(START_NS, stamp_of(6), 10_000_000)
    ]
    rig = replace(RIG, joints={JOINTS[0]: JOINTS[1], JOINTS[1]: JOINTS[0]})
    assert_true_poses(views_of(tmp_path, parts, rig))


def test_joints_published_one_by_one(tmp_path: Path) -> None:
    parts = wrist_parts(5)
    parts["joints"] = [
        joint_message(stamp + shift, (name,), (angles(stamp + shift)[index],))
        for stamp in range(START_NS, stamp_of(7), 10_000_000)
        for index, (name, shift) in enumerate(zip(JOINTS, (0, 3_000_000), strict=True))
    ]
    assert_true_poses(views_of(tmp_path, parts))


def rotation_to_quaternion(rotation: Any) -> tuple[float, float, float, float]:
    """Return x, y, z, w; good for rotations by less than half a turn."""
    w = np.sqrt(1 + np.trace(rotation)) / 2
    x, y, z = (
        rotation[2, 1] - rotation[1, 2],
        rotation[0, 2] - rotation[2, 0],
        rotation[1, 0] - rotation[0, 1],
    )
    return x / (4 * w), y / (4 * w), z / (4 * w), w


def posed_parts(frames: int, *, frame: str = "tracker", topic: str = POSE_TOPIC) -> Parts:
    """Return a recording that logs the hand's pose in a tracker's frame instead of joints."""
    parts = wrist_parts(frames)
    parts["joints"], parts["robot"], poses = [], [], []
    for stamp in range(START_NS, stamp_of(frames) + 50_000_000, 5_000_000):
        tracker_from_hand = MOUNT.parent_from_camera @ camera_from_hand(*angles(stamp))
        payload = messages.pose_stamped(
            stamp,
            frame,
            tracker_from_hand[:3, 3].tolist(),
            rotation_to_quaternion(tracker_from_hand[:3, :3]),
        )
        poses.append(Message(topic, messages.POSE_STAMPED, stamp, payload))
    parts["poses"] = poses
    return parts


def test_poses_instead_of_joints(tmp_path: Path) -> None:
    assert_true_poses(views_of(tmp_path, posed_parts(8), POSED))


def test_the_rig_names_one_of_several_pose_topics(tmp_path: Path) -> None:
    parts = posed_parts(8)
    parts["goal"] = posed_parts(2, frame="goal", topic="/goal")["poses"]
    assert_true_poses(views_of(tmp_path, parts, POSED))


def test_a_pose_topic_chosen_on_the_command_line_wins(tmp_path: Path) -> None:
    parts = posed_parts(8, topic="/vicon/hand")
    message = refused(tmp_path, parts, POSED)
    assert f"has no geometry_msgs/msg/PoseStamped on {POSE_TOPIC}" in message
    assert "logged: /vicon/hand" in message
    chosen = Topics(pose="/vicon/hand")
    assert_true_poses(views_of(tmp_path / "chosen", parts, POSED, chosen))


def test_poses_need_the_cameras_mount_in_their_frame(tmp_path: Path) -> None:
    message = refused(tmp_path, posed_parts(3), replace(POSED, mount=None))
    assert "camera.mount" in message
    assert "'tracker'" in message
    message = refused(tmp_path / "b", posed_parts(3, frame="world"), POSED)
    assert "camera.mount.parent is 'tracker', but the poses on /hand_pose are given in 'world'" in (
        message
    )


def test_poses_that_are_all_unusable(tmp_path: Path) -> None:
    parts = posed_parts(3)
    payload = messages.pose_stamped(START_NS, "tracker", (0, 0, 0), (0, 0, 0, 0))
    parts["poses"] = [Message(POSE_TOPIC, messages.POSE_STAMPED, START_NS, payload)]
    message = refused(tmp_path, parts, POSED)
    assert "no usable sample of /hand_pose" in message
    assert "1 poses without finite numbers and a unit quaternion" in message


def test_poses_that_end_before_the_images(tmp_path: Path) -> None:
    parts = posed_parts(3)
    parts["poses"] = parts["poses"][:3]
    assert "no image falls between two samples of /hand_pose" in refused(tmp_path, parts, POSED)


def test_a_recording_without_a_rig(tmp_path: Path) -> None:
    recording = read_recording(write_log(tmp_path / "a.mcap", wrist_parts(2), rig=None))
    with pytest.raises(TooltipError, match=r"carries no rig; name the rig file with --rig"):
        resolve_rig(recording, None)


@pytest.mark.parametrize(
    ("attachments", "expected"),
    [
        ({"rig.yaml": b"\xff\xfe"}, "attachment rig.yaml: not UTF-8"),
        ({"rig.yaml": b"hand: 3"}, "attachment rig.yaml: hand must be a mapping"),
        ({"rig.yaml": b"{robot: robot.urdf, hand: {frame: h}}"}, "names 'robot.urdf', which is"),
        (
            {"rig.yaml": b"{camera: {info: c.yaml}, hand: {frame: h}}", "c.yaml": b"\xff"},
            "attachment c.yaml: not UTF-8",
        ),
        (
            {"rig.yaml": b"{camera: {info: c.yaml}, hand: {frame: h}}", "c.yaml": b"a: 1"},
            "lacks image_width",
        ),
    ],
)
def test_stored_rigs_that_are_broken(
    attachments: dict[str, bytes], expected: str, tmp_path: Path
) -> None:
    path = write_log(tmp_path / "a.mcap", wrist_parts(2), attachments, rig=None)
    with pytest.raises(TooltipError) as caught:
        resolve_rig(read_recording(path), None)
    assert str(path) in str(caught.value)
    assert expected in str(caught.value)


def test_the_stored_rig_is_the_one_that_was_recorded(wrist: Log) -> None:
    recording = read_recording(wrist.path)
    assert rig_files(resolve_rig(recording, None)) == rig_files(RIG)


def test_uncalibrated_cameras(tmp_path: Path) -> None:
    parts = wrist_parts(2)
    parts["info"] = []
    message = refused(tmp_path, parts, rig=None)
    assert "the camera is not calibrated" in message
    assert "camera.info in the rig file" in message
    recording = read_recording(tmp_path / "a.mcap")
    assert resolve_camera(recording, RIG) == CAMERA


def test_images_of_another_size_than_the_intrinsics(tmp_path: Path) -> None:
    camera = CameraModel(320, 240, 280.0, 282.0, 159.5, 119.5, "plumb_bob", ())
    message = refused(tmp_path, wrist_parts(2), replace(RIG, camera=camera))
    assert "images are 160x120 but the intrinsics are for 320x240" in message


MISSING: dict[str, tuple[dict[str, list[Message]], dict[str, Any], str]] = {
    "no robot": ({"robot": []}, {"urdf": None}, "has no /robot_description"),
    "no joints": ({"joints": []}, {}, "holds no joint positions"),
    "other joints": (
        {"joints": [joint_message(START_NS, ("x", "y"), (0.0, 0.0))]},
        {},
        "/joint_states lacks wrist_pitch, wrist_roll, which lie between camera and hand; "
        "logged: x, y",
    ),
    "mapped to nothing": (
        {"joints": [joint_message(START_NS, ("x", JOINTS[1]), (0.0, 0.0))]},
        {"joints": {"kPitch": JOINTS[0]}},
        "maps names that are not logged: kPitch",
    ),
    "unknown hand": ({}, {"hand_frame": "palm"}, "unknown hand frame 'palm'; known: base,"),
    "unknown camera": ({}, {"camera_frame": "eye"}, "unknown camera frame 'eye'; known: base,"),
    "unknown mount": ({}, {"mount": Mount("neck")}, "unknown camera frame 'neck'"),
    "broken robot": ({}, {"urdf": "<robot"}, "not a URDF"),
    "broken logged robot": ({"robot": [robot_message("<robot")]}, {"urdf": None}, "not a URDF"),
    "nothing moves": ({}, {"hand_frame": "base"}, "no movable joint lies between"),
    "empty names": (
        {"joints": [joint_message(START_NS, (), ())]},
        {},
        "holds no joint positions",
    ),
    "several joint topics": (
        {"more": [joint_message(START_NS, ("x",), (0.0,), "/other")]},
        {},
        "several topics for joints: /joint_states, /other; choose one with --joints",
    ),
    "several infos": (
        {
            "info": [info_message(topic="/a/info"), info_message(topic="/b/info")],
        },
        {"camera": None},
        "several topics for info: /a/info, /b/info; choose one with --info",
    ),
    "several robots": (
        {"more": [robot_message("<robot/>", "/left/robot_description")]},
        {"urdf": None},
        "several robot descriptions",
    ),
}


@pytest.mark.parametrize("case", MISSING)
def test_what_is_missing_is_named(case: str, tmp_path: Path) -> None:
    parts, changes, expected = MISSING[case]
    message = refused(tmp_path, {**wrist_parts(2), **parts}, replace(RIG, **changes))
    assert expected in message
    assert str(tmp_path / "a.mcap") in message
    assert "\n" not in message


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_joint_that_is_never_finite_is_named(value: float, tmp_path: Path) -> None:
    parts = wrist_parts(3)
    parts["joints"] = [
        joint_message(stamp, JOINTS, (0.1, value))
        for stamp in range(START_NS, stamp_of(4), 10_000_000)
    ]
    message = refused(tmp_path, parts)
    assert "no usable sample of joint wrist_roll" in message
    assert "positions of joint wrist_roll are not finite" in message


def test_clocks_that_do_not_overlap_are_shown(tmp_path: Path) -> None:
    parts = wrist_parts(3)
    parts["joints"] = [joint_message(10**9 + stamp, JOINTS, (0.1, 0.2)) for stamp in (0, 10**7)]
    message = refused(tmp_path, parts)
    assert "images run from 1700000000.173 to 1700000000.240 s" in message
    assert "samples from 1.000 to 1.010 s" in message
    assert "check the clocks" in message


def test_a_single_joint_sample_bridges_nothing(tmp_path: Path) -> None:
    parts = wrist_parts(3)
    parts["joints"] = [joint_message(stamp_of(1) + 5, JOINTS, (0.1, 0.2))]
    assert "no image falls between two samples of" in refused(tmp_path, parts)
    parts["joints"] = [joint_message(stamp_of(1), JOINTS, (0.1, 0.2))]
    assert views_of(tmp_path / "hit", parts).known.tolist() == [False, True, False]


def test_the_camera_frame_defaults_to_the_images(tmp_path: Path) -> None:
    views = views_of(tmp_path, wrist_parts(3), replace(RIG, camera_frame=None))
    assert_true_poses(views)


def test_irrelevant_topics_do_not_matter(tmp_path: Path) -> None:
    parts = wrist_parts(3)
    parts["more"] = posed_parts(2, frame="a", topic="/goal")["poses"]
    parts["noise"] = [
        Message("/chatter", messages.STRING, START_NS, messages.string("hello")),
        Message(f"{JOINT_TOPIC}_text", messages.STRING, START_NS, messages.string("")),
    ]
    assert_true_poses(views_of(tmp_path, parts))


def test_a_mapped_name_no_longer_stands_for_itself(tmp_path: Path) -> None:
    parts = wrist_parts(4)
    parts["joints"] = [
        joint_message(stamp, JOINTS[1:], angles(stamp)[1:])
        for stamp in range(START_NS, stamp_of(6), 10_000_000)
    ]
    message = refused(tmp_path, parts, replace(RIG, joints={JOINTS[1]: JOINTS[0]}))
    assert f"lacks {JOINTS[1]}, which lie between camera and hand" in message
