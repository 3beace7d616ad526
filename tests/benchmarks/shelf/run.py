"""What a shelf costs beside the work on its recordings.

python tests/benchmarks/shelf/run.py engines            overhead of a recording, start-up
python tests/benchmarks/shelf/run.py rows FOLDER        planning, resuming, tables of 10,000 rows
python tests/benchmarks/shelf/run.py jobs FOLDER OUT    recordings of FOLDER on one process, on two
python tests/benchmarks/shelf/run.py bucket FOLDER OUT  the same on one, from a bucket on loopback
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from tooltip_cli.stages.shelf.cluster import on_dask
from tooltip_cli.stages.shelf.plan import read_shelf
from tooltip_cli.stages.shelf.pool import on_processes
from tooltip_cli.stages.shelf.run import in_order, plan_run, write_results
from tooltip_cli.stages.shelf.summary import shelf_report, stored_rows, write_report
from tooltip_cli.stages.shelf.table import Row
from tooltip_cli.stages.shelf.work import Outcome, Task, store_row, work_on

SIZES = (625, 1250, 2500, 5000, 10_000)


def nothing(task: int) -> int:
    """Return at once."""
    return task


def engines(tasks: int = 2000) -> None:
    """Print start-up, the first answer, and the cost of each further task."""
    for name, engine in (
        ("processes, 1", on_processes(nothing, range(tasks), 1)),
        ("processes, 2", on_processes(nothing, range(tasks), 2)),
        ("dask local, 2", on_dask(nothing, range(tasks), "local", 2)),
    ):
        start = time.perf_counter()
        first = 0.0
        for number, _ in enumerate(engine):
            first = first or time.perf_counter() - start
            last = time.perf_counter() - start
            assert number < tasks
        each = 1000 * (last - first) / (tasks - 1)
        print(f"{name}: first answer after {first:.2f} s, then {each:.3f} ms a task")


@contextmanager
def timed(times: dict[str, float], name: str) -> Iterator[None]:
    """Note how long the block takes."""
    start = time.perf_counter()
    yield
    times[name] = time.perf_counter() - start


def make(folder: Path, size: int) -> Path:
    """Make a shelf of small files, as many as asked for, a hundred in a folder."""
    shelf = folder / f"shelf-{size}"
    shutil.rmtree(shelf / "run", ignore_errors=True)
    for number in range(size):
        path = shelf / f"{number // 100:04d}" / f"r{number:06d}.mcap"
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            path.write_bytes(b"\x89MCAP0\r\n" + b"0" * 100)
            path.with_suffix(".labels.csv").write_text("stamp_ns,u,v,state,labeler\n")
    return shelf


def synthetic(task: Task, number: int) -> Row:
    """Return a row such as an evaluated recording has, with its tip file."""
    rng = np.random.default_rng(number)
    tip = Path(str(task.folder)) / f"{task.item.recording.stem}.tip.json"
    tip.parent.mkdir(parents=True, exist_ok=True)
    tip.write_text("{}")
    values = asdict(work_on(replace(task, version="0")).row)
    numbers = {name: float(rng.normal()) for name in values if name.startswith(("tip_", "cov_"))}
    numbers |= {name: float(rng.gamma(2)) for name in ("error_px", "baseline_px", "seconds")}
    del numbers["tip_error_mm"], numbers["tip_file"]
    day = number / 40
    moment = datetime.datetime(2026, 1, 1, tzinfo=datetime.timezone.utc)
    texts = {
        "status": "refused" if number % 17 == 3 else "ok",
        "code": "too_few_views" if number % 17 == 3 else None,
        "reason": "the wrist hardly turns" if number % 17 == 3 else None,
        "tip_file": str(tip),
        "tool": f"tool {number % 12}",
        "rig_id": f"{number % 3:012x}",
        "recorded": (moment + datetime.timedelta(days=day)).isoformat(timespec="milliseconds"),
    }
    if number % 3 == 1:  # a rig whose camera moves
        numbers["baseline_px"] *= 1 + day / 200
    if number % 17 == 3:
        numbers = {"seconds": numbers["seconds"]}
    return Row(**{**values, **numbers, **texts})


def one_size(folder: Path, size: int) -> None:
    """Print times and memory of one size as JSON; a process of its own, for its memory's sake."""
    shelf, times = make(folder, size), dict[str, float]()
    with timed(times, "plan"):
        found = read_shelf(str(shelf))
        plan = plan_run(found.items, found.out)
    for number, task in enumerate(plan.tasks):
        store_row(task, synthetic(task, number))
    for task in plan.tasks[::100]:
        Path(str(task.folder), "row.json").unlink()
    with timed(times, "resume"):
        plan = plan_run(read_shelf(str(shelf)).items, found.out)
    assert len(plan.tasks) == len(range(0, size, 100))
    rows = [Outcome(synthetic(task, number), False).row for number, task in enumerate(plan.tasks)]
    with timed(times, "table"):
        everything = in_order(plan, rows)
        write_results(everything, found.out / "results")
    with timed(times, "report"):
        report = shelf_report(stored_rows(found.out / "results.csv"), "results.csv")
        write_report(report, found.out / "report")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"size": size, "peak_mb": peak, **times}))


def rows(folder: Path) -> None:
    """Print times and memory of all sizes, and the exponents of their growth."""
    found = []
    for size in SIZES:
        command = [sys.executable, __file__, "one", str(folder), "--size", str(size)]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        found.append(json.loads(done.stdout))
        print(done.stdout.strip())
    for name in ("plan", "resume", "table", "report"):
        slope = np.polyfit(np.log(SIZES), np.log([item[name] for item in found]), 1)[0]
        print(f"{name}: grows with the power {slope:.2f} of the number of rows")


def run_shelf(shelf: str, jobs: int, out: Path) -> float:
    """Run a shelf anew; print wall and processor seconds and return the first."""
    shutil.rmtree(out, ignore_errors=True)
    command = [sys.executable, "-m", "tooltip_cli.cli.main", "run", shelf, "--out", str(out)]
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([*command, "--jobs", str(jobs), "--no-report"], check=True, capture_output=True)
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    user, system = after.ru_utime - before.ru_utime, after.ru_stime - before.ru_stime
    print(f"{shelf}, {jobs} jobs: {wall:.1f} s wall, {user:.1f} s user, {system:.1f} s system")
    return wall


def from_bucket(folder: Path, out: Path) -> None:
    """Print what a shelf takes from a folder and from a bucket of a server on this machine."""
    sys.path.insert(0, str(Path(__file__).parents[3]))
    from tests.helpers.bucket import BUCKET, environment, serve

    run_shelf(str(folder), 1, out)
    with serve() as server:
        server.upload(folder, "shelf")
        os.environ.update(environment(server.port))
        run_shelf(f"s3://{BUCKET}/shelf", 1, out)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("engines", "rows", "one", "jobs", "bucket"))
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("out", type=Path, nargs="?")
    parser.add_argument("--size", type=int)
    given = parser.parse_args()
    if given.what == "engines":
        engines()
    elif given.what == "rows":
        rows(given.folder)
    elif given.what == "jobs":
        one, two = (run_shelf(str(given.folder), jobs, given.out) for jobs in (1, 2))
        print(f"two processes are {one / two:.2f} times one")
    elif given.what == "bucket":
        from_bucket(given.folder, given.out)
    else:
        one_size(given.folder, given.size)
