"""Accuracy of the estimators on simulated tools and on given recordings, in one table.

Example:
    python tests/benchmarks/accuracy/run.py --work /tmp/accuracy --seeds 0 1 2 3 4
    python tests/benchmarks/accuracy/run.py --work /tmp/accuracy --perturb noise half 15hz
    python tests/benchmarks/accuracy/run.py --work /tmp/accuracy --recordings DIR/*.mcap
    python tests/benchmarks/accuracy/run.py --work /tmp/accuracy --methods voting voting+all --wrong

Simulated recordings are made once under ``--work`` and reused. A given recording needs
STEM.labels.csv and, where it does not carry them, STEM.rig.yaml and STEM.truth.json beside it.
``voting+none``, ``voting+time`` and ``voting+all`` are voting with ``--refine``; where it is used,
the tip is projected by the refined rig. ``--preset`` is of the detections that ``kmeans`` and
``map`` take, and ``within`` the part of them within 10 px of the true tip. ``--wrong`` makes every
rig wrong: 1 degree, 5 mm and 30 ms.
"""

from __future__ import annotations

import argparse
import itertools
import json
import random
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from tooltip_cli.labels.files import match_labels, read_labels
from tooltip_cli.log.recording import read_recording
from tooltip_cli.log.views import Views, resolve_rig, resolve_views
from tooltip_cli.method.estimators import EstimatorParams
from tooltip_cli.method.evaluation import pixel_errors
from tooltip_cli.method.types import Array, Correction, TipEstimate, TipPixels
from tooltip_cli.method.voting.params import VotingSettings
from tooltip_cli.rig.kinematics import inverse_transform
from tooltip_cli.sources.sim import TOOLS, SimParams
from tooltip_cli.stages.calibrate import put_right, rig_of
from tooltip_cli.stages.detect import Detected
from tooltip_cli.stages.estimate import estimate_from_images, estimate_from_labels
from tooltip_cli.stages.held_out import unlabelled
from tooltip_cli.stages.simulate import reuse_simulation

PERTURBATIONS: dict[str, dict[str, Any]] = {
    "none": {},
    "noise": {"noise_sigma": 4.0},
    "half": {"size": (320, 240)},
    "15hz": {"fps": 15.0, "frames": 250},
    "q50": {"jpeg_quality": 50},
    "head": {"head_motion_deg": 2.0},
    "grip+": {"grip_offset_m": 0.02},
    "grip-": {"grip_offset_m": -0.02},
    "tilt+": {"tilt_deg": 40.0},
    "tilt-": {"tilt_deg": -40.0},
    "fast": {"motion": "fast"},
    "fast15": {"motion": "fast", "fps": 15.0, "frames": 250},
    "sparse": {"fps": 7.5, "frames": 125, "shutter": 0.1},  # every fourth image of ``none``
    "late": {"time_offset_s": 0.03},
    "clutter": {"background": "clutter"},
    "spheres": {},
    "in_plane": {"motion": "in_plane"},
    "still": {"motion": "still"},
}
MIXED = "mixed"
"""Several at once, drawn for each tool and seed from these; of two that contradict, the first."""
IN_THE_MIX: tuple[dict[str, Any], ...] = (
    {"noise_sigma": 4.0},
    {"noise_sigma": 6.0},
    {"jpeg_quality": 50},
    {"jpeg_quality": 30},
    {"head_motion_deg": 2.0},
    {"head_motion_deg": 4.0},
    {"background": "clutter"},
    {"grip_offset_m": 0.02},
    {"grip_offset_m": -0.02},
    {"tilt_deg": 20.0},
    {"tilt_deg": -15.0},
    {"size": (320, 240)},
    {"fps": 15.0, "frames": 250},
    {"time_offset_s": 0.015},
    {"frames": 250},
    {"frames": 1000},
)
_AT_ONCE = 3
PERTURBATION_NAMES = (*PERTURBATIONS, MIXED)
SMALLER_SPHERES_M = 0.01  # the hand's spheres of ``spheres``, which is otherwise as ``none``
WRONG = Correction(0.03, np.radians([0.68, -0.57, 0.46]), np.array([0.0030, -0.0030, 0.0027]))
GOOD_PX = 10.0  # mean error of a run that is worth a warning
CHI2_95 = 7.815  # three degrees of freedom

