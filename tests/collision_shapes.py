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


FOLDED_PROFILE = np.array(
    [[0.1, y] for y in np.linspace(-0.2, 0, 11)]
    + [[0.13, 0.03], [0.105, 0.06], [0.125, 0.05]]
    + [[0.1, y] for y in np.linspace(0.06, 0.2, 8)]
)
"""Radius and height of `folded_tube`, from its low border to its high one."""


def folded_tube(columns: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """A tube of radius 0.1 with a fold around it that cuts itself: vertices and faces."""
    angle = 2 * np.pi * np.arange(columns) / columns
    radius, height = (np.repeat(part[:, None], columns, axis=1) for part in FOLDED_PROFILE.T)
    vertices = np.stack([radius * np.sin(angle), height, radius * np.cos(angle)], -1)
    return vertices.reshape(-1, 3), grid(len(FOLDED_PROFILE), columns, wrap=True)


def beside_fold(count: int = 2000) -> tuple[np.ndarray, np.ndarray]:
    """Points around the fold of `folded_tube`, and which of them lie within its profile and the axis."""
    rng = np.random.default_rng(0)
    radius, height = rng.uniform(0.08, 0.14, count), rng.uniform(0, 0.08, count)
    loop = np.concatenate([FOLDED_PROFILE, [[0, 0.2], [0, -0.2]], FOLDED_PROFILE[:1]])
    seen = loop[None] - np.stack([radius, height], 1)[:, None]
    turns = np.diff(np.arctan2(seen[..., 1], seen[..., 0]), axis=1)
    turns = ((turns + np.pi) % (2 * np.pi) - np.pi).sum(axis=1) / (2 * np.pi)
    points = np.stack([0 * radius, height, radius], axis=1)
    return points, turns > 0.5


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
