"""Drape a shot in several processes, which take chunks of frames in turn; chunks come back in order.

A frame depends on its own pose alone: with one thread each, their number changes nothing but the time.
Every process decodes and binds the outfit once; at most two chunks more than there are
processes are held, however long the shot.
"""

import pickle
import signal
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice
from multiprocessing import active_children, get_context
from typing import Any

import torch

from isp_assets.drape import DrapeOptions, Draper, chunk_rows
from isp_assets.errors import DrapeError
from isp_assets.frames import DrapedFrames, FrameChunk, Scene
from isp_assets.outfit import Outfit
from isp_assets.processes import denormals_flushed, end_with_parent, one_thread_each
from isp_assets.shot import Shot

Complete = Callable[[FrameChunk, int], FrameChunk]
"""Adds to a chunk, whose first frame has this number in the shot, where it was draped."""
Finish = Callable[[Scene], Complete]
"""Called once in every process; must be picklable."""


def drape_shot(
    outfit: Outfit,
    shot: Shot,
    options: DrapeOptions,
    *,
    workers: int = 1,
    finish: Finish | None = None,
    rows: Sequence[slice] | None = None,
) -> DrapedFrames:
    """Drape an outfit over a shot in one or several processes.

    Args:
        outfit: Garments, innermost first.
        shot: The body in motion.
        options: Rungs, device, chunk size.
        workers: Processes, one thread each; 1 works in this process. A script that asks for more must
            guard its main part with ``if __name__ == "__main__"``.
        finish: What is done to every chunk in the process that draped it, such as measuring.
        rows: The chunks wanted, of those that `chunk_rows` gives; all if left out.

    Raises:
        DrapeError: If several processes are asked to smooth over time, one of them dies, or as in `drape`.
        DecodeError: If a code gives no valid garment.
    """
    if workers < 1 or (workers > 1 and options.smoothing):
        raise DrapeError(
            f"workers={workers}, smoothing={options.smoothing:g}: expected at least 1 process, and only 1 "
            "with smoothing, as frames then depend on those before; give --workers 1, or --smoothing 0"
        )
    rows = chunk_rows(shot, options) if rows is None else rows
    workers = min(workers, len(rows))
    if workers <= 1:
        draper = Draper(outfit, shot, options)
        complete = finish(draper.scene) if finish else _as_it_is
        return DrapedFrames(draper.scene, (complete(draper.chunk(part), part.start) for part in rows))
    pool = _Pool((outfit, shot, options, finish), rows, workers)
    return DrapedFrames(pool.scene(), pool.chunks())


class _Pool:
    """Processes that drape chunks, a few ahead of what has been taken.

    Args:
        payload: What `_Worker` is made of.
        rows: The chunks wanted.
        workers: Number of processes.
    """

    def __init__(self, payload: tuple[Any, ...], rows: Sequence[slice], workers: int) -> None:
        before = set(active_children())
        self._pool = ProcessPoolExecutor(
            workers, get_context("spawn"), _start, (pickle.dumps(payload), denormals_flushed())
        )
        self._further = iter(rows)
        with self._ended_on_error():
            with one_thread_each():  # the processes start with their first tasks
                self._scene = self._pool.submit(_scene)
                self._waiting = deque(self._submit(workers + 1))
            self._processes = set(active_children()) - before

    def scene(self) -> Scene:
        with self._ended_on_error():
            return self._scene.result()

    def chunks(self) -> Iterator[FrameChunk]:
        with self._ended_on_error():
            while self._waiting:
                chunk = self._waiting.popleft().result()
                self._waiting.extend(self._submit(1))
                yield chunk
        self._pool.shutdown()

    def _submit(self, count: int) -> list["Future[FrameChunk]"]:
        return [self._pool.submit(_chunk, part) for part in islice(self._further, count)]

    @contextmanager
    def _ended_on_error(self) -> Iterator[None]:
        """Nobody waits for chunks that are in the making when draping ends early."""
        try:
            yield
        except BaseException as error:
            self._pool.shutdown(wait=False, cancel_futures=True)
            for process in getattr(self, "_processes", ()):
                process.terminate()
            if isinstance(error, BrokenProcessPool):
                raise DrapeError(
                    "a process that was draping died, most likely for want of memory (each takes about "
                    "1 GB): use fewer workers; a script must also guard its main part with: "
                    'if __name__ == "__main__"'
                ) from error
            raise


def _as_it_is(chunk: FrameChunk, first: int) -> FrameChunk:
    return chunk


class _Worker:
    """The state of one process."""

    def __init__(self, outfit: Outfit, shot: Shot, options: DrapeOptions, finish: Finish | None) -> None:
        self.draper = Draper(outfit, shot, options)
        self.complete = finish(self.draper.scene) if finish else _as_it_is


_payload = b""
_worker: _Worker | None = None


def _start(payload: bytes, flush_denormals: bool) -> None:
    torch.set_flush_denormal(flush_denormals)  # else the last bits differ from those of the first process
    global _payload
    _payload = payload
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # an interrupt ends it without a word; the parent reports


def _here() -> _Worker:
    """Made with the first task, not at the start: an error is then the task's and is raised in the parent."""
    global _worker
    if _worker is None:
        _worker = _Worker(*pickle.loads(_payload))
    return _worker


def _scene() -> Scene:
    return _here().draper.scene


def _chunk(rows: slice) -> FrameChunk:
    worker = _here()
    return worker.complete(worker.draper.chunk(rows), rows.start)
