"""A writer plugin in one file: the size of every layer in every frame, as CSV."""

import os
from pathlib import Path
from typing import TextIO

from isp_assets.errors import PluginError
from isp_assets.frames import FrameChunk, Scene


class BoundsWriter:
    """One line per frame and layer: its extent along X, Y and Z in metres."""

    name = "bounds"
    suffix = ".csv"
    version = "1.0"

    def __init__(self) -> None:
        self._file: TextIO | None = None

    def begin(self, path: Path, scene: Scene) -> None:
        """Open a temporary file beside ``path``: nothing may exist at ``path`` before ``finish``."""
        self._path, self._scene = path, scene
        self._temporary = path.with_name(f".{path.name}.part")
        self._file = self._temporary.open("w", encoding="utf-8", newline="\n")
        self._file.write("frame,layer,x,y,z\n")

    def add(self, chunk: FrameChunk) -> None:
        """Append frames. The arrays are shared with other writers: read them, never change them."""
        if self._file is None:
            raise PluginError("bounds: add() before begin()")
        for i, frame in enumerate(chunk.frames):
            for layer, vertices in zip(self._scene.layers, chunk.layers, strict=True):
                x, y, z = vertices[i].max(0) - vertices[i].min(0)
                self._file.write(f"{frame},{layer.name},{x:.6f},{y:.6f},{z:.6f}\n")

    def finish(self) -> None:
        """Publish the whole file by one atomic rename."""
        if self._file is None:
            raise PluginError("bounds: finish() before begin()")
        self._file.close()
        self._file = None
        os.replace(self._temporary, self._path)

    def abort(self) -> None:
        """Leave no trace; may be called at any time, more than once."""
        if self._file is not None:
            self._file.close()
            self._file = None
            self._temporary.unlink(missing_ok=True)


WRITER = BoundsWriter  # what ISP_ASSETS_PLUGIN_PATH looks for
