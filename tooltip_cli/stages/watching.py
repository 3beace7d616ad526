"""The live verdict on the motion while messages arrive."""

from __future__ import annotations

import logging
import time

import numpy as np

from tooltip_cli.errors import TooltipError
from tooltip_cli.log.messages import Message
from tooltip_cli.method.voting.params import VotingSettings
from tooltip_cli.method.voting.watching import MotionWatch, Verdict
from tooltip_cli.rig.rigfile import Rig
from tooltip_cli.stages.poses import PoseFollower

_LOG = logging.getLogger(__name__)
_JUDGE_EVERY_S = 1.0


class MotionObserver:
    """Reads along what is recorded and judges the motion.

    Args:
        rig: which frames are hand and camera.
    """

    def __init__(self, rig: Rig) -> None:
        self._poses = PoseFollower(rig)
        self._watch: MotionWatch | None = None
        self._verdict: Verdict | None = None
        self._judged = 0.0
        self._problem = ""

    def take(self, message: Message) -> None:
        """Read along; what cannot be used is left to later commands to complain about."""
        if self._problem:
            return
        try:
            self._poses.take(message)
        except TooltipError as error:
            self._problem = str(error)
        except Exception as error:  # the decoder meets arbitrary bytes
            self._problem = f"{message.topic} carries no {message.datatype} ({error!r})"
        if self._watch is None and self._poses.ready and self._poses.camera is not None:
            camera = self._poses.camera
            self._watch = MotionWatch(float(np.sqrt(camera.fx * camera.fy)), VotingSettings())

    @property
    def ample(self) -> bool:
        """Whether more motion would not be looked at."""
        return self._watch is not None and self._watch.ample

    @property
    def problem(self) -> str:
        """Why the motion is not judged; empty where it is."""
        if self._problem or self._watch is not None:
            return self._problem
        return self._poses.missing

    def verdict(self, *, now: bool = False) -> Verdict | None:
        """Return the verdict, a second old at most; None: nothing can be said yet."""
        if self._watch is None or self._problem:
            return self._verdict
        try:
            for image in self._poses.passed():
                self._watch.add(image.camera_from_hand, image.stamp_ns / 1e9)
            if now or time.monotonic() - self._judged > _JUDGE_EVERY_S:
                self._verdict = self._watch.judge()
                self._judged = time.monotonic()
        except Exception as error:  # whatever numbers came: the recording goes on without a verdict
            _LOG.warning("the motion is not judged any more", exc_info=True)
            self._problem = repr(error)
        return self._verdict
