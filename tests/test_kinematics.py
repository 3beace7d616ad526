"""The chain from camera to hand against a product of transforms written out here."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers import refusal
from tests.helpers.robot import (
    CAMERA_FRAME,
    HAND_FRAME,
    JOINTS,
    LIMIT,
    URDF,
    camera_from_hand,
)
from tooltip_cli.errors import TooltipError
from tooltip_cli.rig.kinematics import (
    KinematicChain,
    Mount,
    inverse_transform,
    rotation_from_quaternion,
    rotation_from_rpy,
)

Array = npt.NDArray[np.float64]
Vector = tuple[float, float, float]
_HERE = np.eye(4)


@dataclass(frozen=True)
class Joint:
    """One joint of a made-up robot."""

    name: str
    kind: str
    parent: str
    child: str
    xyz: Vector = (0.0, 0.0, 0.0)
    rpy: Vector = (0.0, 0.0, 0.0)
    axis: Vector = (0.0, 0.0, 1.0)
    mimic: tuple[str, float, float] | None = None  # joint, multiplier, offset

    def xml(self) -> str:
        def numbers(values: Vector) -> str:
            return " ".join(map(repr, values))

        follows = ""
        if self.mimic:
            name, multiplier, offset = self.mimic
            follows = f'<mimic joint="{name}" multiplier="{multiplier}" offset="{offset}"/>'
        return (
            f'<joint name="{self.name}" type="{self.kind}"><parent link="{self.parent}"/>'
            f'<child link="{self.child}"/><origin xyz="{numbers(self.xyz)}" '
            f'rpy="{numbers(self.rpy)}"/><axis xyz="{numbers(self.axis)}"/>{LIMIT}{follows}</joint>'
        )

    def transform(self, values: dict[str, float]) -> Array:
        """Return (4, 4) parent_from_child."""
        if self.mimic:
            name, multiplier, offset = self.mimic
            value = multiplier * values[name] + offset
        else:
            value = values.get(self.name, 0.0)
        axis = np.array(self.axis) / np.linalg.norm(self.axis)
        moved = np.eye(4)
        if self.kind in ("revolute", "continuous"):
            moved[:3, :3] = rodrigues(axis, value)
        elif self.kind == "prismatic":
            moved[:3, 3] = axis * value
        origin = np.eye(4)
        roll, pitch, yaw = self.rpy
        origin[:3, :3] = (
            rodrigues(np.array([0, 0, 1.0]), yaw)
            @ rodrigues(np.array([0, 1.0, 0]), pitch)
            @ rodrigues(np.array([1.0, 0, 0]), roll)
        )
        origin[:3, 3] = self.xyz
        return np.asarray(origin @ moved)


def rodrigues(axis: Array, angle: float) -> Array:
    """Return the (3, 3) rotation about a unit axis."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def urdf_of(joints: list[Joint]) -> str:
    links = dict.fromkeys(itertools.chain(*((j.parent, j.child) for j in joints)))
    body = "".join(f'<link name="{link}"/>' for link in links)
    return f'<robot name="r">{body}{"".join(joint.xml() for joint in joints)}</robot>'


def base_from(link: str, joints: list[Joint], values: dict[str, float]) -> Array:
    """Return (4, 4) base_from_link by walking up to the base."""
    transform = np.eye(4)
    by_child = {joint.child: joint for joint in joints}
    while link in by_child:
        joint = by_child[link]
        transform = joint.transform(values) @ transform
        link = joint.parent
    return transform


def expected(
    camera: str,
    hand: str,
    joints: list[Joint],
    values: dict[str, float],
    mount: Array | None = None,
) -> Array:
    base_from_camera = base_from(camera, joints, values) @ (np.eye(4) if mount is None else mount)
    return np.asarray(np.linalg.inv(base_from(hand, joints, values)) @ base_from_camera)


numbers = st.floats(-2.0, 2.0)
vectors = st.tuples(numbers, numbers, numbers)
axes = vectors.filter(lambda axis: float(np.linalg.norm(axis)) > 0.1)
kinds = st.sampled_from(["revolute", "continuous", "prismatic", "fixed"])


@st.composite
def robots(draw: st.DrawFn) -> list[Joint]:
    """Draw a tree: a head that ends in the camera and an arm that ends in the hand."""
    joints: list[Joint] = []
    for name, end in (("head", "camera"), ("arm", "hand")):
        parent = "base"
        length = draw(st.integers(1, 4))
        for number in range(length):
            child = end if number == length - 1 else f"{name}{number}"
            kind = "revolute" if (name, number) == ("arm", 0) else draw(kinds)
            joints.append(
                Joint(
                    f"{name}_joint{number}",
                    kind,
                    parent,
                    child,
                    draw(vectors),
                    draw(vectors),
                    draw(axes),
                )
            )
            parent = child
    return joints


