"""Simulated recordings: the record stage with its labels beside it, made once and reused."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tooltip_cli.errors import TooltipError
from tooltip_cli.labels.files import write_labels
from tooltip_cli.log.container import LoggedAttachment, iterate
from tooltip_cli.log.crashsafe import MIN_FREE_BYTES
from tooltip_cli.log.stopping import Stop
from tooltip_cli.sources.base import SourceReport
from tooltip_cli.sources.sim import SimParams
from tooltip_cli.sources.simulated import TRUTH_FILE, SimSource
from tooltip_cli.stages.artifacts import plain
from tooltip_cli.stages.held_out import LABELS_SUFFIX
from tooltip_cli.stages.record import record


@dataclass(frozen=True)
class Simulated:
    """A simulated recording and the labels of its test frames."""

    recording: Path
    labels: Path
    reused: bool
    report: SourceReport  # empty when reused


def record_simulation(
    params: SimParams,
    out: Path,
    *,
    jobs: int = 1,
    overwrite: bool = False,
    min_free_bytes: int = MIN_FREE_BYTES,
    stop: Stop | None = None,
    keep_unfinished: bool = True,
    on_image: Callable[[], None] = lambda: None,
) -> Simulated:
    """Simulate a recording and write it and ``STEM.labels.csv`` beside it.

    Args:
        jobs: threads that render; the result does not depend on them.
        on_image: called after every image, for progress.

    The other arguments are those of :func:`tooltip_cli.stages.record.record`, and so is what
    happens when it is cut short; there are then no labels.

    Raises:
        TooltipError: the simulation cannot be set up, or a file exists or cannot be written.
    """
    labels = _labels_of(out)
    if labels.exists() and not overwrite:
        raise TooltipError(f"{labels} exists; give another name, or --force to replace it")
    source = SimSource(params, jobs)
    record(
        source,
        out,
        overwrite=overwrite,
        min_free_bytes=min_free_bytes,
        flush_every_s=None,  # equal parameters give equal bytes, however busy the machine is
        stop=stop,
        keep_unfinished=keep_unfinished,
        on_image=on_image,
    )
    write_labels(labels, source.labels())
    return Simulated(out, labels, False, source.report)


def reuse_simulation(
    params: SimParams,
    out: Path,
    *,
    jobs: int = 1,
    force: bool = False,
    on_image: Callable[[], None] = lambda: None,
) -> Simulated:
    """Do the same, or reuse a recording that was simulated with equal parameters.

    Raises:
        TooltipError: ``out`` is something else and ``force`` is false; see also
            :func:`record_simulation`.
    """
    known = out.exists() and not force
    if known:
        _check_same(params, out)
        labels = _labels_of(out)
        if labels.exists():
            return Simulated(out, labels, True, SourceReport())
    return record_simulation(
        params,
        out,
        jobs=jobs,
        overwrite=known or force,
        keep_unfinished=False,
        on_image=on_image,
    )


def _labels_of(recording: Path) -> Path:
    return recording.with_name(f"{recording.stem}{LABELS_SUFFIX}")


def _check_same(params: SimParams, path: Path) -> None:
    """Refuse to take a recording for another simulation, or to overwrite it."""
    stored = _stored_parameters(path)
    wanted = plain(dataclasses.asdict(params))
    different = [name for name in wanted if stored.get(name) != wanted[name]]
    if different:
        changes = ", ".join(
            f"{name} {stored.get(name)} instead of {wanted[name]}" for name in different
        )
        raise TooltipError(
            f"{path} was simulated with {changes}; give another directory, or --force to replace it"
        )


def _stored_parameters(path: Path) -> dict[str, Any]:
    try:
        for item in iterate(path):
            if isinstance(item, LoggedAttachment) and item.name == TRUTH_FILE:
                return dict(json.loads(item.data)["params"])
    except TooltipError as error:
        raise TooltipError(f"{error}; --force simulates it anew") from error
    except (KeyError, TypeError, ValueError) as error:
        raise TooltipError(
            f"{path} does not say how it was simulated ({error!r}); give another directory, or "
            "--force to replace it"
        ) from error
    raise TooltipError(
        f"{path} is no simulated recording; give another directory, or --force to replace it"
    )
