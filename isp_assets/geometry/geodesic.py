"""Distances along a mesh, from edge to edge: a little longer than along the surface itself."""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from isp_assets.geometry.topology import edges


def distance_along(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    sources: Int[np.ndarray, " n"],
    *,
    limit: float = np.inf,
) -> Float[np.ndarray, " V"]:
    """Length of the shortest way over edges from each vertex to the nearest source.

    Args:
        vertices: Positions [m].
        faces: Triangles.
        sources: Vertices at distance 0; may be empty.
        limit: Longest way that is looked for [m]; what is further gets infinity.
    """
    if len(sources) == 0:
        return np.full(len(vertices), np.inf)
    start, end = edges(faces).vertices.T
    size = np.linalg.norm(vertices[start] - vertices[end], axis=1)
    # A zero weight would mean "no edge".
    graph = coo_array((np.maximum(size, 1e-9), (start, end)), shape=(len(vertices),) * 2).tocsr()
    return dijkstra(graph, directed=False, indices=sources, min_only=True, limit=limit)
