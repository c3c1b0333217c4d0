"""How well a garment is draped: energies, strain, penetration, and the distance to the true minimum."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from isp_assets.geometry.contact import Surface, clearance
from isp_assets.geometry.energy import ClothRest, Fabric
from isp_assets.geometry.grading import face_strain
from isp_assets.train.drape_energy import Contact, drape_energies

if TYPE_CHECKING:
    from isp_assets.train.displacement import DisplacementTask

_GAP_POSES = 2


@dataclass(frozen=True, eq=False)
class DrapeCase:
    """One garment on one body in T poses."""

    rest: ClothRest
    """Graded to the body."""
    fabric: Fabric
    body: Surface
    contact: Contact

    def energies(self, vertices: Float[Tensor, "T V 3"]) -> dict[str, Float[Tensor, " T"]]:
        """The terms of Eq. 8 [J] at the stiffness of the end of training."""
        height = clearance(vertices, self.body)
        return drape_energies(
            vertices, height, self.rest, self.fabric, self.contact, stiffness=self.contact.stiffness
        )

    def frame(self, index: int) -> "DrapeCase":
        """One pose alone, in double precision."""
        one = slice(index, index + 1)
        body = Surface(self.body.points[one].double(), self.body.normals[one].double())
        return DrapeCase(self.rest.to(dtype=torch.float64), self.fabric, body, self.contact)


def measure_drape(case: DrapeCase, vertices: Float[Tensor, "T V 3"], *, prefix: str) -> dict[str, float]:
    """Means over the poses: energies [mJ], 99th percentile of the strain, vertices inside the body [%]."""
    figures = {f"{name}_mj": 1e3 * float(value.mean()) for name, value in case.energies(vertices).items()}
    figures["strain_p99"] = float(face_strain(vertices, case.rest).quantile(0.99, dim=1).mean())
    figures["inside_percent"] = 100 * float((clearance(vertices, case.body) < 0).float().mean())
    return {prefix + name: value for name, value in figures.items()}


def energy_gap(task: "DisplacementTask", *, garments: int = 2, iterations: int = 300) -> dict[str, float]:
    """Share of the energy between skinning and the minimum that the network takes away.

    The minimum is found pose by pose with L-BFGS on the vertices that the body does
    not hold, once from the skinned and once from the network's positions; the lower counts.
    """
    maps, skin, network, best = task.module.maps(), [], [], []
    for poses, betas in task.test_batches():
        batch = task.pose(poses[:: max(1, len(poses) // _GAP_POSES)], betas)
        for sample in task.wardrobe[:garments]:
            case = task.case(sample, batch)
            with torch.no_grad():
                starts = task.drape(sample, batch, maps=maps)
            free = (sample.ramp[:, 0] > 0).cpu().numpy()
            for index in range(len(batch.posed.vertices)):
                frame = case.frame(index)
                found = [minimise(frame, s[index].double(), free, iterations=iterations) for s in starts]
                skin.append(found[0][0])
                network.append(found[1][0])
                best.append(min(f[1] for f in found))
    total_skin, total_network, total_best = (float(np.sum(x)) for x in (skin, network, best))
    gap = max(total_skin - total_best, 1e-12)
    return {
        "gap_closed_percent": 100 * (total_skin - total_network) / gap,
        "gap_skin_mj": 1e3 * (total_skin - total_best) / len(best),
        "gap_network_mj": 1e3 * (total_network - total_best) / len(best),
    }


def minimise(
    case: DrapeCase, start: Float[Tensor, "V 3"], free: np.ndarray, *, iterations: int
) -> tuple[float, float, Float[np.ndarray, "V 3"]]:
    """Lower the energy of one pose by moving the ``free`` vertices.

    Returns:
        Energy before and after [J], and the positions found [m].
    """
    from scipy.optimize import minimize

    device = start.device
    # Unknowns are displacements times the root of the mass, on which the energy is better conditioned.
    scale = (1 / case.rest.mass.clamp_min(1e-9).sqrt())[:, None] * torch.as_tensor(free, device=device)[
        :, None
    ]

    def energy(unknown: np.ndarray) -> tuple[float, np.ndarray]:
        x = torch.tensor(unknown, device=device).reshape(start.shape).requires_grad_(True)
        total = torch.cat(list(case.energies((start + scale * x)[None]).values())).sum()
        (gradient,) = torch.autograd.grad(total, x)
        return float(total.detach()), gradient.cpu().numpy().reshape(-1)

    zero = np.zeros(start.numel())
    with torch.enable_grad():
        before = energy(zero)[0]
        options = {"maxiter": iterations, "maxcor": 20, "maxfun": 2 * iterations}
        found = minimize(energy, zero, jac=True, method="L-BFGS-B", options=options)
    position = start + scale * torch.tensor(found.x, device=device).reshape(start.shape)
    return before, float(found.fun), position.cpu().numpy()
