"""How flat the parameters of the voting method are: each halved and doubled, the rest as it is.

Example:
    python -m tests.benchmarks.accuracy.sensitivity DIR/*.mcap --groups voting end refine

Prints, for each parameter, the mean tip error of the nearest candidate over the recordings, and the
worst, in millimetres; at the start that of the defaults. Recordings need the truth inside or beside
them, as in run.py. The groups pairing, moving and silhouette detect anew for each value.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from tests.benchmarks.accuracy.run import rig_beside, true_tip
from tooltip_cli.log.recording import Recording, read_recording
from tooltip_cli.log.views import Views, resolve_rig, resolve_views
from tooltip_cli.method.rays import sphere_array
from tooltip_cli.method.voting.estimate import estimate_by_voting
from tooltip_cli.method.voting.moving import MovingEdges
from tooltip_cli.method.voting.params import VotingSettings
from tooltip_cli.rig.kinematics import inverse_transform
from tooltip_cli.stages.held_out import unlabelled
from tooltip_cli.stages.moving import find_moving_edges
from tooltip_cli.stages.voting import hand_edges, pair_views

SKIPPED = {"seed"}
DETECTED = {"pairing", "moving", "silhouette"}
SHARES = {
    "as_good",
    "other_end_support",
    "other_end_share",
    "wanted_support",
    "wanted_share",
    "far_share",
    "opposite_share",
}
"""Of the most there is: no more than one."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--groups", nargs="+", default=["voting", "end", "refine"])
    arguments = parser.parse_args()
    cases = [Case(path) for path in arguments.recordings if len(path.suffixes) == 1]
    print(_row("defaults", "", cases, VotingSettings()), flush=True)
    for group, name, value, settings in _variants(arguments.groups):
        print(_row(f"{group}.{name}", value, cases, settings), flush=True)


class Case:
    """One recording with its truth; detects once for each pairing and detection parameters."""

    def __init__(self, path: Path) -> None:
        self.recording: Recording = read_recording(path)
        rig = resolve_rig(self.recording, rig_beside(path))
        self.views: Views = resolve_views(self.recording, rig)
        truth = true_tip(path, self.recording.attachments)
        if truth is None:
            raise ValueError(f"{path}: the true tip is neither inside nor beside it")
        self.truth = truth
        self._default: MovingEdges | None = None

    def error_mm(self, settings: VotingSettings) -> float:
        """Return the nearest candidate's error; infinite where the estimate is refused."""
        edges = self._edges(settings)
        if edges is None:
            return float("inf")
        poses = inverse_transform(self.views.hand_from_camera)
        spheres = sphere_array([(item.center, item.radius) for item in self.views.spheres])
        found = estimate_by_voting(
            hand_edges(self.views, edges, poses, settings), spheres, settings
        )
        errors = [np.linalg.norm(item.position - self.truth) for item in found.candidates]
        return 1000 * float(min(errors, default=np.inf))

    def _edges(self, settings: VotingSettings) -> MovingEdges | None:
        usual = VotingSettings()
        same = all(getattr(settings, group) == getattr(usual, group) for group in DETECTED)
        if same and self._default is not None:
            return self._default
        allowed = unlabelled(self.recording, self.views.camera, None)
        pairing, _ = pair_views(self.views, settings, allowed)
        if len(pairing.frames) < settings.trust.min_frames:
            return None
        found = find_moving_edges(self.recording, self.views, pairing, settings, 2)
        if same:
            self._default = found
        return found


def _variants(groups: list[str]) -> Iterator[tuple[str, str, str, VotingSettings]]:
    settings = VotingSettings()
    for group in groups:
        params: Any = getattr(settings, group)
        for field in fields(params):
            value = getattr(params, field.name)
            if field.name in SKIPPED or not value:
                continue
            for factor in (0.5, 2.0):
                if isinstance(value, tuple):
                    changed: Any = tuple(item * factor for item in value)
                else:
                    changed = type(value)(value * factor)
                if field.name in SHARES:
                    changed = min(changed, 1.0)
                if isinstance(value, int) and field.name in ("block", "search"):
                    changed += 1 - changed % 2  # odd
                if changed == value or not changed:
                    continue
                varied: Any = replace(params, **{field.name: changed})
                shown = changed if isinstance(changed, tuple) else (changed,)
                text = ",".join(f"{item:g}" for item in shown)
                yield group, field.name, text, replace(settings, **{group: varied})


def _row(name: str, value: str, cases: list[Case], settings: VotingSettings) -> str:
    errors = np.array([case.error_mm(settings) for case in cases])
    answered = errors[np.isfinite(errors)]
    mean = f"{answered.mean():6.2f} {answered.max():6.2f}" if len(answered) else "     -      -"
    return f"{name:32} {value:>8} {mean}  {len(answered)} of {len(errors)} answered"


if __name__ == "__main__":
    main()
