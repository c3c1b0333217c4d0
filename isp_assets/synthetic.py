"""A small synthetic shot in memory: two loose tubes over a closed body, a few hundred vertices in all.

It needs no networks and no files, so tests and samples of writers can use it.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from isp_assets.conventions import FrameRange
from isp_assets.frames import FrameChunk, Layer, Scene, StageTimes
from isp_assets.garment import Garment, Panel, Seam


@dataclass(frozen=True, eq=False)
class SyntheticShot:
    """A complete shot in memory, cut into chunks at will."""

    scene: Scene
    body: Float[np.ndarray, "T N 3"]
    layers: tuple[Float[np.ndarray, "T _ 3"], ...]

    def chunks(self, size: int) -> Iterator[FrameChunk]:
        """The frames in order, ``size`` at a time, as fresh arrays."""
        numbers = np.array(list(self.scene.frames))
        for start in range(0, len(numbers), size):
            part = slice(start, start + size)
            yield FrameChunk(
                frames=numbers[part].copy(),
                body=self.body[part].copy(),
                layers=tuple(layer[part].copy() for layer in self.layers),
                times=StageTimes({"skin": 0.001}),
                steps=tuple((("skin",),) * len(self.layers) for _ in numbers[part]),
                metrics=tuple({"body/L00_vest/area_percent": 0.0} for _ in numbers[part]),
            )


def synthetic_shot(
    *, frames: str = "1001-1005", columns: int = 9, rows: int = 7, fps: float = 30.0
) -> SyntheticShot:
    """Two garments, ``L00_vest`` and ``L01_coat``, that sway over an egg-shaped body."""
    frame_range = FrameRange.parse(frames)
    sphere, body_faces = _sphere(12, 9)
    garments = tuple(
        synthetic_garment(name, radius=r, columns=columns, rows=rows)
        for name, r in (("vest", 0.24), ("coat", 0.28))
    )
    layers = tuple(
        Layer(f"L{k:02d}_{g.name}", g, _texture(color), color)
        for k, (g, color) in enumerate(zip(garments, ((0.8, 0.3, 0.2), (0.2, 0.4, 0.7)), strict=True))
    )
    phase = np.array([0.4 * (f - frame_range.start) for f in frame_range], np.float32)
    scene = Scene("synthetic", body_faces, layers, frame_range, fps)
    return SyntheticShot(scene, _sway(sphere, phase), tuple(_sway(g.rest_vertices, phase) for g in garments))


def synthetic_garment(name: str, *, radius: float, columns: int = 9, rows: int = 7) -> Garment:
    """A tube about the Y axis, 0.5 m high, sewn from two rectangular panels.

    Both panels are drawn as seen from the front, so the faces of the back panel
    are wound clockwise in the plane. Labels: 1 hem, 2 left seam, 3 top, 4 right seam.
    """
    angle, height = np.meshgrid(np.linspace(-np.pi / 2, np.pi / 2, columns), np.linspace(0.9, 1.4, rows))
    front = np.stack([radius * np.sin(angle), height, radius * np.cos(angle)], -1).reshape(-1, 3)
    back = front * (1, 1, -1)
    flat = np.stack([radius * angle, height - 1.15], -1).reshape(-1, 2)
    grid = np.arange(rows * columns).reshape(rows, columns)
    sewn = np.zeros(grid.shape, bool)
    sewn[:, [0, -1]] = True
    back_index = np.empty(grid.size, int)
    back_index[sewn.ravel()] = grid[sewn]
    back_index[~sewn.ravel()] = grid.size + np.arange((~sewn).sum())
    labels = _rectangle_labels(rows, columns)
    corner = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], -1).reshape(-1, 4)
    faces = np.concatenate([corner[:, [0, 1, 2]], corner[:, [0, 2, 3]]])
    square = flat / (1.1 * np.abs(flat).max())  # network coordinates, in [-1, 1]^2
    half = (square + 1) * (0.25, 0.5)  # the front panel's square is the left half of the texture
    panels = {
        "front": Panel(flat, faces, grid.ravel(), half, labels),
        "back": Panel(flat, faces[:, ::-1].copy(), back_index, half + np.array([0.5, 0]), labels),
    }
    seams = tuple(
        Seam((label, label), grid[:, column], grid[:, column]) for label, column in ((2, -1), (4, 0))
    )
    rest = np.concatenate([front, back[~sewn.ravel()]])
    top = np.union1d(grid[-1], back_index.reshape(grid.shape)[-1])
    return Garment(name, "tube", np.zeros(2, np.float32), rest, np.zeros((24, 3)), panels, seams, anchors=top)


def _rectangle_labels(rows: int, columns: int) -> Int[np.ndarray, " P"]:
    """Labels of a grid's border, counter-clockwise; a corner carries the edge that it starts."""
    labels = np.zeros((rows, columns), int)
    labels[0, :-1], labels[:-1, -1], labels[-1, 1:], labels[1:, 0] = 1, 2, 3, 4
    return labels.ravel()


def _sphere(columns: int, rows: int) -> tuple[Float[np.ndarray, "N 3"], Int[np.ndarray, "F 3"]]:
    """A closed ellipsoid about the Y axis, faces outward."""
    around = np.arange(columns) * 2 * np.pi / columns
    up = np.linspace(-np.pi / 2, np.pi / 2, rows)[1:-1]
    wide, high = np.cos(up)[:, None], np.sin(up)[:, None]
    ring = np.stack(np.broadcast_arrays(wide * np.sin(around), high, wide * np.cos(around)), -1).reshape(
        -1, 3
    )
    points = np.concatenate([ring, [[0, -1, 0], [0, 1, 0]]]) * (0.2, 0.6, 0.2) + (0, 1.1, 0)
    grid = np.arange(len(up) * columns).reshape(len(up), columns)
    a, b, c, d = grid[:-1], np.roll(grid[:-1], -1, 1), np.roll(grid[1:], -1, 1), grid[1:]
    south, north = np.full(columns, grid.size), np.full(columns, grid.size + 1)
    bands = (a, b, c), (a, c, d), (south, b[0], a[0]), (d[-1], c[-1], north)
    return points, np.concatenate([np.stack(band, -1).reshape(-1, 3) for band in bands])


def _sway(rest: Float[np.ndarray, "V 3"], phase: Float[np.ndarray, " T"]) -> Float[np.ndarray, "T V 3"]:
    shift = np.sin(phase)[:, None] * (0.05 * (1.5 - rest[:, 1]))
    return (rest + shift[..., None] * np.array([1.0, 0.0, 0.5])).astype(np.float32)


def _texture(color: tuple[float, float, float]) -> UInt8[np.ndarray, "H W 3"]:
    checks = (np.indices((32, 64)).sum(0) // 4 % 2)[..., None]
    return (255 * np.array(color) * (0.8 + 0.2 * checks)).astype(np.uint8)
