"""Cloth that was clear of the skin until projection drove it in.

Easing draws cloth taut over a crease, such as the one in front of an armpit when the arms reach forward,
and skin would show there. The skin folds over itself in such places, so its nearest triangle does not
tell what is hidden: the winding number does.

Positions are in metres, in one shared space. NumPy, one frame at a time.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from isp_assets.geometry.lifts import any_corner
from isp_assets.geometry.obstacle import CollisionMesh, Obstacle, mean_edge
from isp_assets.geometry.spread import fade_out

_FROM, _FULL = 0.001, 0.004  # depths [m] from which cloth goes back a little, and wholly: it must not flicker
_BESIDE = 0.05  # cloth this near [m] to skin without room is looked at
_BURIED = 0.03  # cloth this near [m] to skin that another part hides stays: there is no clear way
_FADE = 0.02  # distance [m] within which neighbouring cloth follows


def driven_in(
    position: Float[np.ndarray, "V 3"],
    start: Float[np.ndarray, "V 3"],
    mesh: CollisionMesh,
    body: Obstacle,
    *,
    tight: Bool[np.ndarray, " V"],
) -> Float[np.ndarray, " V"]:
    """How far each vertex is to go back to where it started, 0 to 1.

    Args:
        position: The garment [m].
        start: The same before it was moved [m].
        mesh: Its collision data.
        body: The body.
        tight: Vertices that have no room where they started either.
    """
    share, faces = np.zeros(len(position)), mesh.topology.faces
    creased = body.vertices[body.tight]
    if len(creased) == 0:
        return share
    near = _distance(creased, position, within=_BESIDE) < _BESIDE
    alone = np.repeat(np.flatnonzero(near)[:, None], 3, axis=1)
    corners = np.concatenate([alone, faces[any_corner(near, faces)]])
    now, before = position[corners].mean(axis=1), start[corners].mean(axis=1)
    hidden = np.flatnonzero(body.winding.inside(now))
    hidden = hidden[~body.winding.inside(before[hidden])]
    if len(hidden) and body.blocked.any():
        buried = _distance(body.vertices[body.blocked], now[hidden], within=_BURIED)
        hidden = hidden[buried >= _BURIED]
    if len(hidden) == 0:
        return share
    depth = np.abs(body.whole(now[hidden]).height)
    back = ((depth - _FROM) / (_FULL - _FROM)).clip(0, 1)
    np.maximum.at(share, corners[hidden], back[:, None])
    share[tight] = 0
    return fade_out(share, faces, reach=_FADE, edge=mean_edge(position, faces))


def _distance(
    these: Float[np.ndarray, "n 3"], points: Float[np.ndarray, "P 3"], *, within: float
) -> Float[np.ndarray, " P"]:
    """Distance from the nearest of ``these`` [m]; infinite beyond ``within``."""
    return cKDTree(these, balanced_tree=False).query(points, distance_upper_bound=within)[0]
