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
from tooltip_cli.method.rays import sphere_array
from tooltip_cli.method.types import Array, Correction, Refinement
from tooltip_cli.method.voting.calibrate import PosesAt, Seen
from tooltip_cli.method.voting.calibrate import calibrate as solve
from tooltip_cli.method.voting.ends import first_end
from tooltip_cli.method.voting.estimate import check_motion
from tooltip_cli.method.voting.pairing import Pairing
from tooltip_cli.method.voting.params import VotingSettings
from tooltip_cli.method.voting.volume import HandEdges
from tooltip_cli.rig.kinematics import inverse_transform
from tooltip_cli.rig.rigfile import Rig, rig_files
from tooltip_cli.stages.artifacts import ensure_directory
from tooltip_cli.stages.held_out import unlabelled
from tooltip_cli.stages.moving import detect_edges_in
from tooltip_cli.stages.voting import hand_edges, pair_views


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
        pairing, poses = pair_views(views, settings, allowed)
        reason = check_motion(pairing, poses, settings)
        end = None
        if reason is None:
            detected = detect_edges_in(
                recording, views, pairing, settings, out=out, jobs=jobs, on_frame=on_frame
            )
            spheres = sphere_array([(sphere.center, sphere.radius) for sphere in views.spheres])
            edges = hand_edges(views, detected.edges, poses, settings)
            end = seen_end(recording, own, edges, pairing, spheres, settings)
        if end is None:
            left_out.append((path, "shows no tool" if reason is None else reason.text))
            continue
        seen.append(end)
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


def refine_rig(
    recording: Recording,
    rig: Rig,
    camera: bool,
    settings: VotingSettings,
    edges: HandEdges,
    pairing: Pairing,
    spheres: Array,
) -> Refinement | None:
    """Find what one recording says about its rig; None: it shows no tool's end."""
    end = seen_end(recording, rig, edges, pairing, spheres, settings)
    return None if end is None else solve([end], camera, settings.calibration, settings.refine)


def put_right(recording: Recording, rig: Rig, correction: Correction) -> Rig:
    """Return the rig with a correction."""
    camera = None if correction.rotation is None else correction.corrected_from_camera
    return corrected_rig(recording, rig, correction.time_offset, camera)


def seen_end(
    recording: Recording,
    rig: Rig,
    edges: HandEdges,
    pairing: Pairing,
    spheres: Array,
    settings: VotingSettings,
) -> Seen | None:
    """Return the first end of a recording's tool with the poses at shifted stamps; None: none."""
    end = first_end(edges, spheres, settings)
    if end is None:
        return None
    return Seen(end.near, _poses_at(recording, rig, pairing), end.position, end.axis, end.radius)


def _poses_at(recording: Recording, rig: Rig, pairing: Pairing) -> PosesAt:
    """Return the chosen frames' poses at shifted stamps; where joints end, the unshifted ones."""
    start = _chosen(resolve_views(recording, rig), pairing)
    known: dict[int, Array] = {}

    def poses_at(offset_s: float) -> Array:
        shift_ns = round(offset_s * 1e9)
        if shift_ns not in known:
            shifted = replace(rig, time_offset_s=rig.time_offset_s + shift_ns / 1e9)
            poses = _chosen(resolve_views(recording, shifted), pairing)
            known[shift_ns] = np.where(np.isfinite(poses), poses, start)
        return known[shift_ns]

    return poses_at


def _chosen(views: Views, pairing: Pairing) -> Array:
    return inverse_transform(views.hand_from_camera[pairing.frames])


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
