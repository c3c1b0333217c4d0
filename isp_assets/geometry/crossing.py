"""Pairs of triangles of two meshes that cross, by exact predicates."""

import numpy as np
from igl import predicates
from jaxtyping import Float, Int


def crossing_pairs(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    other_vertices: Float[np.ndarray, "W 3"],
    other_faces: Int[np.ndarray, "G 3"],
) -> Int[np.ndarray, "n 2"]:
    """All pairs (face, other face) that share a point, sorted; touching counts.

    Faces outside the other mesh's bounding box are put aside first, so meshes that
    lie apart cost next to nothing.
    """
    low = np.maximum(vertices.min(0), other_vertices.min(0))
    high = np.minimum(vertices.max(0), other_vertices.max(0))
    mine, theirs = (
        _inside_box(vertices, faces, low, high),
        _inside_box(other_vertices, other_faces, low, high),
    )
    if len(mine) == 0 or len(theirs) == 0:
        return np.zeros((0, 2), np.int64)
    _, pairs, _ = predicates.find_intersections(
        np.ascontiguousarray(vertices, np.float64),
        np.ascontiguousarray(faces[mine], np.int64),
        np.ascontiguousarray(other_vertices, np.float64),
        np.ascontiguousarray(other_faces[theirs], np.int64),
    )
    pairs = pairs.reshape(-1, 2)
    pairs = np.stack([mine[pairs[:, 0]], theirs[pairs[:, 1]]], axis=1)
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]  # several threads find them, in any order


def _inside_box(vertices: np.ndarray, faces: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Faces whose own bounding box meets the box."""
    first, second, third = (vertices[corner] for corner in faces.T)
    above = np.maximum(np.maximum(first, second), third) >= low
    below = np.minimum(np.minimum(first, second), third) <= high
    both = above & below
    return np.flatnonzero(both[:, 0] & both[:, 1] & both[:, 2])
