"""What a recording holds, and what is wrong with it: every line with a verdict and a remedy."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from tooltip_cli.errors import TooltipError
from tooltip_cli.log.crashsafe import UNFINISHED
from tooltip_cli.log.messages import JOINT_STATE, POSE_STAMPED
from tooltip_cli.log.recording import IMAGE_TYPES, Recording, Topics, read_recording
from tooltip_cli.log.salvage import readable
from tooltip_cli.log.streams import Stream, all_streams
from tooltip_cli.log.survey import Gap, Survey, survey
from tooltip_cli.log.sync import bracket
from tooltip_cli.log.timing import nearest_s
from tooltip_cli.log.views import (
    MAX_GAP_NS,
    Views,
    resolve_camera,
    resolve_chain,
    resolve_rig,
    resolve_views,
    urdf_tracks,
)
from tooltip_cli.method.motion import HandMotion, hand_motion
from tooltip_cli.method.voting.estimate import check_motion
from tooltip_cli.method.voting.params import VotingSettings
from tooltip_cli.rig.camera import CameraModel
from tooltip_cli.rig.kinematics import inverse_transform
from tooltip_cli.rig.rigfile import Rig
from tooltip_cli.stages.voting import pair_views

OK, WARNING, ERROR = "ok", "warning", "error"
_REGULAR = (*IMAGE_TYPES, JOINT_STATE, POSE_STAMPED)  # sent at a steady rate
_NARROW_DEG, _WIDE_DEG = 15.0, 170.0  # horizontal angles of view that hardly any camera has
_FEW_IMAGES = 100
_MANY_MISSING = 0.02  # share of the messages
_FAR_S = 0.02  # between an image and the nearest sample of the joints
_STILL_RAD = 1e-3


@dataclass(frozen=True)
class Finding:
    """One line: what was looked at, what was found, and what to do about it."""

    level: str  # ok, warning or error
    subject: str
    text: str
    remedy: str = ""


@dataclass(frozen=True)
class Synchronisation:
    """How the images stand to the joints or poses in time, at the rig's time offset."""

    overlap_s: float  # in which there are images and all needed joints
    nearest_s: float  # median distance from an image to the nearest sample
    nearest_max_s: float
    interpolated_s: float  # median distance between the two samples around an image
    known: int  # images at which the hand's pose is known
    images: int


@dataclass
class Info:
    """Everything that ``tooltip info`` says."""

    path: Path
    size_bytes: int
    state: str  # whole, truncated or damaged
    profile: str
    library: str
    streams: list[Stream] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    image_size: tuple[int, int] | None = None  # width, height, pixels
    synchronisation: Synchronisation | None = None
    motion: HandMotion | None = None
    usable_frames: float | None = None  # share of the images with a partner on either side
    motion_px: float | None = None  # of a tool's end between consecutive images, median

    def add(self, level: str, subject: str, text: str, remedy: str = "") -> None:
        """Add a finding."""
        self.findings.append(Finding(level, subject, text, remedy))

    @property
    def verdict(self) -> str:
        """The worst level of all findings."""
        levels = {finding.level for finding in self.findings}
        return next(level for level in (ERROR, WARNING, OK) if level in levels or level == OK)


def inspect(path: Path, *, rig: Path | None = None, topics: Topics | None = None) -> Info:
    """Look at a recording, whole or not.

    Args:
        rig: rig file; default: the one stored in the recording.

    Raises:
        TooltipError: the file is missing, empty or no MCAP at all.
    """
    found = survey(path)
    state = "whole" if found.whole else "damaged" if found.damaged else "truncated"
    streams = all_streams(readable(found))
    info = Info(path, found.size, state, found.profile, found.library, streams)
    _judge_file(info, found)
    for stream in info.streams:
        _judge_stream(info, stream)
    try:
        recording = read_recording(path, topics or Topics(), readable(found))
        for note in recording.notes:
            info.add(WARNING, "content", note)
        _judge_images(info, recording)
        _judge_rig(info, recording, rig)
    except TooltipError as error:
        info.add(ERROR, "recording", str(error))
    return info


def _judge_file(info: Info, found: Survey) -> None:
    if found.whole:
        text = "every checksum holds"
        if not found.checksums:
            text = "it has no checksums of its messages, so damage would not be seen"
            info.add(WARNING, "file", text, "record with a writer that makes chunks with CRCs")
        elif info.path.name.endswith(UNFINISHED):
            text += ", but its recording was stopped before its end"
            info.add(WARNING, "file", text, _salvage(info))
        else:
            info.add(OK, "file", text)
        return
    lost = [part for part in found.parts if isinstance(part, Gap)]
    reasons = [f"{gap.reason} (byte {gap.offset})" for gap in lost[:3]] + found.notes
    if len(lost) > 3:
        reasons.append(f"and {len(lost) - 3} gaps more")
    if found.truncated:
        reasons.append("the file ends before it was closed")
    info.add(ERROR, "file", f"{info.state}: " + "; ".join(reasons), _salvage(info))


