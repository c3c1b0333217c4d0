"""What is left to do after marching: stray pieces, pinholes, and faces that face one way."""

import igl
import numpy as np

SMALLEST = 0.02
"""Pieces with less than this share of the largest piece's faces are dropped."""


def clean_mesh(vertices: np.ndarray, faces: np.ndarray, *, fill: int) -> tuple[np.ndarray, np.ndarray]:
    """Drop degenerate and doubled faces and stray pieces, close pinholes, face outwards.

    Args:
        vertices: [V, 3].
        faces: [F, 3].
        fill: Holes of up to this many edges are closed.
    """
    faces = _distinct(faces)
    if len(faces) == 0:
        return vertices[:0], faces
    faces = _without_fins(faces)
    _, piece = igl.facet_components(faces)
    size = np.bincount(piece)
    faces = faces[(size >= SMALLEST * size.max())[piece]]
    faces = _outwards(vertices, faces)
    vertices, faces, _ = igl.split_nonmanifold(vertices, faces)  # borders that touch in a point come apart
    vertices, faces = _fill_holes(vertices, faces, fill)
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3).astype(np.int64)


def boundary_loops(faces: np.ndarray) -> list[np.ndarray]:
    """Vertices of every closed border."""
    return [np.array(loop) for loop in igl.boundary_loop_all(faces)]


def _distinct(faces: np.ndarray) -> np.ndarray:
    """Faces with three different corners, each once."""
    a, b, c = np.sort(faces, axis=1).T
    count = faces.max(initial=0) + 1
    _, first = np.unique((a * count + b) * count + c, return_index=True)
    first.sort()
    return faces[first[(a < b)[first] & (b < c)[first]]]


def _without_fins(faces: np.ndarray) -> np.ndarray:
    """Where more than two faces meet at an edge, drop those that hang loose on another edge."""
    for _ in range(3):
        ends = np.sort(faces[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2), axis=1)
        key = ends[:, 0] * (faces.max(initial=0) + 1) + ends[:, 1]
        _, edge, count = np.unique(key, return_inverse=True, return_counts=True)
        uses = count[edge].reshape(-1, 3)
        fin = (uses > 2).any(1) & (uses == 1).any(1)
        if not fin.any():
            break
        faces = faces[~fin]
    return faces


def _outwards(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Wind the faces of every piece alike; a tube around the body faces away from its inside."""
    faces, piece = igl.bfs_orient(faces)
    corners = vertices[faces] - vertices[faces].mean((0, 1))
    flux = np.einsum("fd,fd->f", np.cross(corners[:, 0], corners[:, 1]), corners[:, 2])
    inwards = np.bincount(piece, flux) < 0
    return np.where(inwards[piece, None], faces[:, ::-1], faces)


def _fill_holes(vertices: np.ndarray, faces: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Close small holes with a fan around their middle."""
    points, fans = [vertices], [faces]
    count = len(vertices)
    for loop in boundary_loops(faces):
        if len(loop) <= most:
            points.append(vertices[loop].mean(0, keepdims=True))
            fans.append(np.stack([np.roll(loop, -1), loop, np.full(len(loop), count)], axis=1))
            count += 1
    return np.concatenate(points), np.concatenate(fans)
