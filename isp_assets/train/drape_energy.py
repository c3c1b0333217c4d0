"""The physics that D_s is trained with: the energy of a garment at rest in a pose (Eq. 8).

Positions are in metres in the world frame, gravity along -Y; energies in joules.

The rest metric is that of the flat panels, graded to the body: for betas other than
zero each flat triangle is stretched as the garment's shape-skinned T-pose stretches
it, as a tailor grades a pattern. So a shirt for a large body is a larger shirt, not a
small one torn. Bending weights and masses stay those of the ungraded pattern.

Reference: Li, Guillard and Fua, "ISP: Multi-Layered Garment Draping with
Implicit Sewing Patterns", NeurIPS 2023, Eq. 8.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from isp_assets.conventions import GRAVITY
from isp_assets.geometry.contact import Surface, clearance
from isp_assets.geometry.energy import ClothRest, Fabric, bending_energy, gravity_energy, membrane_energy

_REFERENCE_LIFT = 0.05  # energies are compared with that of lifting the garment this far [m]


@dataclass(frozen=True)
class Contact:
    """Penalty for coming nearer to the body than ``margin``."""

    margin: float = 0.007
    """Clearance to keep at the vertices [m]; edges between them cut across curved skin."""
    cubic: float = 250.0
    """Weight of the cube of the lacking clearance [N/m²], as in the paper."""
    stiffness: float = 4e5
    """Weight of its square per mass [1/s²], at the end of training."""
    first_stiffness: float = 2e4
    """The same at the start."""
    depth: float = 0.025
    """Lacking clearance beyond which the penalty grows linearly [m]: where a posed body cuts into itself,
    no cloth can be clear of both sides."""

    def at(self, progress: float) -> float:
        """Stiffness after a share of the training, growing geometrically."""
        return self.first_stiffness * (self.stiffness / self.first_stiffness) ** min(1.25 * progress, 1.0)


def graded_rest(rest: ClothRest, canonical: Float[Tensor, "V 3"], shaped: Float[Tensor, "V 3"]) -> ClothRest:
    """The pattern graded from the mean body to another.

    Args:
        rest: The pattern as drawn.
        canonical: The garment on the mean body in T-pose.
        shaped: The garment skinned to the other shape, in T-pose.
    """
    start, shape_edges = _flat_edges(canonical[rest.faces]), _flat_edges(shaped[rest.faces])
    # Stretch from the mean body to the other, in the tangent frame of the mean garment.
    metric = shape_edges.transpose(-1, -2) @ shape_edges
    inverse = torch.linalg.inv(start)
    stretch = _root(inverse.transpose(-1, -2) @ metric @ inverse)
    # The panel lies in that frame turned by the rotation of the map panel -> garment.
    turn = _rotation(start @ rest.inverse_rest)
    graded = turn.transpose(-1, -2) @ stretch @ turn @ torch.linalg.inv(rest.inverse_rest)
    return replace(rest, inverse_rest=torch.linalg.inv(graded), area=0.5 * torch.linalg.det(graded).abs())


def drape_energies(
    vertices: Float[Tensor, "T V 3"], rest: ClothRest, fabric: Fabric, body: Surface, contact: Contact,
    *, stiffness: float,
) -> dict[str, Float[Tensor, " T"]]:  # fmt: skip
    """The terms of Eq. 8 [J]: strain, bending, gravity, collision."""
    lacking = torch.relu(contact.margin - clearance(vertices, body))
    near = lacking.clamp_max(contact.depth)
    penalty = contact.cubic * near.pow(3) + 0.5 * stiffness * rest.mass * near.square()
    slope = 3 * contact.cubic * contact.depth**2 + stiffness * rest.mass * contact.depth
    return {
        "strain": membrane_energy(vertices, rest, fabric),
        "bending": bending_energy(vertices, rest, fabric),
        "gravity": gravity_energy(vertices, rest),
        "collision": (penalty + slope * (lacking - near)).sum(-1),
    }


def reference_energy(rest: ClothRest) -> Float[Tensor, ""]:
    """Energy of lifting the garment by 5 cm [J]: the scale on which its energies are compared."""
    return GRAVITY * _REFERENCE_LIFT * rest.mass.sum()


def face_strain(vertices: Float[Tensor, "T V 3"], rest: ClothRest) -> Float[Tensor, "T F"]:
    """Largest relative change of length in each face."""
    deformation = _flat_edges(vertices[:, rest.faces]) @ rest.inverse_rest
    metric = deformation.transpose(-1, -2) @ deformation
    middle, half = (
        0.5 * (metric[..., 0, 0] + metric[..., 1, 1]),
        0.5 * (metric[..., 0, 0] - metric[..., 1, 1]),
    )
    spread = (half.square() + metric[..., 0, 1].square()).sqrt()
    return torch.maximum((middle + spread).sqrt() - 1, 1 - (middle - spread).clamp_min(0).sqrt())


def _flat_edges(corner: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 2 2"]:
    """Two edges of each triangle (columns) in an orthonormal frame of its plane; the first lies along x."""
    first, second = corner[..., 1, :] - corner[..., 0, :], corner[..., 2, :] - corner[..., 0, :]
    length = first.norm(dim=-1).clamp_min(1e-9)
    along = (second * first).sum(-1) / length
    height = torch.linalg.cross(first, second).norm(dim=-1) / length
    rows = [torch.stack([length, along], -1), torch.stack([torch.zeros_like(length), height], -1)]
    return torch.stack(rows, -2)


def _root(matrix: Float[Tensor, "F 2 2"]) -> Float[Tensor, "F 2 2"]:
    """Square root of symmetric positive 2x2 matrices."""
    root = torch.linalg.det(matrix).clamp_min(0).sqrt()
    trace = matrix.diagonal(dim1=-2, dim2=-1).sum(-1)
    identity = torch.eye(2, dtype=matrix.dtype, device=matrix.device)
    return (matrix + root[:, None, None] * identity) / (trace + 2 * root).sqrt()[:, None, None]


def _rotation(matrix: Float[Tensor, "F 2 2"]) -> Float[Tensor, "F 2 2"]:
    """The orthogonal factor of the polar decomposition; a reflection where the determinant is negative."""
    sign = torch.linalg.det(matrix).sign()[:, None, None]
    cofactor = torch.stack(
        [
            torch.stack([matrix[:, 1, 1], -matrix[:, 1, 0]], -1),
            torch.stack([-matrix[:, 0, 1], matrix[:, 0, 0]], -1),
        ],
        -2,
    )
    total = matrix + sign * cofactor
    return total / torch.linalg.det(total).abs().sqrt()[:, None, None]