def _salvage(info: Info) -> str:
    return f"'tooltip salvage {info.path} OUT.mcap' makes a recording of what is intact"


def _judge_stream(info: Info, stream: Stream) -> None:
    times = stream.timing
    odd = []
    if times.reversals:
        odd.append(f"{times.reversals} stamps run backwards")
    if times.duplicates:
        odd.append(f"{times.duplicates} stamps occur twice")
    holes = stream.datatype in _REGULAR and times.missing > _MANY_MISSING * times.count
    if holes:
        odd.append(
            f"about {times.missing} messages are missing in {times.gaps} gaps, the longest of "
            f"{times.longest_gap_s:.2f} s"
        )
    if stream.encoding != "cdr":
        odd.append(f"its encoding '{stream.encoding}' is not read")
    if not odd:
        info.add(OK, stream.topic, _rate(stream))
        return
    remedy = "messages are sorted by stamp on reading; check the publisher's clock"
    if holes and info.state != "whole":
        remedy = "the file is damaged; see there"
    elif holes:
        remedy = "check the load of the machine that recorded, and its network"
    elif stream.encoding != "cdr":
        remedy = "record it as a ROS 2 message if it is needed"
    info.add(WARNING, stream.topic, f"{_rate(stream)}; {'; '.join(odd)}", remedy)


def _rate(stream: Stream) -> str:
    times = stream.timing
    if times.count == 1:
        return "one message"
    return f"{times.count} messages at {times.rate_hz:.1f} Hz over {times.duration_s:.1f} s"


