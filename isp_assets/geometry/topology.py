"""Connectivity of triangle meshes: edges, hinges, border loops, welding. Integers only, no positions."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from isp_assets.errors import GeometryError


@dataclass(frozen=True, eq=False)
class Edges:
    """The undirected edges of a mesh, sorted, each once."""

    vertices: Int[np.ndarray, "E 2"]
    """End points, the smaller index first."""
    face_edge: Int[np.ndarray, "F 3"]
    """Edge from corner ``k`` to corner ``k + 1`` of every face."""
    num_faces: Int[np.ndarray, " E"]
    """Faces at each edge: 1 on the border, 2 inside."""


@dataclass(frozen=True, eq=False)
class Hinges:
    """Pairs of faces that share an edge."""

    vertices: Int[np.ndarray, "H 4"]
    """The edge's two end points, then the opposite corners of the first and of the second face."""
    faces: Int[np.ndarray, "H 2"]
    corners: Int[np.ndarray, "H 2 3"]
    """Per face, the corner numbers (0..2) of edge start, edge end and opposite corner."""


def edges(faces: Int[np.ndarray, "F 3"]) -> Edges:
    """Collect the undirected edges of a mesh."""
    directed = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    directed = np.sort(directed, axis=1).astype(np.int64)
    # One number an edge, in the order of its rows: sorting numbers is far faster than sorting rows.
    keys, inverse = np.unique((directed[:, 0] << 32) | directed[:, 1], return_inverse=True)
    inverse = inverse.reshape(-1)
    unique = np.stack([keys >> 32, keys & 0xFFFFFFFF], axis=1)
    count = np.bincount(inverse, minlength=len(unique))
    return Edges(vertices=unique, face_edge=inverse.reshape(-1, 3), num_faces=count)


def hinges(faces: Int[np.ndarray, "F 3"]) -> Hinges:
    """Find every inner edge with its two faces.

    Raises:
        GeometryError: If an edge has more than two faces.
    """
    mesh = edges(faces)
    if (mesh.num_faces > 2).any():
        worst = mesh.vertices[mesh.num_faces.argmax()]
        raise GeometryError(
            f"mesh is not a surface: edge {worst.tolist()} has {mesh.num_faces.max()} faces, "
            "expected at most 2"
        )
    order = np.argsort(mesh.face_edge.reshape(-1), kind="stable")
    start = np.searchsorted(mesh.face_edge.reshape(-1)[order], np.flatnonzero(mesh.num_faces == 2))
    half = np.stack([order[start], order[start + 1]], axis=1)
    face, first = half // 3, half % 3
    corners = np.stack([first, (first + 1) % 3, (first + 2) % 3], axis=-1)
    vertex = faces[face[..., None], corners]
    # The second face usually runs along the edge in the other direction: let both start at the same vertex.
    swap = vertex[:, 1, 0] != vertex[:, 0, 0]
    corners[swap, 1] = corners[swap, 1][:, [1, 0, 2]]
    return Hinges(
        vertices=np.concatenate([vertex[:, 0], vertex[:, 1, 2:]], axis=1), faces=face, corners=corners
    )


def boundary_loops(faces: Int[np.ndarray, "F 3"]) -> list[Int[np.ndarray, " _"]]:
    """Trace the border of an oriented mesh.

    Returns:
        Closed loops of vertices without a repeated end point, each with the
        surface on its left, beginning at its smallest vertex; sorted by that vertex.

    Raises:
        GeometryError: If two border loops touch in a vertex, or the faces are not oriented alike.
    """
    directed = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    mesh = edges(faces)
    border = directed[mesh.num_faces[mesh.face_edge.reshape(-1)] == 1]
    following = dict(border.tolist())
    if len(following) != len(border) or set(following) != set(following.values()):
        raise GeometryError(
            "border of the mesh is not a set of separate loops: loops touch, or faces are wound both ways"
        )
    loops, remaining = [], set(following)
    for start in sorted(following):
        if start not in remaining:
            continue
        loop = [start]
        while following[loop[-1]] != start:
            loop.append(following[loop[-1]])
        remaining.difference_update(loop)
        loops.append(np.array(loop))
    return loops


def weld(num_points: int, pairs: Int[np.ndarray, "n 2"]) -> tuple[Int[np.ndarray, " P"], int]:
    """Merge points joined by pairs, directly or through others.

    Returns:
        The vertex of every point, numbered by first appearance, and the number of vertices.

    Raises:
        GeometryError: If a pair names a point that does not exist.
    """
    if pairs.size and (pairs.min() < 0 or pairs.max() >= num_points):
        raise GeometryError(f"weld pairs must lie in 0..{num_points - 1}, got {pairs.min()}..{pairs.max()}")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(num_points, num_points))
    count, component = connected_components(graph, directed=False)
    _, first = np.unique(component, return_index=True)
    rank = np.empty(count, dtype=np.int64)
    rank[np.argsort(first)] = np.arange(count)
    return rank[component], count
