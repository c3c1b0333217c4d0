"""Faces that are folded over: they look against the mean of their neighbours."""

import numpy as np
from jaxtyping import Bool, Float, Int

from isp_assets.geometry.closest import unit_face_normals


def folded_faces(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], pairs: Int[np.ndarray, "H 2"]
) -> Bool[np.ndarray, " F"]:
    """Which faces are folded over.

    Args:
        vertices: Positions [m].
        faces: Triangles, consistently wound.
        pairs: Faces that share an edge, as `topology.hinges` gives them.
    """
    normals = unit_face_normals(vertices, faces)
    around = np.zeros_like(normals)
    for own, other in (pairs.T, pairs.T[::-1]):
        np.add.at(around, own, normals[other])
    return (normals * around).sum(axis=1) < 0
