"""Inner edges of a flat panel that join two points of its seams."""

import numpy as np
from jaxtyping import Bool, Float, Int

from isp_assets.geometry.topology import edges


def split_chords(
    points: Float[np.ndarray, "P 2"], faces: Int[np.ndarray, "F 3"], sewn: Bool[np.ndarray, " P"]
) -> tuple[Float[np.ndarray, "Q 2"], Int[np.ndarray, "G 3"]]:
    """Halve every inner edge between two sewn points.

    Such a chord, as across a narrow sleeve or a sharp corner, tends to be in both
    panels; sewn, its two copies would be one edge with four faces.
    """
    near = np.flatnonzero(sewn[faces].sum(axis=1) >= 2)  # no other face has such an edge
    mesh = edges(faces[near])
    chord = (mesh.num_faces == 2) & sewn[mesh.vertices].all(axis=1)
    if not chord.any():
        return points, faces
    middle = np.full(len(mesh.vertices), -1)
    middle[chord] = len(points) + np.arange(chord.sum())
    points = np.concatenate([points, points[mesh.vertices[chord]].mean(axis=1)])
    cut = chord[mesh.face_edge].any(axis=1)
    parts = [
        _split_face(points, face, mid)
        for face, mid in zip(faces[near[cut]], middle[mesh.face_edge[cut]], strict=True)
    ]
    return points, np.concatenate([np.delete(faces, near[cut], axis=0), *parts])


def _split_face(points: Float[np.ndarray, "P 2"], face: Int[np.ndarray, "3"], mid: Int[np.ndarray, "3"]):
    """Triangles of a face with a new point on each edge where ``mid`` is not negative."""
    count = int((mid >= 0).sum())
    if count == 3:
        (a, b, c), (p, q, r) = face, mid
        return np.array([(a, p, r), (p, b, q), (r, q, c), (p, q, r)])
    # Turn the face until the first edge is cut (one cut) or the last is whole (two cuts).
    turn = int(np.flatnonzero(mid >= 0)[0]) if count == 1 else int(np.flatnonzero(mid < 0)[0] + 1) % 3
    (a, b, c), (p, q, _) = np.roll(face, -turn), np.roll(mid, -turn)
    if count == 1:
        return np.array([(a, p, c), (p, b, c)])
    tip = (p, b, q)
    if np.linalg.norm(points[a] - points[q]) <= np.linalg.norm(points[p] - points[c]):
        return np.array([tip, (a, p, q), (a, q, c)])
    return np.array([tip, (a, p, c), (p, q, c)])
