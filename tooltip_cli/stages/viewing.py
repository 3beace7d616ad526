"""One file for viewing: recording, detections and estimate, with transforms and a scene."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tooltip_cli.labels.files import match_labels, read_labels
from tooltip_cli.log import messages
from tooltip_cli.log.annotations import BLACK, GREEN, WHITE, YELLOW, Color, cross, rings
from tooltip_cli.log.container import LoggedAttachment, LoggedMessage, iterate
from tooltip_cli.log.messages import Message
from tooltip_cli.log.scene import (
    caption,
    ellipsoid,
    entity,
    scene_message,
    segments,
    sphere,
    transform_message,
)
from tooltip_cli.log.sync import interpolate
from tooltip_cli.log.views import MAX_GAP_NS, resolve_urdf, urdf_tracks
from tooltip_cli.log.whole import check_absent
from tooltip_cli.log.writer import LogWriter
from tooltip_cli.method.types import Array
from tooltip_cli.rig.kinematics import inverse_transform
from tooltip_cli.rig.rigfile import rig_files
from tooltip_cli.rig.tool_tip import TIP_LINK
from tooltip_cli.rig.tree import KinematicTree
from tooltip_cli.stages.artifacts import find_artifact
from tooltip_cli.stages.detect import Detected, detect_in
from tooltip_cli.stages.estimate import estimation_input
from tooltip_cli.stages.export import Result
from tooltip_cli.stages.held_out import LABELS_SUFFIX
from tooltip_cli.stages.near import near_unless

PREDICTION_TOPIC = "/tooltip/prediction_annotations"
LABEL_TOPIC = "/tooltip/label_annotations"
SCENE_TOPIC = "/tooltip/scene"
_OWN = "/tooltip/"
_RAYS = 200  # at most, evenly spread
_RAY_BEYOND_M = 0.05  # a ray is drawn so far past the tip
_RAY_LENGTH_M = 0.6  # where no tip is known
_DEVIATIONS = 2.0  # standard deviations that the tip's ellipsoid shows
_RAY_COLOR: Color = {"r": 0.3, "g": 0.6, "b": 1.0, "a": 0.25}
_HAND_COLOR: Color = {"r": 0.6, "g": 0.6, "b": 0.6, "a": 0.2}
_TIP_COLOR: Color = {**GREEN, "a": 0.6}
_CANDIDATE_COLOR: Color = {"r": 1.0, "g": 0.5, "b": 0.0, "a": 0.5}
_CANDIDATE_RADIUS_M = 0.008


@dataclass
class Exported:
    """What went into the file."""

    path: Path
    topics: dict[str, int] = field(default_factory=dict)  # messages
    detected: Detected | None = None
    notes: list[str] = field(default_factory=list)


def export_log(
    result: Result,
    path: Path,
    *,
    overwrite: bool = False,
    out: Path | None = None,
    jobs: int = 1,
    on_pair: Callable[[], None] = lambda: None,
) -> Exported:
    """Write the file, whole or not at all.

    Detections are made first where they are missing or out of date. What is computed stands in
    the log just before the image that it belongs to, and has its stamp.

    Args:
        out: directory of the results; default: beside the recording.

    Raises:
        TooltipError: a file cannot be read or written.
    """
    check_absent(path, overwrite=overwrite)
    recording = result.recording
    near = near_unless(result.preset, recording, result.given)
    detected = detect_in(recording, near=near, out=out, jobs=jobs, on_pair=on_pair)
    exported = Exported(path, detected=detected)
    beside = _BesideImages(result, detected, out)
    with LogWriter(path, overwrite=overwrite) as writer:

        def write(message: Message) -> None:
            writer.write(message)
            exported.topics[message.topic] = exported.topics.get(message.topic, 0) + 1

        started = False
        for item in iterate(recording.path):
            if isinstance(item, LoggedAttachment):
                if item.name not in ("rig.yaml", "camera.yaml", "robot.urdf"):
                    writer.attach(item.name, item.media_type, item.data)
                continue
            if not started:
                started = True
                for message in _beginning(result, detected, item.log_time_ns):
                    write(message)
            if not _kept(item, exported):
                continue
            if item.topic == recording.image_topic:
                for message in beside.take(item):
                    write(message)
            writer.copy(item)
            exported.topics[item.topic] = exported.topics.get(item.topic, 0) + 1
        for name, text in rig_files(result.rig).items():
            writer.attach(name, "text/plain", text.encode())
        document = json.dumps(result.estimated.document, indent=1).encode()
        writer.attach("tip.json", "application/json", document)
    return exported


def _kept(item: LoggedMessage, exported: Exported) -> bool:
    """Whether a message of the recording goes into the file; notes what does not."""
    replaced = item.topic in ("/tf", "/tf_static") or item.topic.startswith(_OWN)
    description = item.topic.rsplit("/", 1)[-1] == "robot_description"
    if item.encoding == "cdr" and not replaced and not description:
        return True
    if not description:
        why = "is computed anew" if replaced else f"is encoded as '{item.encoding}'"
        note = f"{item.topic} {why}, and the recording's own is left out"
        if note not in exported.notes:
            exported.notes.append(note)
    return False


def _beginning(result: Result, detected: Detected, log_time_ns: int) -> Iterator[Message]:
    """Yield what is said once: the robot, fixed transforms and the scene."""
    stamp_ns = int(result.recording.image_stamps_ns[0])
    if not (result.recording.pose_topic or result.rig.pose_topic):
        urdf, _ = resolve_urdf(result.recording, result.rig)
        yield Message("/robot_description", messages.STRING, log_time_ns, messages.string(urdf))
    payload = transform_message(_fixed_transforms(result), stamp_ns)
    yield Message("/tf_static", messages.TF_MESSAGE, log_time_ns, payload)
    yield Message(SCENE_TOPIC, messages.SCENE_UPDATE, log_time_ns, _scene(result, detected))


def _fixed_transforms(result: Result) -> list[tuple[str, str, Array]]:
    """Return (parent, child, parent_from_child) of all that never moves."""
    rig, recording = result.rig, result.recording
    found: list[tuple[str, str, Array]] = []
    known: set[str] = {rig.hand_frame}
    if not (recording.pose_topic or rig.pose_topic):
        tree = KinematicTree.from_urdf(*resolve_urdf(recording, rig))
        transforms = tree.parent_from_link({})
        for link, transform in zip(tree.links, transforms, strict=True):
            known |= {link.parent, link.name}
            if link.fixed:
                found.append((link.parent, link.name, transform))
    camera_frame = rig.camera_frame or recording.image_frame
    if rig.mount is not None:
        found.append((rig.mount.parent, camera_frame, rig.mount.parent_from_camera))
        known.add(camera_frame)
    if recording.image_frame and recording.image_frame not in known:
        found.append((camera_frame, recording.image_frame, np.eye(4)))
    tip = result.estimated.estimate.position
    if tip is not None:
        hand_from_tip = np.eye(4)
        hand_from_tip[:3, 3] = tip
        found.append((rig.hand_frame, TIP_LINK, hand_from_tip))
    return found


class _BesideImages:
    """What is computed for each image, by its stamp."""

    def __init__(self, result: Result, detected: Detected, out: Path | None) -> None:
        self._result = result
        self._index = {int(ns): i for i, ns in enumerate(result.recording.image_stamps_ns)}
        self._moving = _Moving(result)
        self._predicted = _predicted(result)
        self._labels = _labels(result, out)
        self._detections: dict[int, list[LoggedMessage]] = {}
        for item in iterate(detected.path):
            if isinstance(item, LoggedMessage):
                self._detections.setdefault(item.log_time_ns, []).append(item)

    def take(self, image: LoggedMessage) -> Iterator[Message]:
        """Yield the messages of an image, once for each stamp."""
        stamp_ns = messages.header_stamp_ns(image.payload)
        index = self._index.pop(stamp_ns, None) if stamp_ns is not None else None
        if stamp_ns is None or index is None:
            return
        time_ns = image.log_time_ns
        transforms = self._moving.at(index)
        if transforms:
            payload = transform_message(transforms, stamp_ns)
            yield Message("/tf", messages.TF_MESSAGE, time_ns, payload)
        for item in self._detections.get(stamp_ns, []):
            yield Message(item.topic, item.datatype, time_ns, item.payload)
        if self._predicted is not None:
            u, v = map(float, self._predicted[index])
            mark = cross(stamp_ns, u, v, GREEN)
            yield Message(PREDICTION_TOPIC, messages.IMAGE_ANNOTATIONS, time_ns, mark)
        if self._labels:
            mark = rings(stamp_ns, *self._labels.get(index, (np.nan, np.nan)), YELLOW, BLACK)
            yield Message(LABEL_TOPIC, messages.IMAGE_ANNOTATIONS, time_ns, mark)


class _Moving:
    """The transforms that change, at every image."""

    def __init__(self, result: Result) -> None:
        recording, rig = result.recording, result.rig
        self._known = result.views.known
        self._tree: KinematicTree | None = None
        if recording.pose_topic or rig.pose_topic:
            assert rig.mount is not None  # noqa: S101 - poses need it, as resolve_views has checked
            self._names = rig.mount.parent, rig.hand_frame
            camera_from_hand = inverse_transform(result.views.hand_from_camera)
            self._poses = rig.mount.parent_from_camera @ camera_from_hand
            return
        self._tree = KinematicTree.from_urdf(*resolve_urdf(recording, rig))
        query = recording.image_stamps_ns + round(rig.time_offset_s * 1e9)
        tracks = urdf_tracks(recording, rig)
        self._positions = {
            name: interpolate(track.stamps_ns, track.positions, query, MAX_GAP_NS)
            for name, track in tracks.items()
            if name in self._tree.joint_names and len(track.stamps_ns)
        }

    def at(self, index: int) -> list[tuple[str, str, Array]]:
        """Return (parent, child, parent_from_child); nothing where the hand's pose is unknown."""
        if not self._known[index]:
            return []
        if self._tree is None:
            return [(*self._names, self._poses[index])]
        positions: Mapping[str, float] = {
            name: float(values[index])
            for name, values in self._positions.items()
            if np.isfinite(values[index])
        }
        transforms = self._tree.parent_from_link(positions)
        return [
            (link.parent, link.name, transform)
            for link, transform in zip(self._tree.links, transforms, strict=True)
            if not link.fixed
        ]


