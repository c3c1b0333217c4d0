"""Cloth that has little room: how little, and how it is smoothed so that layers can lie flat on each other.

Where parts of the body press together, the networks leave cloth in folds as small as its
triangles. Vertices can be lifted apart there, but triangles go on crossing; nobody sees
the folds. Positions are in metres. NumPy, one frame at a time.
"""

import numpy as np
from jaxtyping import Float

from isp_assets.geometry.closest import Closest
from isp_assets.geometry.obstacle import NO_ROOM, CollisionMesh, Obstacle

_ROOM = 0.008  # from this room [m] on cloth keeps its folds
_BESIDE = 0.01  # cloth this near [m] to the place has its room; twice as far, it is not concerned
_STEP = 0.4  # part of the way to its neighbours' mean that a vertex goes
_DECAY = 0.8  # how much of the smoothing is left with every ring of faces


def narrowness(obstacle: Obstacle, found: Closest) -> Float[np.ndarray, " P"]:
    """How little room points have: 1 where the surface beneath touches itself, 0 where cloth may hang freely.

    It follows the room continuously, so that cloth does not flicker.

    Args:
        obstacle: What lies beneath.
        found: The points' closest points on it.
    """
    room = obstacle.room[obstacle.mesh.topology.faces[found.face]].min(axis=1)
    beside = (2 - np.abs(found.height) / _BESIDE).clip(0, 1)
    return beside * ((_ROOM - room) / (_ROOM - NO_ROOM)).clip(0, 1)


def flatten(
    position: Float[np.ndarray, "V 3"],
    mesh: CollisionMesh,
    share: Float[np.ndarray, " V"],
    *,
    rings: int = 3,
) -> Float[np.ndarray, "V 3"]:
    """Moves that smooth cloth [m].

    Args:
        position: The garment [m].
        mesh: Its collision data.
        share: How far each vertex is to be smoothed, 0 to 1.
        rings: Rings of faces around it that are smoothed too, less with every one.
    """
    if not share.any():
        return np.zeros_like(position)
    faces, share = mesh.topology.faces, share.copy()
    for _ in range(rings):
        np.maximum.at(share, faces.reshape(-1), np.repeat(_DECAY * share[faces].max(axis=1), 3))
    return _STEP * share[:, None] * (mesh.neighbour_average @ position - position)
