"""A dataset small enough to train on in a test: rectangles sewn at the sides into a tube."""

import numpy as np

from isp_assets.train.dataset import GarmentDataset, TrainingGarment, TrainingPanel

EDGES = {1: "right", 2: "top", 3: "left", 4: "hem"}
CENTER, SCALE = np.array([0.0, 0.1]), 0.5


def tube_dataset(widths: tuple[float, ...] = (0.4, 0.5, 0.6), height: float = 0.5) -> GarmentDataset:
    """One tube for each panel width [m]; front and back are half cylinders."""
    garments = tuple(_tube(f"tube_{index}", width, height) for index, width in enumerate(widths))
    return GarmentDataset(
        "tube",
        garments,
        EDGES,
        ((1, 1), (3, 3)),
        (2,),
        np.zeros((24, 3)),
        CENTER,
        SCALE,
        body_sha256="0" * 64,
    )


def _tube(name: str, width: float, height: float, cells: int = 8) -> TrainingGarment:
    line = np.linspace(-0.5, 0.5, cells + 1)
    x, y = np.meshgrid(width * line, height * line)
    xy = np.column_stack([x.ravel(), y.ravel()]) + CENTER
    grid = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = grid[:-1, :-1].ravel(), grid[:-1, 1:].ravel(), grid[1:, 1:].ravel(), grid[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    back_index = grid.ravel() + grid.size
    on_seam = np.isclose(np.abs(xy[:, 0]), width / 2)
    back_index[on_seam] = grid.ravel()[on_seam]
    used, back_index = np.unique(np.concatenate([grid.ravel(), back_index]), return_inverse=True)
    front_index, back_index = np.split(back_index, 2)
    angle, radius = np.pi * xy[:, 0] / width, width / np.pi
    vertices = np.zeros((len(used), 3))
    for index, sign in ((back_index, -1), (front_index, 1)):
        depth = sign * radius * np.cos(angle)
        depth[on_seam] = 0.0
        vertices[index] = np.column_stack([radius * np.sin(angle), xy[:, 1], depth])
    outline, label = _rectangle(width, height)
    shared = {
        "xy": xy,
        "outline_xy": outline,
        "outline_label": label,
        "outline_loop": np.zeros(len(label), int),
    }
    panels = {
        "front": TrainingPanel(faces=faces, vertex_index=front_index, **shared),
        "back": TrainingPanel(faces=faces[:, ::-1].copy(), vertex_index=back_index, **shared),
    }
    anchors = np.unique(np.concatenate([front_index[grid[-1]], back_index[grid[-1]]]))
    return TrainingGarment(name, "tube", panels, vertices, anchors, {}, {})


def _rectangle(width: float, height: float, per_side: int = 50) -> tuple[np.ndarray, np.ndarray]:
    corners = np.array([[0.5, -0.5], [0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5]]) * [width, height] + CENTER
    t = np.linspace(0, 1, per_side, endpoint=False)[:, None]
    sides = [
        start + t * (end - start) for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True)
    ]
    return np.concatenate(sides), np.repeat([1, 2, 3, 4], per_side)
