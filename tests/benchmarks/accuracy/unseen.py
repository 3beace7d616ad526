"""Accuracy on fifteen tools that the product does not have and no parameter was chosen on.

Example:
    python -m tests.benchmarks.accuracy.unseen --work /tmp/unseen --seeds 11 12
    python -m tests.benchmarks.accuracy.unseen --work /tmp/unseen --perturb tilt- grip- --tools hook

The tools are those of ``unseen_tools.py``; the simulator learns of them for this run alone. What is
behind changes with tool and seed. Recordings are made once under ``--work`` and reused.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from tests.benchmarks.accuracy.run import PERTURBATIONS, score_all, simulated
from tests.benchmarks.accuracy.unseen_tools import UNSEEN
from tooltip_cli.sources.sim import BACKGROUNDS, params
from tooltip_cli.sources.sim.tools import HELD

SCENES = tuple(name for name in BACKGROUNDS if name != "auto")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", type=Path, required=True, help="directory for what is made")
    parser.add_argument("--tools", nargs="+", default=list(UNSEEN), choices=list(UNSEEN))
    parser.add_argument("--seeds", nargs="+", type=int, default=[11])
    parser.add_argument("--perturb", nargs="+", default=["none"], choices=list(PERTURBATIONS))
    parser.add_argument("--methods", nargs="+", default=["voting"])
    arguments = parser.parse_args()
    HELD.update(UNSEEN)
    params.TOOLS = (*params.TOOLS, *UNSEEN)
    cases = simulated(arguments.work, arguments.tools, arguments.seeds, arguments.perturb, scene_of)
    score_all(cases, arguments.methods, arguments.work)


def scene_of(tool: str, seed: int) -> dict[str, Any]:
    """Return what else is changed for a tool and a seed: each of five scenes in turn."""
    return {"background": SCENES[(list(UNSEEN).index(tool) + seed) % len(SCENES)]}


if __name__ == "__main__":
    main()
