"""The energy of a garment in one frame: membrane, bending and gravity, with what minimising it needs.

The same energy that networks are trained with (`geometry.energy`), in NumPy with sparse matrices
that are made once a garment; and a limit of strain. Positions are in metres, Y up.

Reference, of the limit: Provot, "Deformation Constraints in a Mass-Spring Model to Describe Rigid Cloth
Behavior", Graphics Interface 1995.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.linalg import SuperLU

from isp_assets.conventions import GRAVITY
from isp_assets.geometry.energy import ClothRest, Fabric
from isp_assets.geometry.grading import edge_lengths, edge_strain
from isp_assets.geometry.stretch import deformation_gradient, factored

_HOLD = 3e5  # stiffness per mass with which the body holds cloth [1/s²]: a waistband gives 1 cm in a squat
_DAMPING = 0.05  # share of its diagonal that the matrix gains, since the membrane resists no bending


@dataclass(frozen=True, eq=False)
class ElasticCloth:
    """The energy of one garment of V vertices; its matrices are made when first needed, and kept."""

    rest: ClothRest
    """Its flat state, graded to the body."""
    fabric: Fabric
    free: Bool[np.ndarray, " V"]
    """Vertices that the body does not hold."""

    @cached_property
    def faces(self) -> Int[np.ndarray, "F 3"]:
        return self.rest.faces.cpu().numpy()

    @cached_property
    def flat_lengths(self) -> Float[np.ndarray, "F 3"]:
        """Flat lengths of every face's edges, from each corner to the next [m]."""
        return edge_lengths(self.rest)

    @cached_property
    def area(self) -> Float[np.ndarray, " F"]:
        return self.rest.area.cpu().double().numpy()

    @cached_property
    def mass(self) -> Float[np.ndarray, " V"]:
        return self.rest.mass.cpu().double().numpy()

    @cached_property
    def hold(self) -> Float[np.ndarray, " V"]:
        """How firmly the body holds each vertex [N/m]; free ones not at all."""
        return np.where(self.free, 0.0, _HOLD * self.mass)

    @cached_property
    def sides(self) -> csr_array:
        """[3 F, V]: positions to every face's edges, from each corner to the next."""
        tail, head = self.faces.ravel(), np.roll(self.faces, -1, axis=1).ravel()
        row = np.arange(len(tail))
        entries = np.repeat([-1.0, 1.0], len(row)), (np.tile(row, 2), np.concatenate([tail, head]))
        return coo_array(entries, shape=(len(row), len(self.free))).tocsr()

    @cached_property
    def pulls(self) -> csr_array:
        """[V, 3 F]: its transpose."""
        return self.sides.T.tocsr()

    @cached_property
    def gradient(self) -> csr_array:
        """[2 F, V]: positions to the two columns of every face's deformation gradient."""
        return deformation_gradient(self.faces, self.rest.inverse_rest.cpu().double().numpy(), len(self.free))

    @cached_property
    def weighted(self) -> csr_array:
        """[V, 2 F]: its transpose, faces weighted by their flat areas."""
        return (self.gradient.T @ diags_array(np.repeat(self.area, 2))).tocsr()

    @cached_property
    def bending(self) -> csr_array:
        """[V, V]: the constant Hessian of the bending energy [N/m]."""
        hinge, weights, area = (
            part.cpu().numpy() for part in (self.rest.hinges, self.rest.hinge_weights, self.rest.hinge_area)
        )
        row = np.broadcast_to(np.arange(len(hinge))[:, None], hinge.shape)
        entries = weights.astype(np.float64).ravel(), (row.ravel(), hinge.ravel())
        across = coo_array(entries, shape=(len(hinge), len(self.free))).tocsr()
        return (across.T @ diags_array(3 * self.fabric.bending / area.astype(np.float64)) @ across).tocsr()

    @cached_property
    def solver(self) -> SuperLU:
        """The factored matrix of projective dynamics: that of cloth without strain, damped or held."""
        stiffness = (2 * self.fabric.mu + self.fabric.lam) * (self.weighted @ self.gradient) + self.bending
        diagonal = stiffness.diagonal()
        damping = np.where(self.free, _DAMPING * diagonal, self.hold)
        return factored(stiffness + diags_array(damping))

    def strain_p99(self, vertices: Float[np.ndarray, "V 3"]) -> float:
        """99th percentile of the relative change of edge lengths."""
        return float(np.percentile(np.abs(edge_strain(vertices, self.faces, self.flat_lengths)), 99))

    def energy(self, vertices: Float[np.ndarray, "V 3"]) -> tuple[float, Float[np.ndarray, "V 3"]]:
        """Membrane, bending and gravity together [J], and the gradient [N]; see `geometry.energy`."""
        mu, lam = self.fabric.mu, self.fabric.lam
        deformation = self.gradient @ vertices
        x, y = deformation[0::2], deformation[1::2]
        xx, yy, xy = (np.einsum("fc,fc->f", *pair) for pair in ((x, x), (y, y), (x, y)))
        strain_x, strain_y, shear = 0.5 * (xx - 1), 0.5 * (yy - 1), 0.5 * xy
        trace = strain_x + strain_y
        density = mu * (strain_x**2 + strain_y**2 + 2 * shear**2) + 0.5 * lam * trace**2
        along, across = 2 * mu * strain_x + lam * trace, 2 * mu * strain_y + lam * trace
        stress = np.empty_like(deformation)
        stress[0::2] = x * along[:, None] + y * (2 * mu * shear)[:, None]
        stress[1::2] = y * across[:, None] + x * (2 * mu * shear)[:, None]
        bent = self.bending @ vertices
        gradient = self.weighted @ stress + bent
        gradient[:, 1] += GRAVITY * self.mass
        total = (self.area * density).sum() + 0.5 * (vertices * bent).sum()
        return float(total + GRAVITY * (self.mass * vertices[:, 1]).sum()), gradient

    def limit_energy(
        self,
        vertices: Float[np.ndarray, "V 3"],
        limit: float,
        *,
        stiffness: float,
        pressed: Float[np.ndarray, " n"] | float = 1.0,
    ) -> tuple[float, Float[np.ndarray, "V 3"]]:
        """What edges cost that are strained beyond ``limit`` [J], and the gradient [N].

        Stretched or pressed together: quadratic in what is beyond, so that strain spreads instead of peaking.

        Args:
            vertices: Positions [m].
            limit: Strain, as relative change of length.
            stiffness: Of what is beyond it, relative to the membrane.
            pressed: Share of the stiffness with which each of ``sides`` resists being pressed together.
        """
        side, flat = self.sides @ vertices, self.flat_lengths.ravel()
        length = np.sqrt(np.einsum("nc,nc->n", side, side))
        strain = length / flat - 1
        beyond = np.sign(strain) * (np.abs(strain) - limit).clip(0)
        weight = stiffness * (2 * self.fabric.mu + self.fabric.lam) * np.repeat(self.area, 3) / 3
        weight = weight * np.where(strain < 0, pressed, 1.0)
        pull = (weight * beyond / (flat * np.maximum(length, 1e-9)))[:, None] * side
        return float(0.5 * (weight * beyond**2).sum()), self.pulls @ pull