@settings(max_examples=60, deadline=None)
@given(joints=robots(), data=st.data())
def test_any_tree_equals_the_product_of_its_transforms(
    joints: list[Joint], data: st.DataObject
) -> None:
    chain = KinematicChain.from_urdf(urdf_of(joints), "camera", "hand", None, "test")
    movable = [joint.name for joint in joints if joint.kind != "fixed"]
    assert sorted(chain.joint_names) == sorted(movable)
    values = {name: data.draw(st.floats(-4.0, 4.0)) for name in movable}
    found = chain.hand_from_camera([[values[name] for name in chain.joint_names]])[0]
    assert np.abs(found - expected("camera", "hand", joints, values)).max() < 1e-9


def test_the_wrist_equals_its_hand_written_kinematics() -> None:
    chain = KinematicChain.from_urdf(URDF, CAMERA_FRAME, HAND_FRAME, None, "test")
    assert chain.joint_names == JOINTS  # not the gripper, which lies behind the hand
    configurations = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 2))
    for found, (pitch, roll) in zip(
        chain.hand_from_camera(configurations), configurations, strict=True
    ):
        assert np.abs(found @ camera_from_hand(pitch, roll) - np.eye(4)).max() < 1e-12


ARM = [
    Joint("lift", "prismatic", "base", "lifted", (0.1, 0.0, 0.2), (0.3, 0.1, -0.4), (0, 0.6, 0.8)),
    Joint("turn", "continuous", "lifted", "turned", (0.0, 0.1, 0.0), (0.0, 0.5, 0.0), (1, 1, 0)),
    Joint("bracket", "fixed", "turned", "plate", (0.02, 0.03, 0.04), (0.1, 0.2, 0.3)),
    Joint("bend", "revolute", "plate", "hand", (0.2, 0.0, 0.0), (0.0, 0.0, 1.0), (0, 0, 2)),
    Joint("finger", "revolute", "hand", "finger"),
    Joint("head", "revolute", "base", "head"),
]


def test_continuous_prismatic_and_fixed_joints() -> None:
    chain = KinematicChain.from_urdf(urdf_of(ARM), "base", "hand", None, "test")
    assert chain.joint_names == ("lift", "turn", "bend")
    for values in (
        {"lift": 0.2, "turn": 7.0, "bend": -1.0},
        {"lift": -0.1, "turn": -3.5, "bend": 0.5},
    ):
        found = chain.hand_from_camera([list(values.values())])[0]
        assert np.abs(found - expected("base", "hand", ARM, values)).max() < 1e-12


def test_joints_above_both_frames_do_not_matter() -> None:
    torso = [
        Joint("torso", "revolute", "pelvis", "base"),
        *ARM,
    ]
    chain = KinematicChain.from_urdf(urdf_of(torso), "head", "hand", None, "test")
    assert set(chain.joint_names) == {"lift", "turn", "bend", "head"}


@pytest.mark.parametrize("kind", ["revolute", "continuous", "prismatic"])
def test_a_mimic_joint_follows_its_leader(kind: str) -> None:
    joints = [
        Joint("leader", kind, "base", "middle", (0.1, 0.2, 0.3), axis=(0, 1, 0)),
        Joint("follower", kind, "middle", "hand", (0.0, 0.1, 0.0), mimic=("leader", -1.5, 0.25)),
    ]
    chain = KinematicChain.from_urdf(urdf_of(joints), "base", "hand", None, "test")
    assert chain.joint_names == ("leader",)
    for value in (-0.7, 0.0, 1.2):
        found = chain.hand_from_camera([[value]])[0]
        assert np.abs(found - expected("base", "hand", joints, {"leader": value})).max() < 1e-12


def test_the_leader_of_a_mimic_joint_may_lie_outside_the_chain() -> None:
    joints = [
        Joint("finger", "revolute", "base", "finger"),
        Joint("wrist", "revolute", "base", "hand", (0.1, 0.0, 0.0), mimic=("finger", 2.0, 0.1)),
    ]
    chain = KinematicChain.from_urdf(urdf_of(joints), "base", "hand", None, "test")
    assert chain.joint_names == ("finger",)
    found = chain.hand_from_camera([[0.4]])[0]
    assert np.abs(found - expected("base", "hand", joints, {"finger": 0.4})).max() < 1e-12


