"""Processes of which any may die."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from tests.helpers.work import misbehave
from tooltip_cli.stages.shelf.pool import Died, on_processes


def exists(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def test_the_death_of_a_process_is_the_result_of_its_task_alone() -> None:
    tasks = ["a", "die", "b", "exit 7", "raise no", "c", "exit 0", "flood 300000", "d"]
    results = dict(on_processes(misbehave, tasks, 2))
    assert set(results) == set(tasks)
    died = {task: result.reason for task, result in results.items() if isinstance(result, Died)}
    assert set(died) == {"die", "exit 7", "raise no", "exit 0"}
    assert "SIGKILL" in died["die"]
    assert "code 7" in died["exit 7"]
    assert "code 1" in died["raise no"]
    assert "code 0" in died["exit 0"]
    for task in ("a", "b", "c", "d"):
        answer = results[task]
        assert isinstance(answer, str)
        assert answer.startswith(f"{task} by ")


def test_who_wants_too_much_memory_fails_alone() -> None:
    tasks = ["allocate 3", "allocate 0.01"]
    results = dict(on_processes(misbehave, tasks, 1, memory_bytes=2 * 2**30))
    assert isinstance(results["allocate 3"], Died)
    assert isinstance(results["allocate 0.01"], str)
    (_, without) = next(iter(on_processes(misbehave, ["allocate 3"], 1)))
    assert isinstance(without, str)


def test_processes_are_used_again_and_ended() -> None:
    answers = [str(result) for _, result in on_processes(misbehave, list("abcdef"), 2)]
    processes = {int(answer.split()[2]) for answer in answers}
    assert len(processes) == 2
    assert not [process for process in processes if exists(process)]


def test_leaving_early_ends_those_that_work() -> None:
    pool = on_processes(misbehave, ["a", "sleep 600"], 2)
    task, answer = next(pool)
    assert task == "a"
    pool.close()
    assert not exists(int(str(answer).split()[2]))


@pytest.mark.parametrize("count", [0, 1, 5])
def test_tasks_are_drawn_as_they_are_needed(count: int) -> None:
    drawn: list[int] = []

    def tasks() -> Iterator[str]:
        for number in range(count):
            drawn.append(number)
            yield str(number)

    for done, _ in enumerate(on_processes(misbehave, tasks(), 1)):
        assert len(drawn) <= done + 2
    assert len(drawn) == count
