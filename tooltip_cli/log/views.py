"""What a recording and a rig say together: where the camera was, seen from the hand."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from tooltip_cli.errors import TooltipError
from tooltip_cli.log.recording import JointTrack, Recording
from tooltip_cli.log.sync import bracket, interpolate, interpolate_poses
from tooltip_cli.rig.camera import CameraModel
from tooltip_cli.rig.kinematics import (
    KinematicChain,
    Mount,
    inverse_transform,
    rotation_from_quaternion,
)
from tooltip_cli.rig.rigfile import Rig, Sphere, load_rig, parse_rig

Array = npt.NDArray[np.float64]
Stamps = npt.NDArray[np.int64]

CORRECTED = "_corrected"
"""Added to a camera frame's name where its pose is put right."""

MAX_GAP_NS = 100_000_000
"""Longest gap between joint samples that is bridged: a wrist turns some degrees in 0.1 s."""

STORED_RIG = "attachment rig.yaml"  # how the source of a rig ends that the recording carries


@dataclass(frozen=True)
class Views:
    """The camera's pose in the hand frame at every image of a recording."""

    camera: CameraModel
    stamps_ns: Stamps  # (N,) image stamps as logged
    hand_from_camera: Array  # (N, 4, 4), T_c of the paper; NaN where the hand's pose is unknown
    spheres: tuple[Sphere, ...]  # the hand and wrist, hand frame, metres
    root_from_camera: Array  # (N, 3, 3) how the camera is turned; joints that camera and hand hang
    # on together count as still

    @property
    def known(self) -> npt.NDArray[np.bool_]:
        """(N,) whether the hand's pose is known at each image."""
        return np.asarray(np.isfinite(self.hand_from_camera).all(axis=(1, 2)))


def resolve_rig(recording: Recording, rig_path: Path | None) -> Rig:
    """Return the rig to use: the given file's, or the one stored in the recording.

    Raises:
        TooltipError: neither exists, or it is malformed.
    """
    if rig_path is not None:
        return load_rig(rig_path)
    stored = recording.attachments
    if "rig.yaml" not in stored:
        raise TooltipError(
            f"{recording.path} carries no rig; name the rig file with --rig (it says which frame "
            "is the hand and where the camera sits)"
        )

    def read(name: str) -> str:
        if name not in stored:
            raise TooltipError(f"{recording.path}: the stored rig names '{name}', which is missing")
        return _text(stored[name], f"{recording.path}: attachment {name}")

    return parse_rig(read("rig.yaml"), read, f"{recording.path}: {STORED_RIG}")


def _text(data: bytes, source: str) -> str:
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise TooltipError(f"{source}: not UTF-8 text") from error


def resolve_camera(recording: Recording, rig: Rig) -> CameraModel:
    """Return the intrinsics: the rig's camera file, else the log's CameraInfo.

    Raises:
        TooltipError: neither exists, or the log says that the camera is not calibrated.
    """
    camera = rig.camera or recording.camera
    if camera is None:
        raise TooltipError(
            recording.unusable.get("info")
            or f"{recording.path}: the camera is not calibrated (no CameraInfo, or k[0] is 0); "
            "name a camera file under camera.info in the rig file"
        )
    return camera


def resolve_views(recording: Recording, rig: Rig) -> Views:
    """Find the camera's pose in the hand frame at every image.

    Image stamps are shifted by the rig's time offset before the joints are looked up.

    Raises:
        TooltipError: the log lacks joints or poses, joints that the chain needs, or overlap in
            time; the images have another size than the intrinsics.
    """
    camera = resolve_camera(recording, rig)
    _check_image_size(recording, camera)
    query = recording.image_stamps_ns + round(rig.time_offset_s * 1e9)
    pose_topic = recording.pose_topic or rig.pose_topic
    if pose_topic is not None:
        transforms = _from_poses(recording, rig, pose_topic, query)
        turned = np.tile(
            np.eye(3), (len(query), 1, 1)
        )  # the mount's parent is where poses are from
    else:
        transforms, root_from_camera = _from_joints(recording, rig, query)
        turned = root_from_camera[:, :3, :3]
    return Views(camera, recording.image_stamps_ns, transforms, rig.spheres, turned)


def corrected_rig(
    recording: Recording, rig: Rig, time_offset_s: float, corrected_from_camera: Array | None
) -> Rig:
    """Return a rig with clocks and camera put right.

    Args:
        time_offset_s: to add to image stamps, besides what the rig adds.
        corrected_from_camera: (4, 4), or None: the camera is where the rig says.
    """
    rig = replace(rig, time_offset_s=rig.time_offset_s + time_offset_s)
    if corrected_from_camera is None:
        return rig
    inverse = inverse_transform(corrected_from_camera)
    if rig.mount is not None:
        mount = Mount.at(rig.mount.parent, rig.mount.parent_from_camera @ inverse)
        return replace(rig, mount=mount)
    frame = rig.camera_frame or recording.image_frame
    return replace(rig, camera_frame=frame + CORRECTED, mount=Mount.at(frame, inverse))


def _check_image_size(recording: Recording, camera: CameraModel) -> None:
    height, width = next(recording.images([0], gray=True)).shape
    if (width, height) != (camera.width, camera.height):
        raise TooltipError(
            f"{recording.path}: images are {width}x{height} but the intrinsics are for "
            f"{camera.width}x{camera.height}; calibrate at the recorded size, or scale the camera "
            "file to it"
        )