def _predicted(result: Result) -> Array | None:
    """Return (N, 2) where the estimated tip lies in each image; None without an estimate."""
    tip = result.estimated.estimate.position
    if tip is None:
        return None
    camera_from_hand = inverse_transform(result.views.hand_from_camera)
    points = camera_from_hand[:, :3, :3] @ tip + camera_from_hand[:, :3, 3]
    return result.views.camera.project(points)


def _labels(result: Result, out: Path | None) -> dict[int, tuple[float, float]]:
    """Return labelled pixels by image."""
    recording = result.recording
    place = find_artifact(recording.path, LABELS_SUFFIX, out)
    if place is None:
        return {}
    labels = match_labels(read_labels(place), recording.image_stamps_ns, result.views.camera)
    rows = zip(labels.visible.frames, labels.visible.pixels, strict=True)
    return {int(frame): (float(u), float(v)) for frame, (u, v) in rows}


def _scene(result: Result, detected: Detected) -> bytes:
    """Return the rays of the detections, the candidates, the tip and the hand's spheres."""
    stamp_ns = int(result.recording.image_stamps_ns[0])
    frame = result.rig.hand_frame
    estimate = result.estimated.estimate
    entities = [
        entity(
            "hand",
            stamp_ns,
            frame,
            spheres=[
                sphere(np.array(item.center), item.radius, _HAND_COLOR)
                for item in result.rig.spheres
            ],
        ),
        entity("rays", stamp_ns, frame, lines=_rays(result, detected)),
        entity(
            "candidates",
            stamp_ns,
            frame,
            spheres=[
                sphere(item.position, _CANDIDATE_RADIUS_M, _CANDIDATE_COLOR)
                for item in estimate.candidates[1:]
            ],
            texts=[
                caption(item.position, f"{item.support:.0%}", WHITE)
                for item in estimate.candidates[1:]
            ],
        ),
    ]
    if estimate.position is not None and estimate.covariance is not None:
        deviation = 1000 * float(np.sqrt(np.trace(estimate.covariance)))
        entities.append(
            entity(
                "tip",
                stamp_ns,
                frame,
                spheres=[
                    ellipsoid(estimate.position, estimate.covariance, _DEVIATIONS, _TIP_COLOR)
                ],
                texts=[caption(estimate.position, f"tip +-{deviation:.1f} mm", WHITE)],
            )
        )
    return scene_message(entities)


def _rays(result: Result, detected: Detected) -> list[dict[str, object]]:
    """Return the detections' rays, from the camera to a little past the tip."""
    rays = estimation_input(result.views, detected.detections.tip_pixels()).rays
    if not len(rays):
        return []
    chosen = np.unique(np.linspace(0, len(rays) - 1, min(len(rays), _RAYS)).round().astype(int))
    origins, directions = rays.origins[chosen], rays.directions[chosen]
    lengths = np.full(len(chosen), _RAY_LENGTH_M)
    tip = result.estimated.estimate.position
    if tip is not None:
        along = np.einsum("ij,ij->i", tip - origins, directions)
        lengths = np.maximum(along, 0.0) + _RAY_BEYOND_M
    return [segments(origins, origins + lengths[:, None] * directions, _RAY_COLOR, 1.0)]
