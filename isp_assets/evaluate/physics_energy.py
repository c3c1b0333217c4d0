"""The reference ``energy``: per pose, the minimum of the energy that D_s is trained with (Eq. 8)."""

import time

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from isp_assets.geometry.contact import Surface
from isp_assets.geometry.energy import cloth_rest
from isp_assets.physics import Cloth, PhysicsResult, PhysicsScene
from isp_assets.train.drape_energy import Contact
from isp_assets.train.drape_metrics import DrapeCase, minimise


class EnergyReference:
    """Minimises the energy with L-BFGS, pose by pose, from the scene's own start.

    Garments are taken from the inside out, each against the body and the minima beneath it. There is
    no friction, and a minimum is a local one: of several folds that hold, that nearest to the start.
    """

    name = "energy"
    version = "L-BFGS"

    def __init__(self, *, iterations: int = 300) -> None:
        self.iterations = iterations

    def drape(self, scene: PhysicsScene) -> PhysicsResult:
        """One state, ``minimum``."""
        found: list[list[np.ndarray]] = [[] for _ in scene.cloths]
        faces = torch.as_tensor(scene.body_faces, dtype=torch.int64)
        began = time.perf_counter()
        for t in range(len(scene.body)):
            beneath = [Surface.of_mesh(torch.as_tensor(scene.body[t][None], dtype=torch.float64), faces)]
            for cloth, rows in zip(scene.cloths, found, strict=True):
                rows.append(self._minimum(scene, cloth, t, _together(beneath)))
                position = torch.from_numpy(rows[-1][None])
                beneath.append(Surface.of_mesh(position, torch.as_tensor(cloth.faces, dtype=torch.int64)))
        seconds = (time.perf_counter() - began) / len(scene.body)
        return PhysicsResult(
            states={"minimum": tuple(np.stack(rows) for rows in found)},
            seconds={"minimum": seconds},
            details={"version": self.version, "iterations": self.iterations},
        )

    def _minimum(
        self, scene: PhysicsScene, cloth: Cloth, t: int, beneath: Surface
    ) -> Float[np.ndarray, "V 3"]:
        start = torch.as_tensor(cloth.start[t], dtype=torch.float64)
        rest = cloth_rest(cloth.faces, cloth.flat_corners, len(start), scene.fabric)
        case = DrapeCase(rest.to(dtype=torch.float64), scene.fabric, beneath, Contact())
        free = np.ones(len(start), bool)
        free[cloth.held] = False
        return minimise(case, start, free, iterations=self.iterations)[2]


def _together(surfaces: list[Surface]) -> Surface:
    """Samples of all surfaces as one: the nearest counts, which over an inner garment is that garment's."""
    points: list[Tensor] = [surface.points for surface in surfaces]
    return Surface(torch.cat(points, -2), torch.cat([surface.normals for surface in surfaces], -2))
