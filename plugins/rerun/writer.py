"""The writer ``rerun``: geometry once, then positions and figures in blocks of frames."""

import importlib.util
import uuid
from contextlib import AbstractContextManager, suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

from isp_assets.errors import MissingExtraError, PluginError
from isp_assets.files import published
from isp_assets.frames import FrameChunk, Scene

from .block import Block
from .review import Review

BLOCK = 10
"""Frames sent at a time, however many come in a chunk."""


class RerunWriter:
    """One ``.rrd`` to be opened with ``rerun shot.rrd``.

    Frames stream into a temporary file beside the output. The content is the
    same in every run, the bytes are not: rerun gives each block a random identifier.
    """

    name = "rerun"
    suffix = ".rrd"
    version = "rerun-sdk (not installed)"

    def __init__(self) -> None:
        self._path = Path()
        self._scene: Scene | None = None
        self._review: Review | None = None
        self._file: AbstractContextManager[Path] | None = None

    def begin(self, path: Path, scene: Scene) -> None:
        """Write what does not change over the shot to the temporary file.

        Raises:
            MissingExtraError: If ``rerun-sdk`` is not installed.
            PluginError: If the writer is busy.
        """
        if self._scene is not None:
            raise PluginError(f"rerun: begin({path}) while {self._path} is being written; finish it first")
        if importlib.util.find_spec("rerun") is None:
            raise MissingExtraError("rerun-sdk", "review", "the rerun recording")
        self._path, self._scene = Path(path), scene
        self._expected = list(scene.frames)
        self._done = 0
        self._waiting: list[Block] = []
        self._file = published(self._path)
        self._part = self._file.__enter__()
        try:
            self._review = Review(self._part, scene, recording_id=f"{scene.name}-{uuid.uuid4().hex[:12]}")
        except BaseException:
            self.abort()
            raise

    def add(self, chunk: FrameChunk) -> None:
        """Store the frames of a chunk.

        Raises:
            PluginError: If they are not the next frames of the scene, or do not fit it.
        """
        if self._scene is None or self._review is None:
            raise PluginError("rerun: add() before begin()")
        self._check(chunk, self._scene)
        self._waiting.append(Block.of_chunk(chunk))
        self._done += len(chunk.frames)
        self._send(self._review, all_of_it=False)

    def finish(self) -> None:
        """Close the recording with its views, and publish it.

        Raises:
            PluginError: If frames are missing, or the file is not whole; nothing is published then.
        """
        if self._review is None or self._file is None:
            raise PluginError("rerun: finish() before begin()")
        try:
            if self._done != len(self._expected):
                counts = f"only {self._done} of {len(self._expected)} frames were added"
                raise PluginError(f"rerun: {self._path}: {counts}; nothing was written")
            self._send(self._review, all_of_it=True)
            self._review.close()
            file, self._file = self._file, None
            file.__exit__(None, None, None)
        finally:
            self.abort()

    def abort(self) -> None:
        """Drop what was begun; harmless at any time."""
        if self._review is not None:
            self._review.drop()
        if self._file is not None:
            stop = PluginError("aborted")
            self._file.__exit__(PluginError, stop, None)
        self._scene, self._review, self._file = None, None, None

    def _send(self, review: Review, *, all_of_it: bool) -> None:
        """Send full blocks, counted from the first frame; the last may be short."""
        count = sum(len(block.frames) for block in self._waiting)
        if count == 0 or (count < BLOCK and not all_of_it):
            return
        joined = Block.joined(self._waiting)
        whole = count if all_of_it else count - count % BLOCK
        for start in range(0, whole, BLOCK):
            review.send(joined.part(start, min(start + BLOCK, whole)))
        self._waiting = [joined.part(whole, count)] if whole < count else []

    def _check(self, chunk: FrameChunk, scene: Scene) -> None:
        expected = self._expected[self._done : self._done + len(chunk.frames)]
        if chunk.frames.tolist() != expected:
            raise PluginError(
                f"rerun: {self._path}: frames must come in the order of the scene ({scene.frames}); "
                f"expected {expected[:3]}..., got {chunk.frames.tolist()[:3]}..."
            )
        if len(chunk.layers) != len(scene.layers):
            counts = f"expected {len(scene.layers)} layers, got {len(chunk.layers)}"
            raise PluginError(f"rerun: {self._path}: {counts}")
        if not all(np.isfinite(vertices).all() for vertices in (chunk.body, *chunk.layers)):
            raise PluginError(f"rerun: {self._path}: frames {chunk.frames.tolist()} hold NaN or infinity")


with suppress(PackageNotFoundError):
    RerunWriter.version = f"rerun-sdk {version('rerun-sdk')}"
