"""Writes a shot to one ``.usdc`` file and a folder of textures beside it."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image
from pxr import Usd

from isp_assets.errors import PluginError
from isp_assets.frames import FrameChunk, Scene

from .layout import AnimatedMesh, define_shot
from .names import prim_names

FLUSH_EVERY = 25
"""Frames held in memory before they go to the temporary file."""


class UsdWriter:
    """The ``usd`` plugin; see `isp_assets.plugin.ShotWriter` for the life cycle.

    All work is done in a hidden temporary folder beside the output. Frames go
    to disk every ``FLUSH_EVERY`` frames, counted from the first one, so memory
    does not grow with the shot and the bytes do not depend on the chunks.
    `finish` moves the textures into place first and the ``.usdc`` last: who
    sees the new file sees its textures too. Other files in the texture folder
    are left alone.
    """

    name = "usd"
    suffix = ".usdc"
    version = "usd-core " + ".".join(str(v) for v in Usd.GetVersion()[1:])

    def __init__(self) -> None:
        self._path = Path()
        self._work: Path | None = None
        self._stage: Usd.Stage | None = None

    def begin(self, path: Path, scene: Scene) -> None:
        """Write all that does not change to the temporary file.

        Raises:
            PluginError: If a shot is being written already.
        """
        if self._work is not None:
            raise PluginError(
                f"usd: begin({path}) while {self._path} is being written; finish or abort it first"
            )
        self._path, self._scene = path, scene
        self._expected = list(scene.frames)
        self._done = 0
        path.parent.mkdir(parents=True, exist_ok=True)
        self._work = Path(tempfile.mkdtemp(prefix=f".{path.stem}-", dir=path.parent))
        try:
            self._stage = Usd.Stage.CreateNew(str(self._work / path.name))
            self._body, self._garments = define_shot(self._stage, scene, self._textures)
            self._write_textures(self._work / self._textures)
            self._stage.GetRootLayer().Save()
        except BaseException:
            self.abort()
            raise

    def add(self, chunk: FrameChunk) -> None:
        """Append frames.

        Raises:
            PluginError: If they are not the next frames of the scene, or do not fit it.
        """
        if self._stage is None:
            raise PluginError("usd: add() before begin()")
        self._check(chunk)
        for i, frame in enumerate(chunk.frames):
            for mesh, vertices in _meshes(self._body, self._garments, chunk):
                mesh.set_frame(vertices[i], int(frame))
            self._done += 1
            if self._done % FLUSH_EVERY == 0:
                self._stage.GetRootLayer().Save()

    def finish(self) -> None:
        """Publish the file and its textures.

        Raises:
            PluginError: If frames are missing; nothing is published then.
        """
        if self._stage is None or self._work is None:
            raise PluginError("usd: finish() before begin()")
        if self._done != len(self._expected):
            done, count = self._done, len(self._expected)
            self.abort()
            raise PluginError(
                f"usd: {self._path}: only {done} of {count} frames were added; nothing was written"
            )
        self._stage.GetRootLayer().Save()
        self._stage = None  # closes the file
        try:
            self._publish(self._work)
        finally:
            self.abort()

    def abort(self) -> None:
        """Drop what was begun; harmless at any time."""
        self._stage = None
        if self._work is not None:
            shutil.rmtree(self._work, ignore_errors=True)
            self._work = None

    @property
    def _textures(self) -> str:
        return f"{self._path.stem}_textures"

    def _write_textures(self, folder: Path) -> None:
        folder.mkdir()
        for name, layer in zip(
            prim_names([x.name for x in self._scene.layers]), self._scene.layers, strict=True
        ):
            Image.fromarray(layer.texture).save(folder / f"{name}.png", compress_level=4)

    def _publish(self, work: Path) -> None:
        target = self._path.parent / self._textures
        target.mkdir(exist_ok=True)
        for file in sorted((work / self._textures).iterdir()):
            os.replace(file, target / file.name)
        layer = work / self._path.name
        with layer.open("rb") as written:
            os.fsync(written.fileno())
        os.replace(layer, self._path)

    def _check(self, chunk: FrameChunk) -> None:
        expected = self._expected[self._done : self._done + len(chunk.frames)]
        if chunk.frames.tolist() != expected:
            raise PluginError(
                f"usd: {self._path}: frames must come in the order of the scene ({self._scene.frames}); "
                f"expected {expected[:3]}..., got {chunk.frames.tolist()[:3]}..."
            )
        if len(chunk.layers) != len(self._garments):
            raise PluginError(
                f"usd: {self._path}: expected {len(self._garments)} layers, got {len(chunk.layers)}"
            )
        names = ["Body", *(layer.name for layer in self._scene.layers)]
        counts = [None, *(layer.garment.num_vertices for layer in self._scene.layers)]
        for name, count, vertices in zip(names, counts, (chunk.body, *chunk.layers), strict=True):
            if count is not None and vertices.shape[1] != count:
                raise PluginError(
                    f"usd: {self._path}: {name} must have {count} vertices, got {vertices.shape[1]}"
                )
            if not np.isfinite(vertices).all():
                frame = chunk.frames[~np.isfinite(vertices).all(axis=(1, 2))][0]
                raise PluginError(f"usd: {self._path}: {name} holds NaN or infinity at frame {frame}")


def _meshes(
    body: AnimatedMesh, garments: tuple[AnimatedMesh, ...], chunk: FrameChunk
) -> Iterator[tuple[AnimatedMesh, np.ndarray]]:
    yield body, chunk.body
    yield from zip(garments, chunk.layers, strict=True)