def test_a_mounted_camera_needs_no_frame_in_the_urdf() -> None:
    mount = Mount("head", (0.01, -0.02, 0.03), (-1.5, 0.2, -1.6))
    joints = ARM[:4] + ARM[5:]
    chain = KinematicChain.from_urdf(urdf_of(joints), "any_name", "hand", mount, "test")
    values = {"lift": 0.1, "turn": 0.2, "bend": 0.3, "head": 0.4}
    parent_from_camera = Joint("m", "fixed", "", "", mount.xyz, mount.rpy).transform({})
    assert np.abs(mount.parent_from_camera - parent_from_camera).max() < 1e-12
    found = chain.hand_from_camera([[values[name] for name in chain.joint_names]])[0]
    assert (
        np.abs(found - expected("head", "hand", joints, values, parent_from_camera)).max() < 1e-12
    )


def test_an_unknown_position_makes_one_unknown_transform() -> None:
    chain = KinematicChain.from_urdf(URDF, CAMERA_FRAME, HAND_FRAME, None, "test")
    found = chain.hand_from_camera([[0.1, 0.2], [np.nan, 0.2], [0.1, np.inf], [0.1, 0.2]])
    assert np.isnan(found[1:3]).all()
    assert np.array_equal(found[0], found[3])
    assert np.isfinite(found[0]).all()
    assert chain.hand_from_camera(np.zeros((0, 2))).shape == (0, 4, 4)


@settings(max_examples=50)
@given(rpy=vectors)
def test_fixed_axis_angles_are_three_rotations(rpy: Vector) -> None:
    rotation = Joint("", "fixed", "", "", rpy=rpy).transform({})[:3, :3]
    assert np.abs(rotation_from_rpy(rpy) - rotation).max() < 1e-12


@settings(max_examples=50)
@given(axis=axes, angle=st.floats(-6.0, 6.0), scale=st.floats(0.1, 10.0))
def test_quaternions_are_rotations(axis: Vector, angle: float, scale: float) -> None:
    unit = np.array(axis) / np.linalg.norm(axis)
    quaternion = np.array([*(unit * np.sin(angle / 2)), np.cos(angle / 2)]) * scale
    assert np.abs(rotation_from_quaternion(quaternion) - rodrigues(unit, angle)).max() < 1e-12
    assert np.abs(rotation_from_quaternion(-quaternion) - rodrigues(unit, angle)).max() < 1e-12


@settings(max_examples=50)
@given(xyz=vectors, rpy=vectors)
def test_the_inverse_undoes_a_transform(xyz: Vector, rpy: Vector) -> None:
    transform = Joint("", "fixed", "", "", xyz, rpy).transform({})
    stack = np.stack([transform, np.eye(4)])
    assert np.abs(inverse_transform(stack) @ stack - np.eye(4)).max() < 1e-12


def robot(body: str) -> str:
    return f'<robot name="r"><link name="base"/><link name="hand"/>{body}</robot>'


def joint(**changes: str) -> str:
    """Return a robot whose one joint has parts replaced."""
    parts = {
        "type": "revolute",
        "parent": '<parent link="base"/>',
        "child": '<child link="hand"/>',
        "origin": '<origin xyz="0 0 1"/>',
        "axis": '<axis xyz="0 0 1"/>',
        "limit": LIMIT,
        **changes,
    }
    kind = parts.pop("type")
    return robot(f'<joint name="j" type="{kind}">{"".join(parts.values())}</joint>')


GOOD = joint()
BROKEN: dict[str, tuple[str, str]] = {
    "empty": ("", "not a URDF"),
    "spaces": (" \n ", "not a URDF"),
    "text": ("a robot", "not a URDF"),
    "html": ("<html><body/></html>", "not a URDF"),
    "truncated": (GOOD[:-30], "not a URDF"),
    "nul": (GOOD.replace("hand", "ha\0nd"), "not a URDF"),
    "deep": ("<a>" * 100_000, "not a URDF"),
    "deep robot": ('<robot name="r">' + "<link>" * 100_000, "not a URDF"),
    "long": ("x" * (33 * 2**20), "too many to be one"),
    "doctype": ("<!DOCTYPE robot>" + GOOD, "document type"),
    "entities": ('<!DOCTYPE r [<!ENTITY a "b">]>' + GOOD, "document type"),
    "external entity": (
        '<!doctype r [<!ENTITY a SYSTEM "file:///etc/passwd">]>' + GOOD,
        "document type",
    ),
    "two roots": (robot(""), "not a URDF"),
    "same link twice": (GOOD.replace("<joint", '<link name="hand"/><joint', 1), "not a URDF"),
    "no such parent": (joint(parent='<parent link="nobody"/>'), "not a URDF"),
    "no axis numbers": (joint(axis='<axis xyz="a b c"/>'), "not a URDF"),
    "origin is no number": (joint(origin='<origin xyz="nan 0 0"/>'), "not a URDF"),
    "origin without end": (joint(origin='<origin xyz="inf 0 0"/>'), "not a URDF"),
    "origin beyond reach": (joint(origin='<origin xyz="1e300 0 0"/>'), "no robot has"),
    "axis of no length": (joint(axis='<axis xyz="0 0 0"/>'), "no robot has"),
    "no limits": (joint(limit=""), "not a URDF"),
    "unknown type": (joint(type="elastic"), "not a URDF"),
    "floating": (joint(type="floating"), "6 degrees of freedom"),
    "planar": (joint(type="planar"), "3 degrees of freedom"),
    "fixed": (joint(type="fixed"), "no movable joint lies between"),
    "mimics nobody": (joint(mimic='<mimic joint="nobody"/>'), "not a URDF"),
    "mimics itself": (joint(mimic='<mimic joint="j"/>'), "not a URDF"),
    "cycle": (
        GOOD.replace(
            "</robot>",
            f'<joint name="k" type="revolute"><parent link="hand"/><child link="base"/>{LIMIT}'
            "</joint></robot>",
        ),
        "not a URDF",
    ),
}


