"""Elastic energy of cloth: StVK membrane, isometric bending, gravity.

Positions are in metres, Y up, in one shared space; energies are in joules. Every
function is pure, differentiable in the positions, and batched over leading axes.

Membrane: Saint Venant-Kirchhoff with the rest metric of the flat panels,
``A (mu E:E + lambda/2 tr(E)^2)``, ``E = (F^T F - I) / 2``. Bending: the quadratic
isometric model, ``k/2 * 3/A * |sum_i w_i x_i|^2`` a hinge (Bergou et al., "A
Quadratic Bending Model for Inextensible Surfaces", SGP 2006). Its limit depends on
the pattern of the edges: on the regular lattice inside our panels it tends to
``k/2 * integral of 3 (k1^2 + k2^2) - 2 k1 k2`` of the principal curvatures. So cloth
bent to a cylinder, in any direction, is as stiff as a plate of 3 k.
"""

from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from isp_assets.conventions import GRAVITY
from isp_assets.errors import GeometryError
from isp_assets.geometry.topology import hinges


@dataclass(frozen=True)
class Fabric:
    """Material constants of thin cloth; the thickness is already in them."""

    mu: float = 11.1
    """First Lamé constant times thickness [N/m]."""
    lam: float = 20.9
    """Second Lamé constant times thickness [N/m]."""
    bending: float = 2e-5
    """Constant k of the bending model [N m]; a cylinder is as stiff as a plate of 3 k."""
    density: float = 0.2
    """Mass per area [kg/m^2]."""

    def __post_init__(self) -> None:
        if min(self.mu, self.lam, self.bending) < 0 or self.density <= 0:
            raise GeometryError(
                f"fabric constants must not be negative, and the density above zero; got {self}"
            )


@dataclass(frozen=True, eq=False)
class ClothRest:
    """What the energy needs to know of a garment's flat state, computed once."""

    faces: Int[Tensor, "F 3"]
    inverse_rest: Float[Tensor, "F 2 2"]
    """Inverse of the flat edge matrix of every face [1/m]."""
    area: Float[Tensor, " F"]
    """Flat area of every face [m^2]."""
    hinges: Int[Tensor, "H 4"]
    hinge_weights: Float[Tensor, "H 4"]
    """Cotangent weights; their combination of flat positions vanishes."""
    hinge_area: Float[Tensor, " H"]
    """Flat area of the two faces of every hinge [m^2]."""
    mass: Float[Tensor, " V"]
    """Lumped mass of every vertex [kg]."""

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> "ClothRest":
        """Copy to a device, and to a floating type (indices keep theirs)."""
        moved = {}
        for field in fields(self):
            value = getattr(self, field.name)
            moved[field.name] = value.to(device=device, dtype=dtype if value.is_floating_point() else None)
        return ClothRest(**moved)


def cloth_rest(
    faces: Int[np.ndarray, "F 3"], corners: Float[np.ndarray, "F 3 2"], num_vertices: int, fabric: Fabric
) -> ClothRest:
    """Precompute the rest state from flat panel corners.

    Args:
        faces: Triangles of the sewn garment.
        corners: Flat positions of every face's corners [m]; faces of the two panels
            may be wound either way, only lengths and angles count.
        num_vertices: Vertices of the sewn garment.
        fabric: Gives the density of ``mass``.

    Raises:
        GeometryError: If a face is flat to a line, or indices are out of range.
    """
    if faces.size and (faces.min() < 0 or faces.max() >= num_vertices):
        raise GeometryError(f"faces must index 0..{num_vertices - 1}, got {faces.min()}..{faces.max()}")
    rest = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=-1).astype(
        np.float64
    )
    area = 0.5 * np.abs(np.linalg.det(rest))
    longest = np.abs(rest).max(axis=(1, 2), initial=0)
    if (area <= 1e-9 * longest**2).any():
        raise GeometryError(f"face {int((area / (longest**2 + 1e-30)).argmin())} has no area in its panel")
    hinge = hinges(faces)
    mass = np.bincount(faces.reshape(-1), np.repeat(area * fabric.density / 3, 3), minlength=num_vertices)
    return ClothRest(
        faces=torch.as_tensor(faces, dtype=torch.int64),
        inverse_rest=torch.from_numpy(np.linalg.inv(rest)),
        area=torch.from_numpy(area),
        hinges=torch.as_tensor(hinge.vertices, dtype=torch.int64),
        hinge_weights=torch.from_numpy(_hinge_weights(corners, hinge.faces, hinge.corners)),
        hinge_area=torch.from_numpy(area[hinge.faces].sum(axis=1)),
        mass=torch.from_numpy(mass),
    )


def _hinge_weights(corners: np.ndarray, face: np.ndarray, corner: np.ndarray) -> Float[np.ndarray, "H 4"]:
    position = corners[face[..., None], corner]  # [H, 2 faces, (start, end, opposite), 2]

    def cotangent(at: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        u, v = a - at, b - at
        return (u * v).sum(-1) / np.abs(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])

    start, end, opposite = (position[:, :, k] for k in range(3))
    at_start, at_end = cotangent(start, end, opposite), cotangent(end, start, opposite)
    opposite_weight = -(at_start + at_end)
    return np.concatenate(
        [at_end.sum(1, keepdims=True), at_start.sum(1, keepdims=True), opposite_weight], axis=1
    )


def membrane_energy(
    vertices: Float[Tensor, "*batch V 3"], rest: ClothRest, fabric: Fabric
) -> Float[Tensor, "*batch"]:
    """Energy of stretch and shear [J] against the flat panels."""
    # Axis first, faces last: weights then broadcast along contiguous memory, a third faster.
    position = vertices.movedim(-1, 0)
    a, b, c = (position.index_select(-1, corner) for corner in rest.faces.unbind(-1))
    first, second = b - a, c - a
    inverse = rest.inverse_rest
    along_x = first * inverse[:, 0, 0] + second * inverse[:, 1, 0]
    along_y = first * inverse[:, 0, 1] + second * inverse[:, 1, 1]
    strain_x = 0.5 * ((along_x * along_x).sum(0) - 1)
    strain_y = 0.5 * ((along_y * along_y).sum(0) - 1)
    shear = 0.5 * (along_x * along_y).sum(0)
    trace = strain_x + strain_y
    density = fabric.mu * (strain_x**2 + strain_y**2 + 2 * shear**2) + 0.5 * fabric.lam * trace**2
    return (rest.area * density).sum(-1)


def bending_energy(
    vertices: Float[Tensor, "*batch V 3"], rest: ClothRest, fabric: Fabric
) -> Float[Tensor, "*batch"]:
    """Energy of bending away from flat [J]."""
    position = vertices.movedim(-1, 0)
    corners, weights = rest.hinges.unbind(-1), rest.hinge_weights.unbind(-1)
    terms = [
        position.index_select(-1, corner) * weight for corner, weight in zip(corners, weights, strict=True)
    ]
    curvature = terms[0] + terms[1] + terms[2] + terms[3]
    return (1.5 * fabric.bending / rest.hinge_area * (curvature * curvature).sum(0)).sum(-1)


def gravity_energy(
    vertices: Float[Tensor, "*batch V 3"], rest: ClothRest, *, gravity: float = GRAVITY
) -> Float[Tensor, "*batch"]:
    """Potential energy [J] above the origin, up being +Y."""
    return gravity * (rest.mass * vertices[..., 1]).sum(-1)
