"""Independent tasks in separate processes, each with one thread."""

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import Any, TypeVar

from isp_assets.errors import DatasetError
from isp_assets.processes import end_with_parent, one_thread_each

Task = TypeVar("Task")
Result = TypeVar("Result")

_RESTARTS = 3


def run_tasks(
    tasks: Sequence[Task],
    start: Callable[[], Any],
    work: Callable[[Task], Result],
    *,
    workers: int,
    report: Callable[[Result], None],
) -> None:
    """Work on all tasks; a worker that dies costs only the tasks it had in hand, which are begun again.

    Args:
        tasks: What to work on, hashable and different from each other.
        start: Called once in every new process; it and ``work`` must be importable.
        work: Called in a process with one task.
        workers: Number of processes.
        report: Called here with every result, as it comes.

    Raises:
        DatasetError: If workers died several times.
        Exception: The first error that ``work`` raises; tasks not begun are dropped.
    """
    remaining = dict.fromkeys(tasks)
    for _ in range(_RESTARTS):
        if not remaining:
            return
        with one_thread_each(), ProcessPoolExecutor(workers, get_context("spawn"), _begin, (start,)) as pool:
            futures = {pool.submit(work, task): task for task in remaining}
            try:
                for future in as_completed(futures):
                    report(future.result())
                    del remaining[futures[future]]
            except BrokenProcessPool:
                continue
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
    if remaining:
        raise DatasetError(
            f"worker processes died {_RESTARTS} times with {len(remaining)} tasks to go; use fewer workers, "
            "or check the memory; finished tasks are kept"
        )


def _begin(start: Callable[[], Any]) -> None:
    end_with_parent()
    start()
