"""The calibrate stage: clock offset and camera correction that recordings of one robot share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tooltip_cli.errors import RefusedError, TooltipError
from tooltip_cli.log.recording import Recording, Topics, read_recording
from tooltip_cli.log.views import Views, corrected_rig, resolve_rig, resolve_views
from tooltip_cli.log.whole import write_file
from tooltip_cli.method.types import Array, Correction, Refinement, TipEstimate
from tooltip_cli.method.voting.calibrate import PosesAt, Seen
from tooltip_cli.method.voting.calibrate import calibrate as solve
from tooltip_cli.method.voting.ends import ClosePart, first_end
from tooltip_cli.method.voting.pairing import Pairing
from tooltip_cli.method.voting.params import VotingSettings
from tooltip_cli.rig.kinematics import inverse_transform
from tooltip_cli.rig.rigfile import Rig, rig_files
from tooltip_cli.stages.artifacts import ensure_directory
from tooltip_cli.stages.held_out import unlabelled
from tooltip_cli.stages.voting import gather_votes


@dataclass(frozen=True)
class Calibrated:
    """What the stage returns."""

    refinement: Refinement
    rig: Rig  # of the first recording, put right where that helps
    used: tuple[Path, ...]
    left_out: tuple[tuple[Path, str], ...]  # and why

    @property
    def document(self) -> dict[str, Any]:
        """What ``--json`` prints."""
        return {
            **refinement_document(self.refinement),
            "recordings": [str(path) for path in self.used],
            "left_out": [{"recording": str(path), "why": why} for path, why in self.left_out],
        }


def calibrate(
    paths: Sequence[Path],
    *,
    rig: Path | None = None,
    topics: Topics | None = None,
    camera: bool = False,
    settings: VotingSettings | None = None,
    out: Path | None = None,
    jobs: int = 1,
    on_frame: Callable[[], None] = lambda: None,
) -> Calibrated:
    """Find the offset between image and joint clocks, and where the camera really is.

    The recordings are of one robot with one rig; each may show another tool.

    Args:
        camera: whether the camera's pose may be put right besides the clocks.
        out: directory for the moving edges, as of the detect stage.

    Raises:
        RefusedError: no recording shows a tool's end well enough.
        TooltipError: anything wrong with the inputs.
    """
    settings = settings or VotingSettings()
    seen, used, left_out, rigs = [], [], [], []
    for path in paths:
        recording = read_recording(path, topics or Topics())
        own = resolve_rig(recording, rig)
        views = resolve_views(recording, own)
        allowed = unlabelled(recording, views.camera, out)
        votes = gather_votes(
            recording, views, settings, allowed, out=out, jobs=jobs, on_frame=on_frame
        )
        if isinstance(votes, TipEstimate):
            left_out.append((path, votes.reasons[0].text))
            continue
        part = first_end(votes.seen_by(views, settings), votes.spheres, settings)
        if part is None:
            left_out.append((path, "shows no tool"))
            continue
        seen.append(seen_part(recording, own, votes.pairing, part))
        used.append(path)
        rigs.append((recording, own))
    found = solve(seen, camera, settings.calibration, settings.refine) if seen else None
    if found is None:
        why = "; ".join(f"{path}: {text}" for path, text in left_out)
        raise RefusedError(
            "no recording shows the end of a tool well enough to calibrate with"
            + (f" ({why})" if why else "")
        )
    first = rigs[0][1]
    if found.applied:
        first = put_right(*rigs[0], found.correction)
    return Calibrated(found, first, tuple(used), tuple(left_out))


def put_right(recording: Recording, rig: Rig, correction: Correction) -> Rig:
    """Return the rig with a correction."""
    camera = None if correction.rotation is None else correction.corrected_from_camera
    return corrected_rig(recording, rig, correction.time_offset, camera)


def rig_of(
    recording: Recording, rig: Rig, views: Views, found: Refinement | None
) -> tuple[Rig, Views]:
    """Return the rig and views that an estimate is by: put right where it is said to be."""
    if found is None or not found.applied:
        return rig, views
    better = put_right(recording, rig, found.correction)
    return better, resolve_views(recording, better)


def seen_part(recording: Recording, rig: Rig, pairing: Pairing, part: ClosePart) -> Seen:
    """Return a tool's end with the poses at shifted stamps."""
    poses_at = _poses_at(recording, rig, pairing)
    return Seen(part.near, poses_at, part.position, part.axis, part.radius)


