"""The observer reads along and finds the poses that reading the log finds afterwards."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest

from tests.helpers.logs import Log, wrist_parts
from tests.helpers.robot import RIG
from tooltip_cli.log.messages import Message
from tooltip_cli.log.recording import read_recording
from tooltip_cli.log.views import resolve_rig, resolve_views
from tooltip_cli.method.voting.params import VotingSettings
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
