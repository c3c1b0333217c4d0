"""Coarse point clouds of all garments of a bundle, and the search for those most like a surface.

A cloud costs no decoding: the panels' points are those of one fixed grid that lie
inside, lifted by the atlas.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from isp_assets.conventions import PANELS
from isp_assets.garment_model import GarmentModel

_GRID = 28
"""Points across a panel's square."""


@dataclass(frozen=True, eq=False)
class GarmentClouds:
    """A point cloud on the rest body [m] for every code."""

    points: tuple[Float[np.ndarray, "_ 3"], ...]

    @classmethod
    def build(cls, model: GarmentModel, codes: Float[np.ndarray, "G Z"]) -> "GarmentClouds":
        """Lift the inner grid points of both panels of every code."""
        axis = torch.linspace(-1, 1, _GRID)
        xy = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), dim=-1).reshape(-1, 2)
        clouds = []
        with torch.no_grad():
            for code in torch.from_numpy(np.asarray(codes, np.float32)):
                sides = []
                for side in PANELS:
                    inner = xy[model.panel_fields[side].signed_distance(xy, code) < 0]
                    sides.append(model.atlases[side](inner, code))
                clouds.append(torch.cat(sides).double().numpy())
        return cls(tuple(clouds))

    def distances(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " G"]:
        """Mean distance between each cloud and some points, both ways [m]; infinite for an empty cloud."""
        tree = cKDTree(points)
        result = np.full(len(self.points), np.inf)
        for index, cloud in enumerate(self.points):
            if len(cloud):
                back, _ = cKDTree(cloud, balanced_tree=False).query(points)
                result[index] = 0.5 * (tree.query(cloud)[0].mean() + back.mean())
        return result

    def nearest(self, points: Float[np.ndarray, "n 3"], count: int) -> Int[np.ndarray, " k"]:
        """Indices of the clouds most like some points, best first."""
        distance = self.distances(points)
        order = np.argsort(distance, kind="stable")
        return order[np.isfinite(distance[order])][:count]
