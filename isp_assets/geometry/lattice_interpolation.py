"""Smooth functions on a fine mesh from their values on a coarse lattice.

A function that a network gives costs the same at every point, however near the
next one is. Where a mesh is finer than the function needs, its values on a lattice
are interpolated by bicubic convolution, with an error of third order in the
lattice's step. Close to the border of the domain, points keep their own evaluation.

Reference: Keys, "Cubic Convolution Interpolation for Digital Image Processing",
IEEE Transactions on Acoustics, Speech, and Signal Processing, 1981.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor, nn

_STENCIL = np.arange(-1, 3)
_REACH = np.sqrt(2)
"""Steps to the border from which a point is interpolated: the corners of its cell are inside. Nodes beyond
them may lie outside, where the function must go on smoothly for half a step or so."""


@dataclass(frozen=True, eq=False)
class LatticeInterpolation:
    """Where to evaluate a function, and how to get its values at the points of a mesh."""

    places: Float[np.ndarray, "M 2"]
    """Lattice nodes, then the points that are evaluated themselves."""
    exact: Int[np.ndarray, " e"]
    """These points."""
    points: Int[np.ndarray, " n"]
    """Points that are interpolated."""
    sources: Int[np.ndarray, "n 16"]
    """Rows of ``places`` that each of them is made of."""
    weights: Float[np.ndarray, "n 16"]
    """Their shares; they sum to 1."""

    @classmethod
    def build(
        cls, points: Float[np.ndarray, "P 2"], border: Int[np.ndarray, " b"], *, step: float
    ) -> "LatticeInterpolation":
        """Choose what to interpolate.

        Args:
            points: Points of the mesh.
            border: Those on the border of the domain, about as dense as the mesh.
            step: Of the lattice; it is anchored at the origin.
        """
        # Unbalanced: a balanced tree can hang where the processor flushes denormal numbers.
        tree = cKDTree(points[border], balanced_tree=False)
        distance, _ = tree.query(points, distance_upper_bound=_REACH * step)
        inside = np.isinf(distance)
        rows = np.flatnonzero(inside)
        scaled = points[rows] / step
        cell = np.floor(scaled)
        along = _cubic(scaled - cell)
        low = cell.min(axis=0) if len(rows) else np.zeros(2)
        column, row = (cell - low).astype(np.int64).T
        num_columns, num_rows = (int(k.max(initial=-1)) + 1 for k in (column, row))
        has_points = np.zeros((num_rows, num_columns), bool)
        has_points[row, column] = True
        width = num_columns + len(_STENCIL) - 1
        is_used = np.zeros((num_rows + len(_STENCIL) - 1, width), bool)  # nodes, from one before the cells on
        for i in range(len(_STENCIL)):
            for j in range(len(_STENCIL)):
                is_used[i : i + num_rows, j : j + num_columns] |= has_points
        used_row, used_column = np.nonzero(is_used)
        number = np.cumsum(is_used.reshape(-1)) - 1
        stencil = (width * (_STENCIL[:, None] + 1) + _STENCIL + 1).reshape(-1)
        exact = np.flatnonzero(~inside)
        return cls(
            places=np.concatenate([step * (np.stack([used_column, used_row], 1) + low - 1), points[exact]]),
            exact=exact,
            points=rows,
            sources=number[(width * row + column)[:, None] + stencil],
            weights=(along[:, 1, :, None] * along[:, 0, None, :]).reshape(len(rows), 16),
        )

    def __call__(
        self, function: Callable[[Float[Tensor, "M 2"]], Float[Tensor, "M C"]], like: Tensor
    ) -> Float[Tensor, "P C"]:
        """Values at all points, at the precision and on the device of ``like``; differentiable."""
        values = function(torch.from_numpy(self.places).to(like))
        num_nodes = len(self.places) - len(self.exact)
        result = values.new_empty(len(self.exact) + len(self.points), values.shape[1])
        result = result.index_copy(0, torch.from_numpy(self.exact).to(like.device), values[num_nodes:])
        if len(self.points) == 0:
            return result
        sources = torch.from_numpy(self.sources).to(like.device)
        weights = torch.from_numpy(self.weights).to(values)
        mixed = nn.functional.embedding_bag(sources, values, mode="sum", per_sample_weights=weights)
        return result.index_copy(0, torch.from_numpy(self.points).to(like.device), mixed)


def _cubic(share: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2 4"]:
    """Weights of the nodes -1, 0, 1, 2 at a share of the way from node 0 to node 1."""
    t = share[..., None]
    powers = np.concatenate([np.ones_like(t), t, t**2, t**3], axis=-1)
    return powers @ (0.5 * np.array([[0, 2, 0, 0], [-1, 0, 1, 0], [2, -5, 4, -1], [-1, 3, -3, 1]]))
