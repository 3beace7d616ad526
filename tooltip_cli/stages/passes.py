"""One pass through a recording's images for all who want something of them."""

from __future__ import annotations

from collections.abc import Sequence, Set
from typing import Protocol, TypeVar

from tooltip_cli.log.recording import LoggedImage, Recording
from tooltip_cli.stages.clock import Lap, laps
from tooltip_cli.stages.threads import in_order

_FEWEST, _MOST = 16, 64  # images of a part
_PARTS_A_THREAD = 4  # at least, so that none is idle for long at the end

_Result = TypeVar("_Result")
_Taken = TypeVar("_Taken", covariant=True)
_Given = TypeVar("_Given", contravariant=True)


class Part(Protocol[_Taken]):
    """What a job makes of some neighbouring images; on a thread of its own."""

    @property
    def wanted(self) -> Set[int]:
        """Images to be shown; some may lie beyond the part's own."""

    def take(self, index: int, image: LoggedImage, lap: Lap) -> None:
        """Look at a wanted image. They come in ascending order."""

    def result(self) -> _Taken:
        """Return what was made, after all wanted images."""


class Job(Protocol[_Result]):
    """Somebody who wants something of a recording's images."""

    def part(self, start: int, stop: int) -> Part[_Result]:
        """Return the part of images ``start`` to ``stop - 1``."""

    def add(self, result: _Result) -> None:
        """Take what a part has made; in the order of the images."""


def look_through(recording: Recording, jobs: Sequence[Job[_Result]], threads: int) -> None:
    """Show each image once to all jobs that want it there; results do not depend on ``threads``.

    Images that parts on both sides of a border want are shown twice, so that no thread waits for
    another. Memory: what so many parts keep.

    Raises:
        TooltipError: an image cannot be decoded.
    """
    count = len(recording.image_stamps_ns)
    fair = _MOST if threads == 1 else count // (_PARTS_A_THREAD * threads)
    size = min(max(fair, _FEWEST), _MOST)

    def work(start: int) -> list[list[_Result]]:
        parts = [job.part(start, min(start + size, count)) for job in jobs]
        wanted = sorted(set().union(*(part.wanted for part in parts)))
        lap = laps()
        for index, image in zip(wanted, recording.logged_images(wanted), strict=True):
            for part in parts:
                if index in part.wanted:
                    part.take(index, image, lap)
        return [[part.result() for part in parts]]

    for results in in_order(work, range(0, count, size), threads):
        for job, result in zip(jobs, results, strict=True):
            job.add(result)