Case: TypeAlias = tuple[Path, "Path | None", str]
"""A recording, its rig file if it has one, and what it is listed under."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", type=Path, required=True, help="directory for what is made")
    parser.add_argument("--tools", nargs="+", default=list(TOOLS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--perturb", nargs="+", default=["none"], choices=PERTURBATION_NAMES)
    parser.add_argument("--methods", nargs="+", default=["voting", "kmeans"])
    parser.add_argument("--preset", default="voting", choices=["voting", "paper"])
    parser.add_argument("--wrong", action="store_true", help="make every rig wrong")
    parser.add_argument("--recordings", nargs="*", type=Path, default=[])
    arguments = parser.parse_args()
    recordings = [path for path in arguments.recordings if len(path.suffixes) == 1]
    cases = iter([(path, rig_beside(path), "given") for path in recordings])
    if not arguments.recordings:
        cases = simulated(arguments.work, arguments.tools, arguments.seeds, arguments.perturb)
    score_all(cases, arguments.methods, arguments.work, arguments.wrong, arguments.preset)


def score_all(
    cases: Iterable[Case],
    methods: list[str],
    work: Path,
    wrong: bool = False,
    preset: str = "voting",
) -> None:
    """Score every recording, print a line for each and a summary, write ``accuracy.json``."""
    rows = []
    for path, rig, group in cases:
        smaller = SMALLER_SPHERES_M if group == "spheres" else 0.0
        for row in _score(path, rig, methods, work / "results", wrong, smaller, preset):
            rows.append({"group": group, **row})
            print(_line(rows[-1]), flush=True)
    (work / "accuracy.json").write_text(json.dumps(rows, indent=1))
    for group in dict.fromkeys(row["group"] for row in rows):
        for method in dict.fromkeys(row["method"] for row in rows):
            _summary(
                group, method, [r for r in rows if (r["group"], r["method"]) == (group, method)]
            )


def rig_beside(path: Path) -> Path | None:
    """Return the rig file beside a recording, if there is one."""
    beside = path.with_suffix(".rig.yaml")
    return beside if beside.exists() else None


def simulated(
    work: Path,
    tools: Iterable[str],
    seeds: Iterable[int],
    perturbations: Iterable[str],
    scene: Callable[[str, int], dict[str, Any]] = lambda tool, seed: {},
) -> Iterator[Case]:
    """Simulate what ``work`` does not hold yet, in the scene of each tool and seed."""
    work.mkdir(parents=True, exist_ok=True)
    for perturbation, seed, tool in itertools.product(perturbations, seeds, tools):
        changes = {**scene(tool, seed), **_changes(perturbation, tool, seed)}
        params = replace(SimParams(tool=tool, seed=seed), **changes)
        made = "none" if perturbation == "spheres" else perturbation
        path = work / f"{tool}-{seed}-{made}.mcap"
        yield reuse_simulation(params, path, jobs=2).recording, None, perturbation


def _changes(perturbation: str, tool: str, seed: int) -> dict[str, Any]:
    """Return the parameters that a perturbation changes."""
    if perturbation != MIXED:
        return PERTURBATIONS[perturbation]
    drawn = random.Random(f"{tool}-{seed}").sample(IN_THE_MIX, _AT_ONCE)
    return {name: value for change in reversed(drawn) for name, value in change.items()}


def _score(
    path: Path,
    rig_path: Path | None,
    methods: list[str],
    out: Path,
    wrong: bool,
    smaller: float,
    preset: str,
) -> list[dict[str, Any]]:
    recording = read_recording(path)
    rig = resolve_rig(recording, rig_path)
    spheres = [replace(item, radius=item.radius - smaller) for item in rig.spheres]
    rig = replace(rig, spheres=tuple(spheres))
    if wrong:
        rig = put_right(recording, rig, WRONG)
    views = resolve_views(recording, rig)
    labels = match_labels(
        read_labels(path.with_suffix(".labels.csv")), recording.image_stamps_ns, views.camera
    )
    truth = true_tip(path, recording.attachments)
    baseline = estimate_from_labels(
        recording, views, labels, EstimatorParams(method="map"), out=out / "labels"
    ).estimate
    rows = [
        {"name": path.stem, "method": "labels", **_errors(baseline, views, labels.visible, truth)}
    ]
    for method in methods:
        start = time.perf_counter()
        name, _, what = method.partition("+")
        found_all = estimate_from_images(
            recording,
            rig,
            views,
            EstimatorParams(method=name, voting=VotingSettings(put_right=what or "auto")),
            unlabelled(recording, views.camera, None),
            preset=preset,
            out=out / method,
            force=True,
        )
        found = found_all.estimate
        row = {"name": path.stem, "method": method, "seconds": time.perf_counter() - start}
        if isinstance(found_all.detected, Detected) and truth is not None:
            row["within"] = _share_within(found_all.detected.detections.tip_pixels(), views, truth)
        refined = found.refinement
        if refined is not None and refined.applied:
            row["offset_ms"] = 1000 * refined.correction.time_offset
        _, seen_by = rig_of(recording, rig, views, refined)
        rows.append({**row, **_errors(found, seen_by, labels.visible, truth)})
    return rows


def true_tip(path: Path, attachments: Any) -> Array | None:
    """Return the true tip (3,), metres, hand frame, beside or in a recording; None: unknown."""
    beside = path.with_suffix(".truth.json")
    text = beside.read_text() if beside.exists() else attachments.get("truth.json")
    return None if text is None else np.array(json.loads(text)["tip_in_hand_m"])


def _errors(
    found: TipEstimate, views: Views, labels: TipPixels, truth: Array | None
) -> dict[str, Any]:
    codes = [reason.code for reason in found.reasons]
    row: dict[str, Any] = {"status": found.status, "codes": codes}
    if found.position is None or found.covariance is None:
        return row
    ends = [(found.position, found.covariance)]
    if "ambiguous_end" in codes:
        ends += [
            (item.position, item.covariance)
            for item in found.candidates[1:]
            if item.covariance is not None
        ]
    pixels = [_mean_px(place, views, labels) for place, _ in ends]
    row |= {"px": pixels[0], "nearest_px": min(pixels)}
    if truth is not None:
        errors = [place - truth for place, _ in ends]
        millimetres = [float(1000 * np.linalg.norm(error)) for error in errors]
        nearest = int(np.argmin(millimetres))
        error, covariance = errors[nearest], ends[nearest][1]
        inside = float(error @ np.linalg.solve(covariance, error)) <= CHI2_95
        row |= {"mm": millimetres[0], "nearest_mm": millimetres[nearest], "covered": inside}
    return row


def _mean_px(place: Array, views: Views, labels: TipPixels) -> float:
    return float(np.nanmean(_off_px(place, views, labels)))


def _share_within(found: TipPixels, views: Views, truth: Array) -> float:
    """Return the part of the detections that lie within 10 px of where the tip really is."""
    return float(np.mean(_off_px(truth, views, found) < GOOD_PX))


def _off_px(place: Array, views: Views, seen: TipPixels) -> Array:
    camera = inverse_transform(views.hand_from_camera[seen.frames])
    projected = views.camera.project(camera[:, :3, :3] @ place + camera[:, :3, 3])
    return pixel_errors(projected, seen.pixels)


def _line(row: dict[str, Any]) -> str:
    numbers = "".join(
        f" {name} {row[name]:6.2f}"
        for name in ("px", "mm", "nearest_px", "seconds", "offset_ms", "within")
        if name in row
    )
    return f"{row['name']:32} {row['method']:12}{numbers} {row['status']} {' '.join(row['codes'])}"


def _summary(group: str, method: str, rows: list[dict[str, Any]]) -> None:
    answered = [row for row in rows if "px" in row]
    text = f"{group:10} {method:12} {len(answered)} of {len(rows)} answered"
    for name in ("px", "nearest_px", "mm", "nearest_mm"):
        values = [row[name] for row in answered if name in row]
        if values:
            text += f"; {name} mean {np.mean(values):.2f} worst {np.max(values):.2f}"
    within = [row["within"] for row in answered if "within" in row]
    if within:
        text += f"; detections within {GOOD_PX:g} px {np.mean(within):.1%}"
    covered = [row["covered"] for row in answered if "covered" in row]
    if covered:
        text += f"; 95 % region holds the truth in {np.mean(covered):.0%}"
    flagged = sum("ambiguous_end" in row["codes"] for row in rows)
    print(text + f"; ambiguous_end {flagged}")
    bad = [row for row in rows if row.get("nearest_px", GOOD_PX + 1) > GOOD_PX]
    doubted = [row for row in bad if row["status"] == "refused" or row["codes"]]
    good = [row for row in rows if row not in bad]
    alarms = [row for row in good if row["codes"]]
    print(
        f"{'':23} above {GOOD_PX:g} px or refused: {len(bad)}, of these said {len(doubted)}; "
        f"below: {len(good)}, of these flagged {len(alarms)}"
    )


if __name__ == "__main__":
    main()
