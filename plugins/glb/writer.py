"""The writers ``glb`` and ``glb_packed``."""

from pathlib import Path

import numpy as np

from isp_assets.errors import PluginError
from isp_assets.files import published
from isp_assets.frames import FrameChunk, Scene

from .document import Part, build
from .morph import PACKED, PLAIN, Encoding, TargetStore


class GlbWriter:
    """One animated ``.glb``: a morph target a frame, plain glTF 2.0 without extensions.

    Positions are exact to float32 rounding. Frames go to nameless temporary
    files beside the output, so memory does not grow with the shot.
    """

    name = "glb"
    suffix = ".glb"
    version = "glTF 2.0"
    encoding: Encoding = PLAIN

    def __init__(self) -> None:
        self._path = Path()
        self._scene: Scene | None = None
        self._store: TargetStore | None = None

    def begin(self, path: Path, scene: Scene) -> None:
        """Prepare the meshes.

        Raises:
            PluginError: If the writer is busy, or the folder of ``path`` does not exist.
        """
        if self._scene is not None:
            raise PluginError(
                f"glb: begin({path}) while {self._path} is being written; finish or abort it first"
            )
        path = Path(path)
        if not path.parent.is_dir():
            raise PluginError(
                f"glb: cannot write {path}: the folder {path.parent} does not exist; make it first"
            )
        self._path, self._scene = path, scene
        self._expected = list(scene.frames)
        self._done = 0
        self._body: Part | None = None
        self._garments = [Part.of_layer(layer) for layer in scene.layers]
        self._store = TargetStore(self.encoding, path.parent)

    def add(self, chunk: FrameChunk) -> None:
        """Store the frames of a chunk.

        Raises:
            PluginError: If they are not the next frames of the scene, or do not fit it.
        """
        if self._scene is None or self._store is None:
            raise PluginError("glb: add() before begin()")
        self._check(chunk, self._scene)
        if self._body is None:
            self._body = Part.of_body(self._scene.body_faces, chunk.body.shape[1])
        for index in range(len(chunk.frames)):
            self._body.record(chunk.body[index], self._store)
            for part, vertices in zip(self._garments, chunk.layers, strict=True):
                part.record(vertices[index], self._store)
        self._done += len(chunk.frames)

    def finish(self) -> None:
        """Put the file together and publish it.

        Raises:
            PluginError: If frames are missing, or the file would be too large; nothing is published then.
        """
        if self._scene is None or self._store is None:
            raise PluginError("glb: finish() before begin()")
        try:
            if self._body is None or self._done != len(self._expected):
                got, count = self._done, len(self._expected)
                raise PluginError(
                    f"glb: {self._path}: only {got} of {count} frames were added; nothing was written"
                )
            file = build(self._scene, self._body, self._garments, self._store)
            with published(self._path) as part:
                file.write(part)
        finally:
            self.abort()

    def abort(self) -> None:
        """Drop what was begun; harmless at any time."""
        if self._store is not None:
            self._store.close()
        self._scene, self._store = None, None

    def _check(self, chunk: FrameChunk, scene: Scene) -> None:
        expected = self._expected[self._done : self._done + len(chunk.frames)]
        if chunk.frames.tolist() != expected:
            raise PluginError(
                f"glb: {self._path}: frames must come in the order of the scene ({scene.frames}); "
                f"expected {expected[:3]}..., got {chunk.frames.tolist()[:3]}..."
            )
        names = ["Body", *(layer.name for layer in scene.layers)]
        if len(chunk.layers) != len(scene.layers):
            raise PluginError(
                f"glb: {self._path}: expected {len(scene.layers)} layers, got {len(chunk.layers)}"
            )
        for name, vertices in zip(names, (chunk.body, *chunk.layers), strict=True):
            finite = np.isfinite(vertices).all(axis=(1, 2))
            if not finite.all():
                frame = chunk.frames[~finite][0]
                raise PluginError(f"glb: {self._path}: {name} has NaN or infinite positions in frame {frame}")


class PackedGlbWriter(GlbWriter):
    """A ``.glb`` of half the size, by KHR_mesh_quantization.

    Positions are within 0.03 mm, or 1.5e-5 of the distance from the first frame where that is above 2 m.
    """

    name = "glb_packed"
    version = "glTF 2.0 with KHR_mesh_quantization"
    encoding = PACKED
