"""The observer reads along and finds the poses that reading the log finds afterwards."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest

from tests.helpers.logs import JOINT_TOPIC, Log, angles, wrist_parts
from tests.helpers.robot import RIG, camera_from_hand
from tooltip_cli.log import messages
from tooltip_cli.log.messages import Message
from tooltip_cli.log.recording import read_recording
from tooltip_cli.log.views import resolve_rig, resolve_views
from tooltip_cli.method.voting.params import VotingSettings
from tooltip_cli.rig.kinematics import Mount, quaternion_from_rotation
from tooltip_cli.rig.rigfile import Rig
from tooltip_cli.stages.voting import pair_views
from tooltip_cli.stages.watching import MotionObserver


def in_order() -> list[Message]:
    parts = wrist_parts()
    return sorted(itertools.chain(*parts.values()), key=lambda message: message.log_time_ns)


@pytest.mark.parametrize(
    "rig",
    [RIG, replace(RIG, urdf=None, camera=None), replace(RIG, camera_frame=None)],
    ids=["rig alone", "robot and camera from the log", "frame from the images"],
)
def test_it_counts_the_frames_that_an_estimate_would_use(rig: Rig, wrist: Log) -> None:
    observer = MotionObserver(rig)
    for message in in_order():
        observer.take(message)
    verdict = observer.verdict(now=True)
    recording = read_recording(wrist.path)
    views = resolve_views(recording, resolve_rig(recording, None))
    pairing, _ = pair_views(views, VotingSettings(), views.known)
    assert not observer.problem
    assert verdict is not None
    assert verdict.frames == len(pairing.frames) > 10
    assert not observer.ample


def test_poses_in_place_of_joints_give_the_same(wrist: Log) -> None:
    rig = replace(RIG, urdf=None, pose_topic="/tracker", mount=Mount("base"))
    observer, joints = MotionObserver(rig), MotionObserver(RIG)
    for message in in_order():
        joints.take(message)
        if message.topic != JOINT_TOPIC:
            observer.take(message)
            continue
        pose = camera_from_hand(*angles(message.log_time_ns))
        quaternion = quaternion_from_rotation(pose[:3, :3]).tolist()
        payload = messages.pose_stamped(
            message.log_time_ns, "base", pose[:3, 3].tolist(), quaternion
        )
        observer.take(Message("/tracker", messages.POSE_STAMPED, message.log_time_ns, payload))
    by_pose, by_joints = observer.verdict(now=True), joints.verdict(now=True)
    assert not observer.problem
    assert by_pose is not None
    assert by_joints is not None
    assert by_pose.frames == by_joints.frames
    assert abs(by_pose.view_deg - by_joints.view_deg) < 0.1


@pytest.mark.parametrize(
    ("rig", "problem"),
    [
        (replace(RIG, camera=None), "no intrinsics"),
        (replace(RIG, urdf=None), "no robot description"),
        (replace(RIG, pose_topic="/tracker", mount=None), "needs camera.mount"),
    ],
)
def test_what_is_missing_for_a_verdict_is_named(rig: Rig, problem: str) -> None:
    observer = MotionObserver(rig)
    for message in wrist_parts()["images"]:
        observer.take(message)
    assert observer.verdict(now=True) is None
    assert problem in observer.problem


def test_joints_that_never_come_leave_the_verdict_open() -> None:
    observer = MotionObserver(RIG)
    for message in wrist_parts()["images"]:
        observer.take(message)
    verdict = observer.verdict(now=True)
    assert verdict is not None
    assert verdict.code == "waiting"


def test_a_rig_that_does_not_fit_is_reported_once() -> None:
    observer = MotionObserver(replace(RIG, hand_frame="elbow"))
    for message in in_order():
        observer.take(message)
    assert "unknown hand frame 'elbow'" in observer.problem
    assert observer.verdict(now=True) is None


def test_messages_that_are_none_do_not_stop_the_recording() -> None:
    observer = MotionObserver(RIG)
    first = wrist_parts()["joints"][0]
    observer.take(wrist_parts()["images"][0])
    observer.take(replace(first, payload=first.payload[:9]))
    assert "carries no sensor_msgs/msg/JointState" in observer.problem
