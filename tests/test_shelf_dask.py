"""A shelf on a real Dask scheduler with two real workers, of which some are killed."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from tests.helpers.cli import tooltip
from tests.helpers.cluster import ROOT, Cluster
from tests.helpers.shelves import METHOD, contents, hoard, make_shelf, stamps, table
from tests.helpers.work import misbehave
from tooltip_cli.stages.shelf.cluster import on_dask
from tooltip_cli.stages.shelf.plan import read_shelf
from tooltip_cli.stages.shelf.pool import Died
from tooltip_cli.stages.shelf.run import plan_run
from tooltip_cli.stages.shelf.work import work_on

pytest.importorskip("distributed")


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    """Return a running cluster of two workers."""
    cluster = Cluster(tmp_path)
    try:
        cluster.start(2)
        yield cluster
    finally:
        cluster.stop()


@pytest.fixture
def shelf(wrist_file: Path, tmp_path: Path) -> Path:
    """Return a shelf of eight recordings, one of them broken."""
    return make_shelf(tmp_path / "shelf", wrist_file, 7)


def running(shelf: Path, cluster: Cluster) -> subprocess.Popen[str]:
    """Return a run on the cluster of which three recordings have ended."""
    command = [sys.executable, "-m", "tooltip_cli.cli.main", "run", str(shelf), *METHOD]
    process = subprocess.Popen(
        [*command, "--dask", cluster.address],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )
    assert process.stdout is not None
    for _ in range(3):
        assert process.stdout.readline()
    return process


def test_a_lost_worker_costs_nothing_but_time(cluster: Cluster, shelf: Path) -> None:
    process = running(shelf, cluster)
    before = stamps(shelf / "run")
    cluster.kill(cluster.workers[0])
    out, err = process.communicate(timeout=120)
    assert process.returncode == 1, err  # the broken recording
    # what the lost worker had finished but not told is reused
    assert re.search(r"8 recordings: 7 ok, 0 refused, 1 failed; [0-3] reused", out), out
    after = stamps(shelf / "run")
    assert {name: after[name] for name in before} == before  # nothing finished is done twice
    cluster_rows, cluster_files = table(shelf / "run" / "results.csv"), contents(shelf / "run")
    tooltip("run", shelf, *METHOD, "--jobs", 1, "--force")
    assert table(shelf / "run" / "results.csv") == cluster_rows
    assert contents(shelf / "run") == cluster_files


def test_one_process_two_and_a_cluster_agree(wrist_file: Path, shelf: Path, tmp_path: Path) -> None:
    hoard(shelf / "hoard.mcap")
    cluster = Cluster(tmp_path)
    try:
        cluster.start(2, memory="1GiB")
        done = tooltip("run", shelf, *METHOD, "--dask", cluster.address)
    finally:
        cluster.stop()
    assert "9 recordings: 7 ok, 0 refused, 2 failed; 0 reused" in done.out, done.err
    rows, files = table(shelf / "run" / "results.csv"), contents(shelf / "run")
    assert rows.pop("hoard")["status"] == "failed"
    for jobs in (1, 2):
        done = tooltip("run", shelf, *METHOD, "--jobs", jobs, "--memory", 1, "--force")
        assert "9 recordings: 7 ok, 0 refused, 2 failed; 0 reused" in done.out, done.err
        others = table(shelf / "run" / "results.csv")
        assert others.pop("hoard")["code"] == "out_of_memory"
        assert others == rows
        again = contents(shelf / "run")
        for document in (again, files):
            document.pop("recordings/hoard/row.json", None)
        assert again == files


def test_a_scheduler_that_comes_back_is_asked_again(cluster: Cluster, shelf: Path) -> None:
    process = running(shelf, cluster)
    before = stamps(shelf / "run")
    cluster.stop()
    cluster.start(2)
    out, err = process.communicate(timeout=120)
    if process.returncode != 1 or "8 recordings" not in out:
        pytest.fail(err)
    after = stamps(shelf / "run")
    assert {name: after[name] for name in before if name != "cut"} == {
        name: stamp for name, stamp in before.items() if name != "cut"
    }
    assert len(table(shelf / "run" / "results.csv")) == 8


def test_what_kills_its_worker_again_and_again_is_given_up(cluster: Cluster) -> None:
    # a worker that dies while it starts is not started again, so let both be there first
    list(on_dask(misbehave, [f"sleep 1.{number}" for number in range(4)], cluster.address))
    tasks = ["a", "die", "raise no", "b"]
    results = dict(on_dask(misbehave, tasks, cluster.address))
    assert set(results) == set(tasks)
    died = {task: result.reason for task, result in results.items() if isinstance(result, Died)}
    assert set(died) == {"die", "raise no"}
    assert "every worker" in died["die"]
    assert "ValueError: no" in died["raise no"]


def test_no_scheduler_and_other_mistakes_are_said(
    wrist_file: Path, shelf: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dask = pytest.importorskip("dask")
    with dask.config.set({"distributed.comm.timeouts.connect": "100ms"}):
        done = tooltip("run", shelf, *METHOD, "--dask", "tcp://127.0.0.1:9")
    assert done.code == 1
    assert "no Dask scheduler answers at tcp://127.0.0.1:9" in done.error
    assert tooltip("run", shelf, "--dask", "tcp://127.0.0.1:9", "--memory", 1).code == 2
    monkeypatch.setitem(sys.modules, "distributed", None)
    done = tooltip("run", shelf, *METHOD, "--dask", "local")
    assert "tooltip-cli[dask]" in done.error


def test_a_worker_of_another_version_does_not_touch_anything(shelf: Path) -> None:
    task = plan_run(read_shelf(str(shelf)).items, shelf / "run").tasks[1]
    outcome = work_on(replace(task, version="0.0.0"))
    assert outcome.row.status == "failed"
    assert "install the same version on both" in str(outcome.row.reason)
