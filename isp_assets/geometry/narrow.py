"""Cloth that has little room: how little, how far it may crumple, and how it is smoothed to lie flat.

Where parts of the body press together, the networks leave cloth in folds as small as its
triangles. Vertices can be lifted apart there, but triangles go on crossing; nobody sees
the folds. Positions are in metres. NumPy, one frame at a time.
"""

import numpy as np
from jaxtyping import Bool, Float

from isp_assets.geometry.closest import Closest
from isp_assets.geometry.obstacle import NO_ROOM, CollisionMesh, Obstacle, mean_edge
from isp_assets.geometry.spread import fade_out
from isp_assets.geometry.stretch import StretchLimit

_ROOM = 0.008  # from this room [m] on cloth keeps its folds
_BESIDE = 0.01  # cloth this near [m] to the place has its room; twice as far, it is not concerned
_WHOLE = 0.97  # share of the margin: where room leaves less, other skin is near
_LEAST = 0.83  # share of its size to which cloth without room may shrink: stretched out, it would buckle
_AROUND = 0.12  # the same in part for cloth within this distance [m] of it
_LEAST_AT_BORDER = 0.68  # the same at an open border: nothing holds it back from going into the body
_AROUND_BORDER = 0.06  # and for cloth within this distance [m] of that
_STEP = 0.4  # part of the way to its neighbours' mean that a vertex goes at once
_FOLD = 0.018  # about the size of the folds that are smoothed [m], whatever the size of the triangles
_MOST_STEPS = 9
_FADE = 0.12  # distance [m] within which cloth around it is smoothed too


def narrowness(obstacle: Obstacle, found: Closest) -> Float[np.ndarray, " P"]:
    """How little room points have: 1 where the surface beneath touches itself, 0 where cloth may hang freely.

    It falls steadily as the room grows, so that cloth does not flicker between two states.

    Args:
        obstacle: What lies beneath.
        found: The points' closest points on it.
    """
    room = obstacle.room[obstacle.mesh.topology.faces[found.face]].min(axis=1)
    beside = (2 - np.abs(found.height) / _BESIDE).clip(0, 1)
    return beside * ((_ROOM - room) / (_ROOM - NO_ROOM)).clip(0, 1)


def squeezed(obstacle: Obstacle, found: Closest) -> Bool[np.ndarray, " P"]:
    """Points on a surface over which room leaves less than the margin; a wider circle than `narrowness`.

    Args:
        obstacle: What lies beneath.
        found: The points' closest points on it.
    """
    return (found.height < _BESIDE) & (obstacle.margin_at(found) < _WHOLE * obstacle.margin)


def crumpled(
    stretch: StretchLimit, mesh: CollisionMesh, narrow: Float[np.ndarray, " V"], *, edge: float
) -> StretchLimit:
    """Limits of stretch that let cloth crumple where it has little room.

    Args:
        stretch: The garment's limits where it hangs freely.
        mesh: Its collision data.
        narrow: How little room its vertices have, 0 to 1.
        edge: Mean length of its edges [m].
    """
    faces, at_border = mesh.topology.faces, mesh.topology.border_rings < 1
    border = fade_out(narrow * at_border, faces, reach=_AROUND_BORDER, edge=edge)
    stretch = stretch.loosened(fade_out(narrow, faces, reach=_AROUND, edge=edge), least=_LEAST)
    return stretch.loosened(border, least=_LEAST_AT_BORDER)


def flatten(
    position: Float[np.ndarray, "V 3"],
    mesh: CollisionMesh,
    share: Float[np.ndarray, " V"],
    *,
    fade: float = _FADE,
) -> Float[np.ndarray, "V 3"]:
    """Moves that smooth cloth [m].

    Args:
        position: The garment [m].
        mesh: Its collision data.
        share: How far each vertex is to be smoothed, 0 to 1.
        fade: Distance [m] over which the smoothing fades around it.
    """
    if not share.any():
        return np.zeros_like(position)
    edge = mean_edge(position, mesh.topology.faces)
    share = fade_out(share, mesh.topology.faces, reach=fade, edge=edge)
    smoothed, factor = position, _STEP * share[:, None]
    for _ in range(min(max(1, round((_FOLD / edge) ** 2)), _MOST_STEPS)):
        smoothed = smoothed + factor * (mesh.topology.neighbour_average @ smoothed - smoothed)
    return smoothed - position
