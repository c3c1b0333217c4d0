"""What a person sees of a training run, and how they stop it."""

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType

from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn


class ProgressView:
    """A live bar on a terminal; elsewhere one plain line a report."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._bar: Progress | None = None
        if sys.stderr.isatty():
            from rich.console import Console

            columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:.0f} %"))
            self._bar = Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True))

    def __enter__(self) -> "ProgressView":
        if self._bar:
            self._bar.start()
            self._task = self._bar.add_task(self.name, total=1.0)
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._bar:
            self._bar.stop()

    def show(self, progress: float, text: str) -> None:
        """Show the share done (0 to 1) and a line of figures."""
        if self._bar:
            self._bar.update(self._task, completed=progress)
            self._bar.console.print(text, highlight=False)
        else:
            print(f"{self.name} {progress:6.1%}  {text}", file=sys.stderr, flush=True)


@contextmanager
def interrupt_flag() -> Iterator[Callable[[], bool]]:
    """Turn the first Ctrl-C into a flag, so that a step ends and its result is saved.

    A second Ctrl-C stops at once. Outside the main thread nothing is changed.
    """
    raised = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield raised.is_set
        return
    previous = signal.getsignal(signal.SIGINT)

    def note(number: int, frame: object) -> None:
        raised.set()
        signal.signal(signal.SIGINT, previous)

    signal.signal(signal.SIGINT, note)
    try:
        yield raised.is_set
    finally:
        signal.signal(signal.SIGINT, previous)
