"""``tooltip demo``: simulated tools through every stage."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

from tooltip_cli.cli.evaluate import EXIT_CODES, print_summary
from tooltip_cli.cli.options import (
    PATH,
    force_option,
    json_option,
    print_json,
    progress,
    say,
)
from tooltip_cli.errors import MissingExtraError, TooltipError

if TYPE_CHECKING:
    from tooltip_cli.sources.sim import SimParams

_NEEDED = {"skimage": ("sim", "scikit-image"), "matplotlib": ("report", "matplotlib")}


@click.command()
@click.argument("directory", type=PATH, default="demo", metavar="[DIR]")
@click.option(
    "--tools",
    default="pen,pliers,hammer",
    show_default=True,
    help="Names as in 'tooltip record sim --tool', with commas between them, or all.",
)
@click.option(
    "--frames",
    type=click.IntRange(min=2),
    default=500,
    show_default=True,
    help="Images of each recording.",
)
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Of grasp, motion and noise.",
)
@click.option(
    "--jobs",
    type=click.IntRange(min=1),
    default=lambda: os.cpu_count() or 1,
    show_default="number of cores",
    help="Threads; the result does not depend on their number.",
)
@force_option
@json_option
@click.pass_context
def demo(
    ctx: click.Context,
    directory: Path,
    tools: str,
    frames: int,
    seed: int,
    jobs: int,
    force: bool,
    as_json: bool,
) -> None:
    """Simulate recordings and take them through every stage.

    For each tool: record sim, detect, estimate; then one report over all of them. Everything is
    written to DIR, 'demo' by default, and what an earlier run left there is reused where it was
    made with the same options.

    \b
    Examples:
      tooltip demo
      tooltip demo ten-tools --tools all
      tooltip demo small --tools bottle,scissors --frames 200 --seed 7
    """
    from tooltip_cli.sources.sim import SimParams
    from tooltip_cli.stages.artifacts import ensure_directory, plain
    from tooltip_cli.stages.evaluate import evaluate

    _check_extras()
    chosen = [SimParams(tool=name, frames=frames, seed=seed) for name in names(tools)]
    ensure_directory(directory)
    recordings = [directory / f"{params.tool}.mcap" for params in chosen]
    for params, path in zip(chosen, recordings, strict=True):
        _simulate(params, path, jobs, force)
        _detect(path, frames - 1, jobs, force)
        _estimate(path, jobs, force)
    with progress(None, "evaluate") as advance:
        report = evaluate(
            recordings,
            force=force,
            jobs=jobs,
            on_pair=advance,
            on_step=lambda path, text: say(f"{path}: {text}"),
        )
    if as_json:
        print_json(plain(report))
    else:
        print_summary(report)
    ctx.exit(EXIT_CODES[report.status])


def names(tools: str) -> list[str]:
    """Return the tools that ``--tools`` names, each once.

    Raises:
        TooltipError: it names none.
    """
    from tooltip_cli.sources.sim import TOOLS

    found = list(dict.fromkeys(name.strip() for name in tools.split(",") if name.strip()))
    if not found:
        raise TooltipError(f"--tools names no tool; known: {', '.join(TOOLS)}, or all")
    return list(TOOLS) if found == ["all"] else found


def _check_extras() -> None:
    """Refuse before minutes of work what would fail at its end."""
    for module, (extra, package) in _NEEDED.items():
        if importlib.util.find_spec(module) is None:
            raise MissingExtraError("demo", extra, package)


def _simulate(params: SimParams, path: Path, jobs: int, force: bool) -> None:
    from tooltip_cli.stages.simulate import reuse_simulation

    with progress(params.frames, f"record {path.name}") as advance:
        found = reuse_simulation(params, path, jobs=jobs, force=force, on_image=advance)
    say(f"{path}: {_how(found.reused)} {params.frames} images")


def _detect(path: Path, pairs: int, jobs: int, force: bool) -> None:
    from tooltip_cli.stages.detect import detect

    with progress(pairs, f"detect {path.name}") as advance:
        found = detect(path, preset="voting", force=force, jobs=jobs, on_pair=advance)
    say(f"{path}: {_how(found.reused)} {found.path}")


def _estimate(path: Path, jobs: int, force: bool) -> None:
    from tooltip_cli.stages.estimate import estimate

    with progress(None, f"estimate {path.name}") as advance:
        found = estimate(path, force=force, jobs=jobs, on_pair=advance)
    say(f"{path}: {_how(found.reused)} {found.path}")


def _how(reused: bool) -> str:
    return "reused" if reused else "computed"
