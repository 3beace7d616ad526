"""The watch stage: the estimate by voting, again and again while images arrive.

Images are paired as they come, and those that spread the hand's orientations most are looked at and
held. Estimates are made from what is held, by the functions that the estimate stage calls, in a
thread of their own, so that images are taken meanwhile.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Container
from dataclasses import dataclass, field

import numpy as np

from tooltip_cli.errors import TooltipError
from tooltip_cli.log.messages import Message
from tooltip_cli.log.stopping import Stop
from tooltip_cli.method.types import TipEstimate
from tooltip_cli.method.voting.params import VotingSettings
from tooltip_cli.method.voting.watching import MotionWatch, Verdict
from tooltip_cli.rig.rigfile import Rig
from tooltip_cli.stages.feeds import Feed
from tooltip_cli.stages.held import HeldEstimator, Snapshot
from tooltip_cli.stages.keeping import FrameKeeper
from tooltip_cli.stages.poses import PosedImage
from tooltip_cli.stages.threads import threads_are_ours
from tooltip_cli.stages.voting import focal_px

_NOISE_PAIRS = 8
_LATE_S = 0.5  # behind the newest image, from which on images are passed over
_STATUS_EVERY_S = 0.25
_JUDGE_EVERY_S = 1.0
_SAY_MISSING_S = 3.0


@dataclass(frozen=True)
class WatchOptions:
    """When estimates are made, and when it ends."""

    every_s: float = 1.0  # between the beginnings of two estimates, at least
    until_enough: bool = False  # end once as many images are held as may be, and show a tip
    duration_s: float | None = None  # from the first image on


@dataclass(frozen=True)
class Counts:
    """Images so far."""

    images: int = 0  # received
    held: int = 0  # that an estimate is made from
    passed_over: int = 0  # that would have been held, had there been time to look at them
    unreadable: int = 0
    dropped: int = 0  # messages that did not fit in the queue


@dataclass(frozen=True)
class Update:
    """One estimate and what it was made from."""

    estimate: TipEstimate
    time_s: float  # between the first image and the last that was taken into account
    stamp_ns: int  # of the latter
    delay_s: float  # from the arrival of the latter to this estimate
    compute_s: float  # that the estimate took
    behind_s: float  # longest since the last update from an image's arrival to its being taken
    counts: Counts
    verdict: Verdict | None  # on the motion
    final: bool


@dataclass(frozen=True)
class WatchStatus:
    """How things stand between updates."""

    update: Update | None
    counts: Counts
    verdict: Verdict | None
    ending: bool  # the last estimate is being made


@dataclass
class _Request:
    """An estimate that is asked for, and what became of it."""

    snapshot: Snapshot
    counts: Counts
    final: bool
    began: float = field(default_factory=time.monotonic)
    done: threading.Event = field(default_factory=threading.Event)
    result: TipEstimate | BaseException | None = None

    def estimate(self) -> TipEstimate:
        """Wait for the estimate, and return or raise what came of it."""
        self.done.wait()
        if isinstance(self.result, BaseException):
            raise self.result
        assert self.result is not None  # noqa: S101 - it is done
        return self.result


class _Estimator:
    """Makes estimates one after the other, in one thread, whose memory each takes over."""

    def __init__(self, rig: Rig, settings: VotingSettings) -> None:
        self._held = HeldEstimator(rig, settings)
        self._requests: queue.SimpleQueue[_Request] = queue.SimpleQueue()
        # a daemon: whoever presses Ctrl-C a second time waits for nothing
        threading.Thread(target=self._work, daemon=True).start()

    def ask(self, request: _Request) -> None:
        """Make an estimate as soon as those before it are made."""
        self._requests.put(request)

    def _work(self) -> None:
        while True:
            request = self._requests.get()
            try:
                request.result = self._held.estimate(request.snapshot, final=request.final)
            except BaseException as error:  # raised again where it is waited for
                request.result = error
            request.done.set()


def watch(
    feed: Feed,
    rig: Rig,
    options: WatchOptions,
    settings: VotingSettings,
    *,
    stop: Stop,
    left_out: Container[int] = frozenset(),
    on_update: Callable[[Update], None] = lambda update: None,
    on_status: Callable[[WatchStatus], None] = lambda status: None,
    on_note: Callable[[str], None] = lambda note: None,
) -> Update:
    """Estimate the tip again and again from what a feed brings, and return the last estimate.

    It ends when ``stop`` is requested, the feed has ended, after the duration, or when there is
    enough; the last estimate is then made from everything.

    Args:
        left_out: header stamps of images that must not be used.
        on_update: called with every estimate, the last one included.
        on_status: called four times a second.
        on_note: called with sentences for a person.

    Raises:
        TooltipError: no image came, or the hand's pose never became known; images do not fit the
            rig.
    """
    with threads_are_ours():
        return _Watch(feed, rig, options, settings, left_out, on_update, on_status, on_note).run(
            stop
        )


class _Watch:
    def __init__(
        self,
        feed: Feed,
        rig: Rig,
        options: WatchOptions,
        settings: VotingSettings,
        left_out: Container[int],
        on_update: Callable[[Update], None],
        on_status: Callable[[WatchStatus], None],
        on_note: Callable[[str], None],
    ) -> None:
        self._feed, self._rig, self._options, self._settings = feed, rig, options, settings
        self._on_update, self._on_status, self._on_note = on_update, on_status, on_note
        self._keeper = FrameKeeper(rig, settings, left_out)
        self._motion: MotionWatch | None = None
        self._verdict: Verdict | None = None
        self._judged = self._behind_s = 0.0
        self._images = 0
        self._first_image: float | None = None
        self._missing_told = ""
        self._estimator = _Estimator(rig, settings)
        self._running: _Request | None = None
        self._seen_changes = 0  # of what is held, that an estimate was begun with
        self._began = -np.inf
        self._update: Update | None = None

    def run(self, stop: Stop) -> Update:
        """Take what comes until an end is reached."""
        shown = 0.0
        try:
            while True:
                # asked before taking: what came before the end is still taken
                end = stop.reason or self._feed.ended() or self._over()
                self._take(self._feed.take())
                self._estimate()
                if time.monotonic() - shown > _STATUS_EVERY_S:
                    shown = time.monotonic()
                    self._tell()
                if end:
                    break
        finally:
            rest = self._feed.close()
        self._take(rest, at_end=True)
        self._tell()
        return self._last(end)

    def _take(self, messages: list[Message], *, at_end: bool = False) -> None:
        keeper = self._keeper
        for message in messages:
            if message.topic == self._feed.image_topic:
                self._images += 1
                self._first_image = self._first_image or time.monotonic()
            try:
                keeper.follower.take(message)
            except TooltipError:
                raise
            except Exception as error:  # the decoder meets arbitrary bytes
                raise TooltipError(
                    f"{message.topic} carries no {message.datatype} ({error!r}); name another topic"
                ) from error
        late_s = _LATE_S if self._feed.paced else float("inf")
        for image in keeper.advance(self._feed.clock.now_ns, late_s, at_end=at_end):
            self._judge(image)
        self._behind_s = max(self._behind_s, keeper.behind_s)

    def _judge(self, image: PosedImage) -> None:
        if self._motion is None:
            camera = self._keeper.camera
            assert camera is not None  # noqa: S101 - known where there are poses
            self._motion = MotionWatch(focal_px(camera), self._settings)
        self._motion.add(image.camera_from_hand, image.stamp_ns / 1e9)
        if time.monotonic() - self._judged > _JUDGE_EVERY_S:
            self._verdict = self._motion.judge()
            self._judged = time.monotonic()

    def _estimate(self) -> None:
        """Hand on an estimate that is done, and begin the next where there is anything new."""
        running, now = self._running, time.monotonic()
        if running is not None:
            if not running.done.is_set():
                return
            self._finish(running)
        new = self._keeper.changes != self._seen_changes
        if new and now - self._began >= self._options.every_s:
            self._begin()

    def _begin(self, *, final: bool = False) -> _Request:
        self._began, self._seen_changes = time.monotonic(), self._keeper.changes
        self._running = _Request(self._keeper.snapshot(), self._counts(), final)
        self._estimator.ask(self._running)
        return self._running

    def _finish(self, running: _Request) -> Update:
        self._running = None
        snapshot = running.snapshot
        self._update = Update(
            running.estimate(),
            snapshot.time_s,
            snapshot.stamp_ns,
            (self._feed.clock.now_ns() - snapshot.arrival_ns) / 1e9,
            time.monotonic() - running.began,
            self._behind_s,
            running.counts,
            self._verdict,
            running.final,
        )
        self._behind_s = 0.0
        self._on_update(self._update)
        return self._update

    def _last(self, reason: str) -> Update:
        """Make the last estimate, from everything."""
        if not self._images:
            raise TooltipError(f"no image came on {self._feed.image_topic}: {reason}")
        keeper = self._keeper
        if keeper.camera is None or keeper.follower.missing:
            raise TooltipError(
                f"the hand's pose is unknown at every image: {keeper.follower.missing or reason}"
            )
        if self._motion is not None:
            self._verdict = self._motion.judge()
        running = self._begin(final=True)
        while not running.done.wait(_STATUS_EVERY_S):
            self._tell(ending=True)
        return self._finish(running)

    def _over(self) -> str:
        options, update = self._options, self._update
        since = time.monotonic() - (self._first_image or time.monotonic())
        if options.duration_s is not None and since >= options.duration_s:
            return f"{options.duration_s:g} s are over"
        shown = update is not None and update.estimate.position is not None
        enough = options.until_enough and shown and self._keeper.full
        return "the motion is enough" if enough else ""

    def _tell(self, *, ending: bool = False) -> None:
        for note in self._feed.news():
            self._on_note(note)
        missing = self._keeper.follower.missing
        since = time.monotonic() - (self._first_image or time.monotonic())
        if since > _SAY_MISSING_S and missing not in ("", self._missing_told):
            self._missing_told = missing
            self._on_note(f"no estimate can be made yet: {missing}")
        self._on_status(WatchStatus(self._update, self._counts(), self._verdict, ending))

    def _counts(self) -> Counts:
        keeper = self._keeper
        return Counts(
            self._images, keeper.held, keeper.passed_over, keeper.unreadable, self._feed.dropped()
        )
