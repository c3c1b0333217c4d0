"""Processes that die, tasks that fail, threads that are pinned."""

import os
from pathlib import Path

import pytest

from isp_assets.errors import DatasetError
from isp_assets.train.worker_pool import run_tasks


def start() -> None:
    pass


def die_once(task) -> str:
    marker, name = task
    if name == "b" and not Path(marker).exists():
        Path(marker).touch()
        os._exit(1)
    return f"{name} {os.environ['OMP_NUM_THREADS']}"


def die(task) -> None:
    os._exit(1)


def fail(task) -> None:
    raise ValueError(f"task {task} is bad")


def test_a_worker_that_dies_costs_only_a_new_try(tmp_path):
    before, done = dict(os.environ), []
    tasks = [(str(tmp_path / "died"), name) for name in "abc"]
    run_tasks(tasks, start, die_once, workers=1, report=done.append)
    assert sorted(done) == ["a 1", "b 1", "c 1"]
    assert (tmp_path / "died").exists()
    assert dict(os.environ) == before


def test_workers_that_always_die_are_an_error():
    with pytest.raises(DatasetError, match="died 3 times with 2 tasks to go"):
        run_tasks([1, 2], start, die, workers=1, report=lambda _: None)


def test_an_error_of_a_task_is_raised_here():
    with pytest.raises(ValueError, match="task 1 is bad"):
        run_tasks([1], start, fail, workers=1, report=lambda _: None)
