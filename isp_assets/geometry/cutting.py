"""Cut vertices off a mesh so that what is left has a clean border. Integers only, no positions."""

import numpy as np
from jaxtyping import Bool, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from isp_assets.geometry.topology import edges


def faces_without(faces: Int[np.ndarray, "F 3"], gone: Bool[np.ndarray, " V"]) -> Bool[np.ndarray, " F"]:
    """The faces that stay when some vertices go.

    Of what is left in several pieces, the largest stays. No two of its borders meet in a vertex, unless
    they did before.

    Args:
        faces: Triangles.
        gone: Vertices to cut off, with all their faces.
    """
    pinched = _pinched(faces, len(gone))
    gone = gone.copy()
    while True:
        stay = ~gone[faces].any(axis=1)
        found = _pinched(faces[stay], len(gone)) & ~pinched
        if not found.any():
            break
        gone |= found
    if not stay.any():
        return stay
    corner = faces[stay]
    start, end = np.repeat(corner[:, 0], 2), corner[:, 1:].ravel()
    joined = coo_array((np.ones(len(start)), (start, end)), shape=(len(gone),) * 2)
    piece = connected_components(joined, directed=False)[1][corner[:, 0]]
    stay[stay] = piece == np.bincount(piece).argmax()
    return stay


def _pinched(faces: Int[np.ndarray, "F 3"], num_vertices: int) -> Bool[np.ndarray, " V"]:
    """Vertices at which more than two border edges meet."""
    mesh = edges(faces)
    ends = mesh.vertices[mesh.num_faces == 1].ravel()
    return np.bincount(ends, minlength=num_vertices) > 2
