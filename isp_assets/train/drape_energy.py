"""The physics that D_s is trained with: the energy of a garment at rest in a pose (Eq. 8).

Positions are in metres in the world frame, gravity along -Y; energies in joules.

The rest metric is that of the flat panels, graded to the body (`geometry.grading`).

Reference: Li, Guillard and Fua, "ISP: Multi-Layered Garment Draping with
Implicit Sewing Patterns", NeurIPS 2023, Eq. 8.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from isp_assets.conventions import GRAVITY
from isp_assets.geometry.energy import ClothRest, Fabric, bending_energy, gravity_energy, membrane_energy

_REFERENCE_LIFT = 0.05  # energies are compared with that of lifting the garment this far [m]


@dataclass(frozen=True)
class Contact:
    """Penalty for coming nearer to the body than ``margin``."""

    margin: float = 0.008
    """Clearance to keep at the vertices [m]; edges between them cut across curved skin."""
    cubic: float = 250.0
    """Weight of the cube of the lacking clearance [N/m²], as in the paper."""
    stiffness: float = 6e5
    """Weight of its square per mass [1/s²], at the end of training."""
    first_stiffness: float = 2e4
    """The same at the start."""
    depth: float = 0.025
    """Lacking clearance beyond which the penalty grows linearly [m]: where a posed body cuts into itself,
    no cloth can be clear of both sides."""

    def at(self, progress: float) -> float:
        """Stiffness after a share of the training, growing geometrically."""
        return self.first_stiffness * (self.stiffness / self.first_stiffness) ** min(1.25 * progress, 1.0)


def drape_energies(
    vertices: Float[Tensor, "T V 3"], height: Float[Tensor, "T V"], rest: ClothRest, fabric: Fabric,
    contact: Contact, *, stiffness: float,
) -> dict[str, Float[Tensor, " T"]]:  # fmt: skip
    """The terms of Eq. 8 [J]: strain, bending, gravity, collision.

    ``height`` is the clearance of the vertices over the body [m], plain or that of a `PartedBody`.
    """
    lacking = torch.relu(contact.margin - height)
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
