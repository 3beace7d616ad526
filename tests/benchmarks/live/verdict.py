"""Read recordings through the live observer, and compare its verdict with the estimate.

python -m tests.benchmarks.live.verdict pen.mcap hammer.mcap ...
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from tests.benchmarks.live.replay import tooltip
from tooltip_cli.log.container import LoggedMessage, iterate
from tooltip_cli.log.messages import Message
from tooltip_cli.log.recording import read_recording
from tooltip_cli.log.views import resolve_rig
from tooltip_cli.method.voting.watching import ENOUGH
from tooltip_cli.stages.watching import MotionObserver

_JUDGE_EVERY = 200  # messages


def main(paths: list[Path]) -> None:
    agreed = 0
    for path in paths:
        beside = path.with_name(f"{path.stem}.rig.yaml")
        named = beside if beside.exists() else None
        observer = MotionObserver(resolve_rig(read_recording(path), named))
        for index, item in enumerate(iterate(path)):
            if isinstance(item, LoggedMessage):
                observer.take(Message(item.topic, item.datatype, item.log_time_ns, item.payload))
            if index % _JUDGE_EVERY == 0:
                observer.verdict(now=True)
        verdict = observer.verdict(now=True)
        code = verdict.code if verdict is not None else observer.problem
        with tempfile.TemporaryDirectory() as name:
            # away from labels, whose frames an estimate leaves out: a live recording has none yet
            alone = Path(name, path.name)
            alone.symlink_to(path.resolve())
            rig = ("--rig", named) if named else ()
            done = tooltip("estimate", alone, *rig, "--out", name)
        status = {0: "ok", 3: "refused"}.get(done.returncode, done.stderr)
        agrees = (code == ENOUGH) == (status == "ok")
        agreed += agrees
        print(f"{path.name}: live {code}, estimate {status}{'' if agrees else '  DISAGREE'}")
        if status == "refused":
            print("   ", done.stderr.strip().splitlines()[-1])
    print(f"{agreed} of {len(paths)} agree")


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]])
