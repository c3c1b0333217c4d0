"""Sheets, balls and tubes with known contact, as collision meshes."""

import numpy as np
import trimesh

from isp_assets.geometry.obstacle import CollisionMesh, Obstacle

TORSO, LEFT_ARM = 0, 16  # joints


def weights(count: int, joint: int = TORSO) -> np.ndarray:
    """Skinning weights of vertices that follow one joint."""
    return np.eye(24)[np.full(count, joint)]


def grid(rows: int, columns: int, *, wrap: bool = False) -> np.ndarray:
    """Triangles of a grid of vertices, row by row; ``wrap`` joins the last column to the first."""
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns if wrap else columns - 1), indexing="ij")
    a, b = (i * columns + j).reshape(-1), (i * columns + (j + 1) % columns).reshape(-1)
    return np.concatenate([np.stack([a, b, b + columns], 1), np.stack([a, b + columns, a + columns], 1)])


def sheet(count: int, *, size: float = 0.2, height: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A square sheet in the xz plane, facing up: vertices and faces."""
    axis = np.linspace(-size / 2, size / 2, count)
    z, x = np.meshgrid(axis, axis, indexing="ij")
    return np.stack([x, np.full_like(x, height), z], -1).reshape(-1, 3), grid(count, count)[:, ::-1].copy()


def tube(
    radius: float, *, low: float = -0.2, high: float = 0.2, columns: int = 40
) -> tuple[np.ndarray, np.ndarray]:
    """An open tube about the y axis, facing outwards: vertices and faces."""
    angle = 2 * np.pi * np.arange(columns) / columns
    heights = np.linspace(low, high, 21)
    ring = np.stack([radius * np.sin(angle), np.zeros(columns), radius * np.cos(angle)], -1)
    vertices = ring[None] + np.stack([0 * heights, heights, 0 * heights], -1)[:, None]
    return vertices.reshape(-1, 3), grid(len(heights), columns, wrap=True)


def ball(
    radius: float = 0.1, *, centre: tuple[float, float, float] = (0, 0, 0)
) -> tuple[np.ndarray, np.ndarray]:
    """A closed ball: vertices and faces."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return np.asarray(mesh.vertices) + centre, np.asarray(mesh.faces, np.int64)


def collision(shape: tuple[np.ndarray, np.ndarray], joint: int = TORSO) -> CollisionMesh:
    vertices, faces = shape
    return CollisionMesh.build(faces, weights(len(vertices), joint))


def obstacle(shape: tuple[np.ndarray, np.ndarray], *, margin: float = 0.003, joint: int = TORSO) -> Obstacle:
    return Obstacle(collision(shape, joint), shape[0], margin=margin)
