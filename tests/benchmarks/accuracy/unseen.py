"""Accuracy on tools that the product does not have: two sets, made for this alone.

Example:
    python -m tests.benchmarks.accuracy.unseen --work /tmp/unseen --seeds 11 12
    python -m tests.benchmarks.accuracy.unseen --work /tmp/unseen --set second --seeds 21
    python -m tests.benchmarks.accuracy.unseen --work /tmp/unseen --perturb tilt- grip- --tools hook

The first set is that of ``unseen_tools.py``, the second of ``more_unseen_tools.py``; the simulator
learns of them for this run alone. What is behind changes with tool and seed. Recordings are made
once under ``--work`` and reused.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from tests.benchmarks.accuracy.more_unseen_tools import MORE_UNSEEN
from tests.benchmarks.accuracy.run import PERTURBATION_NAMES, score_all, simulated
from tests.benchmarks.accuracy.unseen_tools import UNSEEN
from tooltip_cli.sources.sim import BACKGROUNDS, params
from tooltip_cli.sources.sim.tools import HELD

SCENES = tuple(name for name in BACKGROUNDS if name != "auto")
SETS = {"first": UNSEEN, "second": MORE_UNSEEN}
ALL = {**UNSEEN, **MORE_UNSEEN}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", type=Path, required=True, help="directory for what is made")
    parser.add_argument("--set", default="first", choices=list(SETS), help="which tools")
    parser.add_argument(
        "--tools", nargs="+", choices=list(ALL), metavar="TOOL", help="instead of a set"
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=[11])
    parser.add_argument("--perturb", nargs="+", default=["none"], choices=PERTURBATION_NAMES)
    parser.add_argument("--methods", nargs="+", default=["voting"])
    arguments = parser.parse_args()
    HELD.update(ALL)
    params.TOOLS = (*params.TOOLS, *ALL)
    tools = arguments.tools or list(SETS[arguments.set])
    cases = simulated(arguments.work, tools, arguments.seeds, arguments.perturb, scene_of)
    score_all(cases, arguments.methods, arguments.work)


def scene_of(tool: str, seed: int) -> dict[str, Any]:
    """Return what else is changed for a tool and a seed: each of five scenes in turn."""
    return {"background": SCENES[(list(ALL).index(tool) + seed) % len(SCENES)]}


if __name__ == "__main__":
    main()
