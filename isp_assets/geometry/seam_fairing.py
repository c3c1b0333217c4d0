"""Smooth a sewn surface beside its seams.

Learnt lifts of panels curl by some tenths of a millimetre just before the border, where
nothing beyond held them in training. Distances hardly show it, but on meshes whose triangles
are not much longer it tilts them, as a crease along the seam that the cloth does not have.

NumPy; positions in metres.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array

_ROUNDS = 6
_STRENGTH = 0.5
"""Share of the way to the mean of its neighbours that a seam vertex goes in one round."""


def fair_seams(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    distance: Float[np.ndarray, " V"],
    *,
    reach: float,
) -> Float[np.ndarray, "V 3"]:
    """Average positions with those of their neighbours, less and less with the distance from a seam.

    Args:
        vertices: The sewn surface [m].
        faces: Its triangles.
        distance: From the nearest seam; infinite where a vertex must stay.
        reach: Distance from which on vertices stay, in the same units.
    """
    near = (1 - distance / reach).clip(0, 1)
    share = _STRENGTH * near * near * (3 - 2 * near)
    rows = np.flatnonzero(share)
    band = faces[(share[faces] > 0).any(axis=1)]
    start, end = band.reshape(-1), np.roll(band, -1, axis=1).reshape(-1)
    pairs = (np.ones(2 * len(start), vertices.dtype), (np.r_[start, end], np.r_[end, start]))
    adjacent = coo_array(pairs, shape=(len(vertices), len(vertices))).tocsr()[rows]
    adjacent.data[:] = 1  # an edge counts once, not once for each of its faces
    count = adjacent.sum(axis=1)
    result, weight = vertices.copy(), share[rows, None].astype(vertices.dtype)
    for _ in range(_ROUNDS):
        mean = (adjacent @ result) / count[:, None]
        result[rows] += weight * (mean - result[rows])
    return result
