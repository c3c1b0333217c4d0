"""The writer ``sheet``: keeps a few frames while the shot streams by, and draws them at the end."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import PIL
from jaxtyping import Float
from PIL import Image

from isp_assets.errors import PluginError
from isp_assets.files import published
from isp_assets.frames import FrameChunk, Scene

from .camera import Camera
from .layout import compose_page
from .render import RenderMesh, RenderScene


@dataclass(frozen=True)
class SheetStyle:
    """How large and how fine a sheet is."""

    columns: int = 6
    """Frames shown, spread evenly over the range."""
    cell: tuple[int, int] = (286, 350)
    """Width and height of one picture in pixels."""
    samples: int = 3
    """Rays per pixel along each axis."""
    rows: tuple[tuple[str, float], ...] = (("front", 0.0), ("left side", 60.0), ("back", 180.0))
    """Caption and yaw [degrees] of every row, relative to where the wearer faces."""


@dataclass(frozen=True, eq=False)
class _Frame:
    number: int
    body: Float[np.ndarray, "N 3"]
    layers: tuple[Float[np.ndarray, "_ 3"], ...]

    @property
    def points(self) -> Float[np.ndarray, "P 3"]:
        return np.concatenate([self.body, *self.layers])


class SheetWriter:
    """Contact sheet of one shot as a PNG: frames spread over the range, from front, side and back.

    The camera turns with the wearer and keeps one scale over the shot.
    """

    name = "sheet"
    suffix = ".png"
    version = f"pillow {PIL.__version__}"

    def __init__(self, style: SheetStyle | None = None) -> None:
        self._style = style or SheetStyle()
        self._path = Path()
        self._scene: Scene | None = None
        self._wanted: set[int] = set()
        self._kept: list[_Frame] = []

    def begin(self, path: Path, scene: Scene) -> None:
        """Choose the frames to keep."""
        self.abort()
        numbers = list(scene.frames)
        chosen = np.linspace(0, len(numbers) - 1, min(self._style.columns, len(numbers))).round().astype(int)
        self._path, self._scene = Path(path), scene
        self._wanted = {numbers[k] for k in chosen}

    def add(self, chunk: FrameChunk) -> None:
        """Keep the frames of this chunk that the sheet shows.

        Raises:
            PluginError: If one of them has NaN or infinite positions.
        """
        if self._scene is None:
            raise PluginError("sheet: add was called before begin")
        for index, number in enumerate(chunk.frames.tolist()):
            if number in self._wanted:
                layers = tuple(points[index].copy() for points in chunk.layers)
                frame = _Frame(number, chunk.body[index].copy(), layers)
                if not np.isfinite(frame.points).all():
                    raise PluginError(f"sheet: {self._path}: frame {number} has NaN or infinite positions")
                self._kept.append(frame)

    def finish(self) -> None:
        """Draw the sheet and publish it.

        Raises:
            PluginError: If frames of the sheet never came.
        """
        if self._scene is None:
            raise PluginError("sheet: finish was called before begin")
        missing = self._wanted - {frame.number for frame in self._kept}
        if missing:
            raise PluginError(
                f"sheet: {self._path}: frames {sorted(missing)} were never added; the shot is cut short"
            )
        page = _draw(self._scene, self._kept, self._style)
        with published(self._path) as part:
            page.save(part, format="PNG")
        self.abort()

    def abort(self) -> None:
        """Forget everything; nothing is on the disk before ``finish``."""
        self._scene, self._wanted, self._kept = None, set(), []


def _draw(scene: Scene, frames: list[_Frame], style: SheetStyle) -> Image.Image:
    ground = min(float(frame.points[:, 1].min()) for frame in frames)
    pictures: list[list[np.ndarray]] = [[] for _ in style.rows]
    for frame, cameras in zip(frames, _cameras(scene, frames, style), strict=True):
        dressed = RenderScene(_meshes(scene, frame))
        for row, camera in zip(pictures, cameras, strict=True):
            row.append(dressed.draw(camera, style.cell, samples=style.samples, ground=ground))
    title = f"{scene.name}    frames {scene.frames}    {scene.fps:g} fps"
    captions = [str(frame.number) for frame in frames]
    return compose_page(title, scene.layers, captions, [caption for caption, _ in style.rows], pictures)


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


def _cameras(scene: Scene, frames: list[_Frame], style: SheetStyle) -> list[list[Camera]]:
    """A camera for every frame and row: centred on the wearer, at one height and scale."""
    bottom = min(float(frame.points[:, 1].min()) for frame in frames)
    top = max(float(frame.points[:, 1].max()) for frame in frames)
    height = 1.12 * (top - bottom)
    turns = []
    for frame in frames:
        low, high = frame.points.min(0), frame.points.max(0)
        x, _, z = (low + high) / 2
        turns.append((_heading(scene, frame), (float(x), (bottom + top) / 2, float(z))))
        reach = float(np.linalg.norm((high - low)[[0, 2]]))
        height = max(height, 0.9 * reach * style.cell[1] / style.cell[0])
    yaws = [yaw for _, yaw in style.rows]
    return [[Camera(heading + yaw, 8.0, target, height) for yaw in yaws] for heading, target in turns]
