"""The writer ``sheet``: keeps a few frames while the shot streams by, and draws them at the end."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import PIL
from jaxtyping import Float

from isp_assets.errors import PluginError
from isp_assets.frames import FrameChunk, Scene

from ..publish import PartFile
from .camera import Camera
from .layout import compose_page
from .render import RenderMesh, render_view

COLUMNS = 6
ROWS = (("front", 0.0), ("left side", 60.0), ("back", 180.0))
"""Caption and yaw [degrees] of every row, relative to where the wearer faces."""
CELL = (286, 350)
"""Width and height of a picture in pixels."""


@dataclass(frozen=True, eq=False)
class _Frame:
    number: int
    body: Float[np.ndarray, "N 3"]
    layers: tuple[Float[np.ndarray, "_ 3"], ...]

    @property
    def points(self) -> Float[np.ndarray, "P 3"]:
        return np.concatenate([self.body, *self.layers])


class SheetWriter:
    """Contact sheet of one shot as a PNG: frames spread over the range, from the front, the side and the back.

    The camera turns with the wearer and keeps one scale over the shot.
    """

    name = "sheet"
    suffix = ".png"
    version = f"pillow {PIL.__version__}"

    def __init__(self) -> None:
        self._scene: Scene | None = None
        self._file: PartFile | None = None
        self._wanted: set[int] = set()
        self._kept: list[_Frame] = []

    def begin(self, path: Path, scene: Scene) -> None:
        """Choose the frames to keep."""
        numbers = list(scene.frames)
        chosen = np.linspace(0, len(numbers) - 1, min(COLUMNS, len(numbers))).round().astype(int)
        self._scene, self._file, self._kept = scene, PartFile(Path(path)), []
        self._wanted = {numbers[k] for k in chosen}

    def add(self, chunk: FrameChunk) -> None:
        """Keep the frames of this chunk that the sheet shows."""
        if self._scene is None:
            raise PluginError("sheet: add was called before begin")
        for index, number in enumerate(chunk.frames.tolist()):
            if number in self._wanted:
                layers = tuple(points[index].copy() for points in chunk.layers)
                self._kept.append(_Frame(number, chunk.body[index].copy(), layers))

    def finish(self) -> None:
        """Draw the sheet and publish it.

        Raises:
            PluginError: If frames of the sheet never came.
        """
        if self._scene is None or self._file is None:
            raise PluginError("sheet: finish was called before begin")
        missing = self._wanted - {frame.number for frame in self._kept}
        if missing:
            raise PluginError(
                f"sheet: {self._file.path}: frames {sorted(missing)} were never added; the shot is cut short"
            )
        with self._file as file:
            page = self._draw(self._scene)
            with file.open() as out:
                page.save(out, format="PNG")
            file.publish()

    def abort(self) -> None:
        """Forget everything; nothing was written."""
        if self._file is not None:
            self._file.discard()
        self._scene, self._file, self._kept = None, None, []

    def _draw(self, scene: Scene):
        low = min(float(frame.points[:, 1].min()) for frame in self._kept)
        cameras = _cameras(self._kept, [_heading(scene, frame) for frame in self._kept])
        pictures = [
            [
                render_view(_meshes(scene, frame), camera=camera, size=CELL, ground=low)
                for frame, camera in zip(self._kept, row, strict=True)
            ]
            for row in cameras
        ]
        title = f"{scene.name}    frames {scene.frames}    {scene.fps:g} fps"
        captions = [str(frame.number) for frame in self._kept]
        return compose_page(title, scene.layers, captions, [caption for caption, _ in ROWS], pictures)


def _meshes(scene: Scene, frame: _Frame) -> list[RenderMesh]:
    clothes = [RenderMesh.of_layer(layer, v) for layer, v in zip(scene.layers, frame.layers, strict=True)]
    return [RenderMesh(frame.body, scene.body_faces), *clothes]


def _heading(scene: Scene, frame: _Frame) -> float:
    """Degrees round Y from the rest pose, which faces +Z, to this frame: what turns the garments best."""
    sine = cosine = 0.0
    for layer, vertices in zip(scene.layers, frame.layers, strict=True):
        rest, now = (p[:, [2, 0]] - p[:, [2, 0]].mean(0) for p in (layer.garment.rest_vertices, vertices))
        cosine += float((rest * now).sum())
        sine += float((rest[:, 0] * now[:, 1] - rest[:, 1] * now[:, 0]).sum())
    return float(np.degrees(np.arctan2(sine, cosine)))


def _cameras(frames: list[_Frame], headings: list[float]) -> list[list[Camera]]:
    """A camera for every row and frame: centred on the wearer, at one height and scale."""
    bottom = min(float(frame.points[:, 1].min()) for frame in frames)
    top = max(float(frame.points[:, 1].max()) for frame in frames)
    height = 1.12 * (top - bottom)
    targets = []
    for frame in frames:
        low, high = frame.points.min(0), frame.points.max(0)
        x, _, z = (low + high) / 2
        targets.append((float(x), (bottom + top) / 2, float(z)))
        reach = np.linalg.norm((high - low)[[0, 2]])
        height = max(height, 0.9 * float(reach) * CELL[1] / CELL[0])
    turns = list(zip(headings, targets, strict=True))
    return [[Camera(heading + yaw, 8.0, target, height) for heading, target in turns] for _, yaw in ROWS]