def _poses_at(recording: Recording, rig: Rig, pairing: Pairing) -> PosesAt:
    """Return the chosen frames' poses at shifted stamps; where joints end, the unshifted ones."""
    stamps = recording.image_stamps_ns[pairing.frames]
    recording = replace(recording, image_stamps_ns=stamps)
    known: dict[int, Array] = {}

    def poses_by(rig: Rig) -> Array:
        return inverse_transform(resolve_views(recording, rig).hand_from_camera)

    start = poses_by(rig)

    def poses_at(offset_s: float) -> Array:
        shift_ns = round(offset_s * 1e9)
        if shift_ns not in known:
            shifted = replace(rig, time_offset_s=rig.time_offset_s + shift_ns / 1e9)
            try:
                poses = poses_by(shifted)
            except TooltipError:  # still views: no pose is known between them
                poses = start
            known[shift_ns] = np.where(np.isfinite(poses), poses, start)
        return known[shift_ns]

    return poses_at


def refinement_document(found: Refinement) -> dict[str, Any]:
    """Return a refinement as JSON has it."""
    correction, deviations = found.correction, found.deviations
    camera = None
    if correction.rotation is not None and correction.translation is not None:
        camera = {
            "rotation_deg": np.degrees(correction.rotation).tolist(),
            "rotation_std_deg": np.degrees(deviations[1:4]).tolist(),
            "translation_m": correction.translation.tolist(),
            "translation_std_m": deviations[4:].tolist(),
        }
    return {
        "applied": found.applied,
        "time_offset_s": correction.time_offset,
        "time_offset_std_s": float(deviations[0]),
        "camera": camera,
        "support_before": found.support_before,
        "support_after": found.support_after,
    }


def refinement_sentence(refined: dict[str, Any]) -> str:
    """Say in words what was found out about clocks and camera."""
    text = (
        f"image clock {1000 * refined['time_offset_s']:+.1f} +-"
        f"{1000 * refined['time_offset_std_s']:.1f} ms"
    )
    camera = refined["camera"]
    if camera is not None:
        turn = sum(value**2 for value in camera["rotation_deg"]) ** 0.5
        step = 1000 * sum(value**2 for value in camera["translation_m"]) ** 0.5
        text += f", camera turned by {turn:.2f} degrees and moved by {step:.1f} mm"
    shares = (
        f"{refined['support_before']:.0%} of what the images could show of the tool's end fits "
        f"without and {refined['support_after']:.0%} with it"
    )
    used = "used" if refined["applied"] else "not used, as too little speaks for it"
    return f"{text}: {used}; {shares}"


def refinement_from_document(document: dict[str, Any]) -> Refinement:
    """Read a refinement back.

    Raises:
        KeyError, TypeError, ValueError: it is not one.
    """
    camera = document["camera"]
    deviations = [float(document["time_offset_std_s"])]
    rotation = translation = None
    if camera is not None:
        rotation = np.radians(np.array(camera["rotation_deg"], dtype=float))
        translation = np.array(camera["translation_m"], dtype=float)
        deviations += np.radians(camera["rotation_std_deg"]).tolist()
        deviations += [float(value) for value in camera["translation_std_m"]]
    return Refinement(
        Correction(float(document["time_offset_s"]), rotation, translation),
        np.array(deviations),
        bool(document["applied"]),
        float(document["support_before"]),
        float(document["support_after"]),
    )


def free_for_rig(folder: Path, force: bool) -> Path:
    """Return where a rig file will be written.

    Raises:
        TooltipError: it exists and ``force`` was not given.
    """
    path = folder / "rig.yaml"
    if path.exists() and not force:
        raise TooltipError(f"{path} exists already; name another folder, or give --force")
    return path


def write_rig(rig: Rig, folder: Path) -> Path:
    """Write a rig file with the files that it names, and return its path.

    Raises:
        TooltipError: it cannot be written.
    """
    ensure_directory(folder)
    for name, text in rig_files(rig).items():
        write_file(folder / name, text)
    return folder / "rig.yaml"
