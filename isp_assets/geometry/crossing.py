"""Pairs of triangles of two meshes that cross, by exact predicates."""

import numpy as np
from igl import predicates
from jaxtyping import Float, Int

_Boxes = tuple[Float[np.ndarray, "F 3"], Float[np.ndarray, "F 3"]]
"""Lower and upper corners."""


def crossing_pairs(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    other_vertices: Float[np.ndarray, "W 3"],
    other_faces: Int[np.ndarray, "G 3"],
) -> Int[np.ndarray, "n 2"]:
    """All pairs (face, other face) that share a point, sorted; touching counts.

    Faces outside the bounding box of the other faces are put aside first, so meshes
    that lie apart cost next to nothing.
    """
    if len(faces) == 0 or len(other_faces) == 0:
        return np.zeros((0, 2), np.int64)
    boxes, other_boxes = _boxes(vertices, faces), _boxes(other_vertices, other_faces)
    mine = _meeting(boxes, other_boxes[0].min(0), other_boxes[1].max(0))
    theirs = _meeting(
        other_boxes, boxes[0][mine].min(0, initial=np.inf), boxes[1][mine].max(0, initial=-np.inf)
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


def _boxes(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> _Boxes:
    """Bounding boxes of faces."""
    first, second, third = (vertices[corner] for corner in faces.T)
    return np.minimum(np.minimum(first, second), third), np.maximum(np.maximum(first, second), third)


def _meeting(
    boxes: _Boxes, low: Float[np.ndarray, " 3"], high: Float[np.ndarray, " 3"]
) -> Int[np.ndarray, " n"]:
    """Rows of the boxes that meet a box."""
    both = (boxes[1] >= low) & (boxes[0] <= high)
    return np.flatnonzero(both[:, 0] & both[:, 1] & both[:, 2])
