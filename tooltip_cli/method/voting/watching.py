"""The motion while it is recorded: is it enough, and if not, what should the hand do?

It asks what the estimate will ask: the same pairing, the same thresholds.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from tooltip_cli.method.motion import hand_motion
from tooltip_cli.method.types import Array
from tooltip_cli.method.voting.estimate import check_motion, view_spread_deg
from tooltip_cli.method.voting.pairing import pair_frames
from tooltip_cli.method.voting.params import VotingSettings

WAITING, KEEP_GOING, SLOWER, TILT, ENOUGH = "waiting", "keep_going", "slower", "tilt", "enough"
_ADVICE = {
    WAITING: "no hand pose yet",
    KEEP_GOING: "keep going",
    SLOWER: "slower",
    TILT: "tilt the wrist out of the image plane",
    ENOUGH: "enough",
}
_REMEMBERED = 1800  # images: a minute at 30 Hz


@dataclass(frozen=True)
class Verdict:
    """What the motion so far can show."""

    code: str  # waiting, keep_going, slower, tilt or enough
    frames: int  # images with usable partners, at most as many as an estimate uses
    wanted_frames: int
    view_deg: float  # between the camera's directions, seen from the hand
    turn_deg: float  # between any two orientations of the hand
    motion_px: float  # of a tool's end from image to image, median of the last images

    @property
    def advice(self) -> str:
        """What to tell the person at the robot."""
        return _ADVICE[self.code]


class MotionWatch:
    """Collects the hand's poses and judges them.

    Args:
        focal_px: pixels per unit of normalized coordinates.
        settings: what the estimate will use.
        recent: images that say how fast the hand moves now.
    """

    def __init__(self, focal_px: float, settings: VotingSettings, recent: int = 30) -> None:
        self._focal, self._settings, self._recent = focal_px, settings, recent
        self._poses: deque[Array] = deque(maxlen=_REMEMBERED)
        self._times: deque[float] = deque(maxlen=_REMEMBERED)
        self._best: Verdict | None = None

    def add(self, camera_from_hand: Array, time_s: float) -> None:
        """Take the pose (4, 4) at one image; NaN where it is unknown. Earlier times are ignored."""
        if not self._times or time_s > self._times[-1]:
            self._poses.append(camera_from_hand)
            self._times.append(time_s)

    @property
    def ample(self) -> bool:
        """Whether there are as many usable images as an estimate would look at."""
        return self._best is not None and self._best.frames >= self._best.wanted_frames

    def judge(self) -> Verdict:
        """Return the verdict on everything so far; once enough, it stays enough."""
        if self.ample and self._best is not None:
            return self._best
        settings = self._settings
        wanted = settings.pairing.frames
        poses = np.array(self._poses).reshape(-1, 4, 4)
        known = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
        if not known.any():
            return self._best or Verdict(WAITING, 0, wanted, 0.0, 0.0, 0.0)
        pairing = pair_frames(poses, self._focal, settings.pairing, known)
        spread = view_spread_deg(poses[pairing.frames]) if len(pairing.frames) > 1 else 0.0
        now = pair_frames(poses[-self._recent :], self._focal, settings.pairing)
        motion = hand_motion(poses[known], np.array(self._times)[known])
        reason = check_motion(pairing, poses, settings)
        verdict = Verdict(
            ENOUGH, len(pairing.frames), wanted, spread, motion.turn_deg, now.fastest_px
        )
        if reason is None:
            self._best = verdict
            return verdict
        if self._best is not None:
            return replace(self._best, motion_px=now.fastest_px)
        code = KEEP_GOING
        if reason.code == "depth_unobservable":
            code = TILT
        elif now.fastest_px > settings.pairing.fastest_px:
            code = SLOWER
        return replace(verdict, code=code)
