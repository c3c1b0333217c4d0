"""A square of cloth held along its top edge, far from any body: what physics tests hang."""

import numpy as np

from isp_assets.physics import Cloth, PhysicsScene


def hanging_square(size: int) -> PhysicsScene:
    """A flat square of half a metre in the plane z = 0, ``size`` vertices a side; one frame."""
    x, y = np.meshgrid(*[np.linspace(0, 0.5, size)] * 2)
    flat = np.stack([x, y], -1).reshape(-1, 2)
    grid = np.arange(size**2).reshape(size, size)
    quad = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], -1).reshape(-1, 4)
    faces = np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])
    start = np.c_[flat, np.zeros(len(flat))][None]
    cloth = Cloth("square", faces, flat[faces], start, grid[-1])
    body = 0.1 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]) + (0, -9, 0)
    return PhysicsScene((cloth,), np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]), body[None])
