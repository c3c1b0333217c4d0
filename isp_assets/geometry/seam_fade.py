"""How far into a panel the closing of its seams reaches.

Two learnt lifts never meet exactly. Moving only the seam points together would
leave a ridge, so the panel's inside follows, less and less with its distance from the seam.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

_REACH = 0.15
"""Distance from a seam at which points stay where they are [network units]."""
_SOURCES = 6
"""Seam points that a point follows."""


@dataclass(frozen=True, eq=False)
class SeamFade:
    """Weights with which points follow the moves of seam points."""

    points: Int[np.ndarray, " n"]
    """Points near a seam, but on none."""
    sources: Int[np.ndarray, "n k"]
    """The seam points that each follows."""
    weights: Float[np.ndarray, "n k"]
    """Share of each seam point's move; their sum falls from 1 at the seam to 0 at the reach."""
    distance: Float[np.ndarray, " n"]
    """To the nearest seam point, in the units of the panel."""


def seam_fade(
    points: Float[np.ndarray, "P 2"], sewn: Int[np.ndarray, " s"], *, reach: float = _REACH
) -> SeamFade:
    """Weights of the seam points nearest to each point of a flat panel.

    Args:
        points: All points of the panel.
        sewn: Points on its seams, each once.
        reach: Distance at which the weight becomes 0, in the units of ``points``.
    """
    count = min(_SOURCES, len(sewn))
    if count == 0:
        empty = np.empty((0, 1))
        return SeamFade(np.empty(0, dtype=np.int64), empty.astype(np.int64), empty, np.empty(0))
    # Unbalanced: a balanced tree can hang where the processor flushes denormal numbers.
    tree = cKDTree(points[sewn], balanced_tree=False)
    distance, nearest = tree.query(points, k=np.arange(1, count + 1), distance_upper_bound=reach)
    nearest[np.isinf(distance)] = 0  # fewer are in reach: any will do, its share is 0
    near = distance[:, 0] < reach
    near[sewn] = False
    rows = np.flatnonzero(near)
    distance, nearest = distance[rows], nearest[rows]
    weights = 1.0 / np.maximum(distance, 1e-9) ** 2
    weights *= ((1.0 - distance[:, :1] / reach) ** 2) / weights.sum(axis=1, keepdims=True)
    return SeamFade(rows, sewn[nearest], weights, distance[:, 0])
