"""What the atlases are trained on: triangles and seam vertices, with their places on the body."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from isp_assets.conventions import PANELS
from isp_assets.geometry.topology import edges
from isp_assets.train.dataset import GarmentDataset, TrainingGarment


def network_xy(dataset: GarmentDataset, garment: TrainingGarment, side: str) -> Float[np.ndarray, "P 2"]:
    """Points of a panel in network coordinates."""
    return (garment.panels[side].xy - dataset.panel_center) / dataset.panel_scale


def places(garment: TrainingGarment, side: str) -> Float[np.ndarray, "P 3"]:
    """Where each point of a panel lies on the rest body [m]."""
    return garment.rest_vertices[garment.panels[side].vertex_index]


def seam_indices(garment: TrainingGarment) -> dict[str, Int[np.ndarray, " n"]]:
    """By panel, the points that share a vertex with the other panel, in matching order."""
    front, back = (garment.panels[side].vertex_index for side in PANELS)
    _, *points = np.intersect1d(front, back, return_indices=True)
    return dict(zip(PANELS, points, strict=True))


_SMALLEST = 0.2  # of a triangle of the mesh
_OUTER = 0.4  # share of triangles that touch the panel's border, where two panels must meet without a crease


class AtlasSamples:
    """All triangles and seam vertices of a dataset, drawn from at random.

    Args:
        dataset: The garments.
        device: Where the tensors live.
    """

    def __init__(self, dataset: GarmentDataset, device: torch.device) -> None:
        self._triangles: dict[str, _Ragged] = {}
        self._outer_triangles: dict[str, _Ragged] = {}
        seams: list[list[np.ndarray]] = [[] for _ in dataset.garments]
        for side in PANELS:
            rows, outer = [], []
            for garment, seam in zip(dataset.garments, seams, strict=True):
                points = np.concatenate([network_xy(dataset, garment, side), places(garment, side)], axis=1)
                faces = garment.panels[side].faces
                rows.append(points[faces].reshape(len(faces), 15))
                outer.append(rows[-1][np.isin(faces, _border_points(faces)).any(axis=1)])
                seam.append(points[seam_indices(garment)[side]])
            self._triangles[side] = _Ragged(rows, device)
            self._outer_triangles[side] = _Ragged(outer, device)
        self._seams = _Ragged([np.concatenate(seam, axis=1) for seam in seams], device)

    def triangles(
        self, side: str, garment: Int[Tensor, " G"], count: int, generator: torch.Generator
    ) -> Float[Tensor, "G count 3 5"]:
        """Corners of random triangles: network coordinates, then place on the body [m].

        Each is a smaller copy of a triangle of the mesh somewhere inside it. Corners of the mesh
        alone would leave the network free to ripple between them.
        """
        outer = int(_OUTER * count)
        drawn = [
            self._triangles[side].draw(garment, count - outer, generator),
            self._outer_triangles[side].draw(garment, outer, generator),
        ]
        whole = torch.cat(drawn, dim=1).unflatten(-1, (3, 5))
        shape = whole.shape[:2]
        # Normalised exponential numbers are uniform in the triangle.
        weights = -torch.rand(*shape, 3, 1, generator=generator).clamp_min(1e-6).log()
        size = _SMALLEST + (1 - _SMALLEST) * torch.rand(*shape, 1, 1, generator=generator)
        middle = (weights / weights.sum(dim=2, keepdim=True)).to(whole) * whole
        return torch.lerp(middle.sum(dim=2, keepdim=True), whole, size.to(whole))

    def seams(
        self, garment: Int[Tensor, " G"], count: int, generator: torch.Generator
    ) -> dict[str, Float[Tensor, "G count 5"]]:
        """The same random seam vertices seen from each panel: network coordinates, then place [m]."""
        front, back = self._seams.draw(garment, count, generator).split(5, dim=-1)
        return dict(zip(PANELS, (front, back), strict=True))


def _border_points(faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, " n"]:
    mesh = edges(faces)
    return np.unique(mesh.vertices[mesh.num_faces == 1])


class _Ragged:
    """Rows of several garments in one tensor; garments may have different numbers of rows."""

    def __init__(self, rows: list[Float[np.ndarray, "_ D"]], device: torch.device) -> None:
        self._rows = torch.from_numpy(np.concatenate(rows).astype(np.float32)).to(device)
        self._counts = torch.tensor([len(r) for r in rows])
        self._starts = self._counts.cumsum(0) - self._counts

    def draw(
        self, garment: Int[Tensor, " G"], count: int, generator: torch.Generator
    ) -> Float[Tensor, "G count D"]:
        share = torch.rand(len(garment), count, generator=generator, dtype=torch.float64)
        row = self._starts[garment, None] + (share * self._counts[garment, None]).long()
        return self._rows[row.to(self._rows.device)]
