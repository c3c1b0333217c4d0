"""Ease stretched cloth: bring faces that are strained too far back towards their flat shape.

A few steps of projective dynamics. Each face offers the nearest edge lengths within the
limits; one sparse system, factored once a garment, finds the positions that agree with
the offers and with where the vertices were. Faces within the limits offer what they
have, so that folds stay.

Positions are in metres, in one shared space. NumPy, one frame at a time.

Reference: Bouaziz et al., "Projective Dynamics: Fusing Constraint Projections for Fast
Simulation", ACM Transactions on Graphics 33(4), 2014.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import SuperLU, splu

from isp_assets.errors import GeometryError
from isp_assets.geometry.energy import ClothRest

STRETCH_LIMIT = 0.06
"""Largest relative change of length that is left as it is."""

CRUMPLED = 0.75
"""Share of its size to which hidden cloth may shrink, as a mesh shows folds that are too small for it."""

_FOLLOW = 0.05  # distance over which a correction spreads in one step [m]
_HELD = 1e6  # weight of a held vertex, relative to a free one


@dataclass(frozen=True, eq=False)
class StretchLimit:
    """What easing needs of one garment; static over frames."""

    faces: Int[np.ndarray, "F 3"]
    inverse_rest: Float[np.ndarray, "F 2 2"]
    """Inverse of the flat edge matrix of every face [1/m]."""
    limit: float
    least: Float[np.ndarray, " F"]
    """Smallest stretch of every face that is left as it is."""
    gradient: csr_array
    """[2 F, V]: positions to the two columns of every face's deformation gradient."""
    weighted: csr_array
    """[V, 2 F]: its transpose, faces weighted by their flat areas."""
    inertia: Float[np.ndarray, " V"]
    solver: SuperLU

    @classmethod
    def build(
        cls, rest: ClothRest, *, held: Bool[np.ndarray, " V"], limit: float = STRETCH_LIMIT
    ) -> "StretchLimit":
        """Factor the system of a garment.

        Args:
            rest: Its flat state, graded to the body.
            held: Vertices that must not move.
            limit: Largest relative change of length that is left as it is.

        Raises:
            GeometryError: If the limit is negative.
        """
        if limit < 0:
            raise GeometryError(f"the stretch limit must be >= 0, got {limit:g}")
        faces = rest.faces.cpu().numpy()
        inverse = rest.inverse_rest.cpu().double().numpy()
        area = rest.area.cpu().double().numpy()
        gradient = deformation_gradient(faces, inverse, len(held))
        weighted = (gradient.T @ diags_array(np.repeat(area, 2))).tocsr()
        inertia = np.bincount(faces.reshape(-1), np.repeat(area / 3, 3), minlength=len(held)) / _FOLLOW**2
        inertia = np.where(held, _HELD * inertia.max(), inertia)
        solver = factored(weighted @ gradient + diags_array(inertia))
        least = np.full(len(faces), 1 - limit)
        return cls(faces, inverse, limit, least, gradient, weighted, inertia, solver)

    def loosened(self, share: Float[np.ndarray, " V"], *, least: float = CRUMPLED) -> "StretchLimit":
        """The same, with cloth free to shrink to ``least`` of its size: to crumple.

        Args:
            share: How far it may do so at each vertex, 0 to 1.
            least: Share of its size that is left where it may wholly.
        """
        free = share[self.faces].max(axis=1)
        return replace(self, least=self.least + free * np.minimum(least - self.least, 0))

    def ease(self, vertices: Float[np.ndarray, "V 3"], *, steps: int) -> Float[np.ndarray, "V 3"]:
        """Positions after some steps; the array that came in, if no face is strained beyond the limit."""
        for _ in range(steps):
            offered, strained = self._offers(vertices)
            if not strained:
                break
            vertices = self.solver.solve(self.weighted @ offered + self.inertia[:, None] * vertices)
        return vertices

    def _offers(self, vertices: Float[np.ndarray, "V 3"]) -> tuple[Float[np.ndarray, "n 3"], bool]:
        """Each face's deformation gradient, its stretches clipped to the limits; and whether any was."""
        deformation = self.gradient @ vertices
        x, y = deformation[0::2], deformation[1::2]
        xx, yy, xy = (np.einsum("fc,fc->f", *pair) for pair in ((x, x), (y, y), (x, y)))
        middle, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
        spread = np.sqrt(half * half + xy * xy)
        high, low = np.sqrt(middle + spread), np.sqrt((middle - spread).clip(1e-12))
        first = high.clip(self.least, 1 + self.limit) / np.maximum(high, 1e-6)
        second = low.clip(self.least, 1 + self.limit) / np.maximum(low, 1e-6)
        # Clipping factors (first, second) along the principal axes, as a symmetric 2x2 matrix.
        turn_cos, turn_sin = half / np.maximum(spread, 1e-12), xy / np.maximum(spread, 1e-12)
        mean, difference = 0.5 * (first + second), 0.5 * (first - second)
        a, d, b = mean + difference * turn_cos, mean - difference * turn_cos, difference * turn_sin
        offered = np.empty_like(deformation)
        offered[0::2] = x * a[:, None] + y * b[:, None]
        offered[1::2] = x * b[:, None] + y * d[:, None]
        return offered, bool((first != 1).any() or (second != 1).any())


def factored(matrix: csr_array) -> SuperLU:
    """A symmetric positive definite matrix, factored."""
    options = {"SymmetricMode": True}
    return splu(csc_array(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)


def deformation_gradient(
    faces: Int[np.ndarray, "F 3"], inverse: Float[np.ndarray, "F 2 2"], num_vertices: int
) -> csr_array:
    """[2 F, V]: the matrix that takes positions to the two columns of every face's deformation gradient.

    Args:
        faces: Triangles.
        inverse: Inverse of the flat edge matrix of every face [1/m].
        num_vertices: V.
    """
    corner = np.empty((len(faces), 2, 3))
    corner[:, :, 1] = inverse[:, 0, :]
    corner[:, :, 2] = inverse[:, 1, :]
    corner[:, :, 0] = -corner[:, :, 1] - corner[:, :, 2]
    column = np.broadcast_to(faces[:, None], corner.shape).reshape(-1)
    row = np.repeat(np.arange(2 * len(faces)), 3)
    return csr_array((corner.reshape(-1), (row, column)), shape=(2 * len(faces), num_vertices))