def _from_joints(recording: Recording, rig: Rig, query_ns: Stamps) -> tuple[Array, Array]:
    chain = resolve_chain(recording, rig)
    if not recording.joints:
        raise TooltipError(
            recording.unusable.get("joints")
            or f"{recording.path} holds no joint positions (sensor_msgs/msg/JointState), so the "
            "hand's pose is unknown; if it logs poses, name them under hand.pose_topic in the rig "
            "file"
        )
    tracks = urdf_tracks(recording, rig)
    _check_joints(recording, rig, chain.joint_names, tracks)
    needed = {name: tracks[name] for name in chain.joint_names}
    _check_overlap(
        recording, rig, {f"joint {name}": track.stamps_ns for name, track in needed.items()}
    )
    positions = [
        interpolate(track.stamps_ns, track.positions, query_ns, MAX_GAP_NS)
        for track in needed.values()
    ]
    return chain.camera_poses(np.stack(positions, axis=1))


def urdf_tracks(recording: Recording, rig: Rig) -> dict[str, JointTrack]:
    """Return the logged joints by their names in the URDF."""
    # a name that the rig maps stands for the URDF's joint alone
    tracks = {name: track for name, track in recording.joints.items() if name not in rig.joints}
    for logged, name in rig.joints.items():
        if logged in recording.joints:
            tracks[name] = recording.joints[logged]
    return tracks


def resolve_urdf(recording: Recording, rig: Rig) -> tuple[str, str]:
    """Return the robot description, the rig's or else the log's, and what to call it.

    Raises:
        TooltipError: there is none.
    """
    if rig.urdf is not None:
        return rig.urdf, rig.source
    if recording.urdf is None:
        raise TooltipError(
            recording.unusable.get("robot")
            or f"{recording.path} has no /robot_description; name the URDF under 'robot' in "
            f"{rig.source}"
        )
    return recording.urdf, f"{recording.path}: /robot_description"


def resolve_chain(recording: Recording, rig: Rig) -> KinematicChain:
    """Return the chain from the camera to the hand, by the rig's URDF or else the log's.

    Raises:
        TooltipError: there is none, or it lacks a frame.
    """
    urdf, source = resolve_urdf(recording, rig)
    camera_frame = rig.camera_frame or recording.image_frame
    return KinematicChain.from_urdf(urdf, camera_frame, rig.hand_frame, rig.mount, source)


def _check_joints(
    recording: Recording, rig: Rig, needed: Sequence[str], known: Container[str]
) -> None:
    missing = [name for name in needed if name not in known]
    if not missing:
        return
    text = (
        f"{recording.path}: {recording.joint_topic} lacks {', '.join(missing)}, which lie between "
        f"camera and hand; logged: {', '.join(sorted(recording.joints))}"
    )
    unknown = [name for name in rig.joints if name not in recording.joints]
    if unknown:
        text += f"; 'joints' in {rig.source} maps names that are not logged: {', '.join(unknown)}"
    raise TooltipError(text + "; map other names under 'joints' in the rig file")


def _from_poses(recording: Recording, rig: Rig, topic: str, query_ns: Stamps) -> Array:
    poses = recording.poses.get(topic)
    if poses is None:
        known = ", ".join(sorted(recording.poses)) or "none"
        raise TooltipError(
            recording.unusable.get(topic)
            or f"{recording.path} has no geometry_msgs/msg/PoseStamped on {topic}, which "
            f"{rig.source} names under hand.pose_topic; logged: {known}"
        )
    if rig.mount is None:
        raise TooltipError(
            f"{rig.source}: with hand.pose_topic the camera needs camera.mount, its pose in the "
            f"frame of the poses ('{poses.frame_id}')"
        )
    if rig.mount.parent != poses.frame_id:
        raise TooltipError(
            f"{rig.source}: camera.mount.parent is '{rig.mount.parent}', but the poses on "
            f"{topic} are given in '{poses.frame_id}'"
        )
    _check_overlap(recording, rig, {topic: poses.stamps_ns})
    positions, quaternions = interpolate_poses(
        poses.stamps_ns, poses.positions, poses.quaternions, query_ns, MAX_GAP_NS
    )
    base_from_hand = np.tile(np.eye(4), (len(query_ns), 1, 1))
    base_from_hand[:, :3, :3] = rotation_from_quaternion(quaternions)
    base_from_hand[:, :3, 3] = positions
    return inverse_transform(base_from_hand) @ rig.mount.parent_from_camera


def _check_overlap(recording: Recording, rig: Rig, streams: Mapping[str, Stamps]) -> None:
    """Refuse streams that leave the hand's pose unknown at every image."""
    empty = [name for name, stamps_ns in streams.items() if not len(stamps_ns)]
    if empty:
        raise TooltipError(
            f"{recording.path}: no usable sample of {', '.join(empty)}; "
            + "; ".join([*recording.notes, "check what publishes it, and record again"])
        )
    query_ns = recording.image_stamps_ns + round(rig.time_offset_s * 1e9)
    known = np.ones(len(query_ns), dtype=bool)
    for stamps_ns in streams.values():
        known &= bracket(stamps_ns, query_ns, MAX_GAP_NS)[2]
    if known.any():
        return
    first = max(stamps_ns[0] for stamps_ns in streams.values())
    last = min(stamps_ns[-1] for stamps_ns in streams.values())
    offset = f" after the time offset of {rig.time_offset_s} s" if rig.time_offset_s else ""
    raise TooltipError(
        f"{recording.path}: no image falls between two samples of {', '.join(streams)} that are at "
        f"most {MAX_GAP_NS / 1e9} s apart: images run from {query_ns[0] / 1e9:.3f} to "
        f"{query_ns[-1] / 1e9:.3f} s{offset}, samples from {first / 1e9:.3f} to {last / 1e9:.3f} "
        "s; check the clocks, or set time_offset in the rig file"
    )
