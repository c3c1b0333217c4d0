"""Fields over a mesh: keep the larger of two, let the neighbourhood follow."""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array

_MOST_RINGS = 24


def keep_larger(
    kept: Float[np.ndarray, "V 3"],
    offered: Float[np.ndarray, "n 3"],
    index: Int[np.ndarray, " n"] | None = None,
) -> None:
    """Replace rows of ``kept`` (those of ``index``) where ``offered`` is longer."""
    rows = kept if index is None else kept[index]
    larger = np.einsum("vc,vc->v", offered, offered) > np.einsum("vc,vc->v", rows, rows)
    kept[larger if index is None else index[larger]] = offered[larger]


def fade_out(
    share: Float[np.ndarray, " V"], faces: Int[np.ndarray, "F 3"], *, reach: float, edge: float
) -> Float[np.ndarray, " V"]:
    """Let shares fade steadily around where they are large.

    Args:
        share: One number a vertex, 0 to 1.
        faces: Triangles.
        reach: Distance [m] over which 1 fades to 0.
        edge: Mean length of an edge [m].
    """
    share, rings = share.copy(), min(round(reach / edge), _MOST_RINGS)
    for _ in range(rings - 1):
        np.maximum.at(share, faces.reshape(-1), np.repeat(share[faces].max(axis=1) - 1 / rings, 3))
    return share


def spread(
    move: Float[np.ndarray, "V 3"], neighbour_average: csr_array, *, rings: int, decay: float
) -> Float[np.ndarray, "V 3"]:
    """Let neighbours follow: a screened Laplace equation, by Jacobi rounds.

    A vertex that is to move follows its neighbours too, and adds along its own move what that lacks.
    So it makes no difference whether its own move is zero or very small.

    Args:
        move: Moves [m] that vertices must make at least.
        neighbour_average: Averages a field over the neighbours of each vertex.
        rings: Rounds, and so the number of rings that are reached.
        decay: Part of the neighbours' mean move that a vertex follows.
    """
    size = np.sqrt(np.einsum("vc,vc->v", move, move))
    direction = move / np.maximum(size, 1e-12)[:, None]
    field = move
    for _ in range(rings if size.any() else 0):
        followed = decay * (neighbour_average @ field)
        lacking = (size - np.einsum("vc,vc->v", followed, direction)).clip(0)
        field = followed + np.where(size > 0, lacking, 0)[:, None] * direction
    return field