def _judge_images(info: Info, recording: Recording) -> None:
    count = len(recording.image_stamps_ns)
    height, width = next(recording.images([0], gray=True)).shape
    info.image_size = (width, height)
    text = f"{count} of {width}x{height} on {recording.image_topic}"
    try:
        list(recording.images([0, count // 2, count - 1], gray=True))
    except TooltipError as error:
        info.add(ERROR, "images", str(error))
        return
    if count < _FEW_IMAGES:
        info.add(WARNING, "images", text, "record 15 to 20 seconds; an estimate needs many views")
    else:
        info.add(OK, "images", text)


def _judge_rig(info: Info, recording: Recording, rig_path: Path | None) -> None:
    try:
        rig = resolve_rig(recording, rig_path)
    except TooltipError as error:
        if recording.camera is not None:
            _judge_camera(info, recording.camera)
        info.add(WARNING if rig_path is None else ERROR, "rig", str(error))
        return
    try:
        _judge_camera(info, resolve_camera(recording, rig))
    except TooltipError as error:
        info.add(ERROR, "calibration", str(error))
    if not (recording.pose_topic or rig.pose_topic):
        _judge_joints(info, recording, rig)
    try:
        views = resolve_views(recording, rig)
    except TooltipError as error:
        info.add(ERROR, "synchronisation", str(error))
        return
    _judge_synchronisation(info, recording, rig, views)
    _judge_motion(info, views)


def _judge_camera(info: Info, camera: CameraModel) -> None:
    text = (
        f"fx {camera.fx:.1f}, fy {camera.fy:.1f}, centre ({camera.cx:.1f}, {camera.cy:.1f}), "
        f"{camera.distortion_model}"
    )
    size = (camera.width, camera.height)
    view_deg = float(np.degrees(2 * np.arctan(camera.width / (2 * camera.fx))))
    inside = 0 < camera.cx < camera.width and 0 < camera.cy < camera.height
    if info.image_size not in (None, size):
        info.add(
            ERROR,
            "calibration",
            f"for {size[0]}x{size[1]}, but the images have another size",
            "calibrate at the recorded size, or scale the camera file to it",
        )
    elif not inside or not _NARROW_DEG < view_deg < _WIDE_DEG:
        info.add(
            WARNING,
            "calibration",
            f"{text}: no ordinary camera, it would see {view_deg:.0f} degrees across",
            "check the camera file: focal lengths and centre are in pixels",
        )
    else:
        info.add(OK, "calibration", text)


def _judge_joints(info: Info, recording: Recording, rig: Rig) -> None:
    try:
        chain = resolve_chain(recording, rig)
    except TooltipError as error:
        info.add(ERROR, "robot", str(error))
        return
    tracks = urdf_tracks(recording, rig)
    names = chain.joint_names
    between = f"{len(names)} joints between camera and hand"
    missing = [name for name in names if name not in tracks]
    if missing:
        info.add(
            ERROR,
            "joints",
            f"{between}, of which the log lacks {', '.join(missing)}",
            f"map the log's names under 'joints' in the rig file; logged: "
            f"{', '.join(sorted(recording.joints)) or 'none'}",
        )
        return
    beyond, still = [], []
    for name, (low, high) in zip(names, chain.limits, strict=True):
        positions = tracks[name].positions
        if len(positions) and not (low - 0.1 <= positions.min() <= positions.max() <= high + 0.1):
            beyond.append(name)
        if len(positions) and np.ptp(positions) < _STILL_RAD:
            still.append(name)
    if beyond:
        info.add(
            WARNING,
            "joints",
            f"{between}; beyond the URDF's limits: {', '.join(beyond)}",
            "check that positions are in radians (or metres), and that names are not mixed up",
        )
        return
    text = f"{between}: {', '.join(names)}"
    info.add(OK, "joints", text + (f"; never moved: {', '.join(still)}" if still else ""))


def _judge_synchronisation(info: Info, recording: Recording, rig: Rig, views: Views) -> None:
    query = recording.image_stamps_ns + round(rig.time_offset_s * 1e9)
    pose_topic = recording.pose_topic or rig.pose_topic
    if pose_topic is not None:
        streams = [recording.poses[pose_topic].stamps_ns]
    else:
        tracks = urdf_tracks(recording, rig)
        streams = [tracks[name].stamps_ns for name in resolve_chain(recording, rig).joint_names]
    nearest = np.max([nearest_s(stamps, query) for stamps in streams], axis=0)
    widths = []
    for stamps in streams:
        before, _, valid = bracket(stamps, query, MAX_GAP_NS)
        after = np.minimum(before + 1, len(stamps) - 1)
        widths.append(np.where(valid, (stamps[after] - stamps[before]) / 1e9, np.nan))
    known = int(np.count_nonzero(views.known))
    first = max(query[0], *(stamps[0] for stamps in streams))
    last = min(query[-1], *(stamps[-1] for stamps in streams))
    found = Synchronisation(
        overlap_s=max(int(last) - int(first), 0) / 1e9,
        nearest_s=float(np.median(nearest)),
        nearest_max_s=float(nearest.max()),
        interpolated_s=float(np.nanmedian(np.max(widths, axis=0))),
        known=known,
        images=len(query),
    )
    info.synchronisation = found
    text = (
        f"overlap {found.overlap_s:.1f} s; nearest sample {1000 * found.nearest_s:.1f} ms away "
        f"(at most {1000 * found.nearest_max_s:.1f} ms), samples around an image "
        f"{1000 * found.interpolated_s:.1f} ms apart; the hand's pose is known at {known} of "
        f"{len(query)} images"
    )
    if known < (1 - _MANY_MISSING) * len(query):
        info.add(
            WARNING,
            "synchronisation",
            text,
            "start the joints before the camera and stop them after it; check for gaps",
        )
    elif found.nearest_s > _FAR_S:
        info.add(WARNING, "synchronisation", text, "record the joints at 100 Hz or more")
    else:
        info.add(OK, "synchronisation", text)


def _judge_motion(info: Info, views: Views) -> None:
    known = views.known
    camera_from_hand = inverse_transform(views.hand_from_camera[known])
    motion = hand_motion(camera_from_hand, views.stamps_ns[known] / 1e9)
    settings = VotingSettings()
    pairing, poses = pair_views(views, settings, known)
    all_frames = replace(settings, pairing=replace(settings.pairing, frames=len(known)))
    usable = len(pair_views(views, all_frames, known)[0].frames) / len(known)
    info.motion, info.usable_frames, info.motion_px = motion, usable, pairing.fastest_px
    text = (
        f"the hand turns by up to {motion.turn_deg:.0f} degrees at {motion.speed_deg_s:.0f} "
        f"degrees/s (95 %: {motion.fastest_deg_s:.0f}) and travels up to "
        f"{1000 * motion.travel_m:.0f} mm"
    )
    info.add(OK, "motion", text)
    share = (
        f"{usable:.0%} of the images have a partner on either side with usable motion; a tool's "
        f"end moves by about {pairing.fastest_px:.1f} pixels from image to image"
    )
    reason = check_motion(pairing, poses, settings)
    if reason is None:
        info.add(OK, "pairs", share)
    else:
        info.add(
            ERROR, "pairs", f"{share}; an estimate would be refused ({reason.code})", reason.text
        )