@pytest.mark.parametrize(("urdf", "text"), BROKEN.values(), ids=BROKEN.keys())
def test_broken_robots_are_refused_in_one_line(
    urdf: str, text: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(TooltipError) as caught:
        KinematicChain.from_urdf(urdf, "base", "hand", None, "arm.urdf")
    message = str(caught.value)
    assert message.startswith("arm.urdf: ")
    assert text in message
    assert "\n" not in message
    assert len(message) < 500
    assert capfd.readouterr().err == ""  # the C++ parser would print there


def test_a_good_robot_is_read_after_spaces_and_a_declaration() -> None:
    chain = KinematicChain.from_urdf(
        f'\n  <?xml version="1.0"?>\n{GOOD}', "base", "hand", None, "arm.urdf"
    )
    assert chain.joint_names == ("j",)


@pytest.mark.parametrize(
    ("camera", "hand", "mount", "text"),
    [
        ("eye", HAND_FRAME, None, "unknown camera frame 'eye'; known: base, camera_optical_frame"),
        ("", HAND_FRAME, None, "unknown camera frame ''"),
        (CAMERA_FRAME, "palm", None, "unknown hand frame 'palm'; known: base,"),
        ("eye", HAND_FRAME, Mount("neck"), "unknown camera frame 'neck'"),
        # a joint's name is a frame to Pinocchio, but not to a URDF's user
        (CAMERA_FRAME, "wrist_roll", None, "unknown hand frame 'wrist_roll'"),
        (CAMERA_FRAME, "universe", None, "unknown hand frame 'universe'"),
        (CAMERA_FRAME, "base", None, "no movable joint lies between"),
        (HAND_FRAME, HAND_FRAME, None, "no movable joint lies between"),
    ],
)
def test_frames_that_cannot_be_used(camera: str, hand: str, mount: Mount | None, text: str) -> None:
    with pytest.raises(TooltipError) as caught:
        KinematicChain.from_urdf(URDF, camera, hand, mount, "arm.urdf")
    assert text in str(caught.value)


@settings(max_examples=100, deadline=None)
@given(cut=st.integers(0, len(URDF) - 1), insert=st.text(max_size=3))
def test_damaged_urdf_is_read_or_refused(cut: int, insert: str) -> None:
    text = URDF[:cut] + insert + URDF[cut + 1 :]
    message = refusal(
        lambda: KinematicChain.from_urdf(text, CAMERA_FRAME, HAND_FRAME, None, "arm.urdf")
    )
    assert message is None or message.startswith("arm.urdf")


def test_the_camera_is_seen_from_the_root_too() -> None:
    joints = [Joint("neck", "revolute", "base", "head", (0.0, 0.1, 0.4), axis=(0, 1, 0)), *ARM[:4]]
    chain = KinematicChain.from_urdf(urdf_of(joints), "head", "hand", None, "test")
    values = {"lift": 0.1, "turn": 0.2, "bend": 0.3}
    rows = [[{**values, "neck": neck}[name] for name in chain.joint_names] for neck in (0.0, 0.3)]
    from_hand, from_root = chain.camera_poses([*rows, [np.nan] * 4])
    assert np.isnan(from_root[2]).all()
    for row, neck in enumerate((0.0, 0.3)):
        there = expected("head", "base", joints, {**values, "neck": neck})
        assert np.abs(from_root[row] - there).max() < 1e-12
    # the hand stays where it is, seen from the root
    hands = from_root[:2] @ np.linalg.inv(from_hand[:2])
    assert np.abs(hands[0] - hands[1]).max() < 1e-12
