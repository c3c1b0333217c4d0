"""Displacing a skinned garment with D_s: bind once, then one matrix product a frame.

Displacements live in the canonical frame of the garment's vertex and are turned
with it by the skinning transform. (The paper adds them in posed space; then a
raised arm needs other numbers than a hanging one for the same fold.)

Reference: Li, Guillard and Fua, "ISP: Multi-Layered Garment Draping with
Implicit Sewing Patterns", NeurIPS 2023, Section 3.2.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from isp_assets.conventions import PANELS
from isp_assets.errors import DrapeError
from isp_assets.garment import Garment
from isp_assets.garment_model import GarmentModel
from isp_assets.geometry.panel_map import PanelSampler
from isp_assets.geometry.topology import edges
from isp_assets.networks.drape_field import DrapeField

ANCHOR_RAMP = 0.03
"""Distance from an anchored vertex at which displacements reach their full size [m]."""


@dataclass(frozen=True, eq=False)
class BoundDisplacement:
    """The fixed maps of a displacement network, sampled at the vertices of one garment."""

    basis: Float[Tensor, "K V 3"]
    """[m]"""
    mean: Float[Tensor, "V 3"]
    """[m]"""

    def to(self, device: torch.device | str) -> "BoundDisplacement":
        """A copy on another device."""
        return BoundDisplacement(self.basis.to(device), self.mean.to(device))


def panel_sampler(garment: Garment, model: GarmentModel, *, resolution: int) -> PanelSampler:
    """The sampler of a garment's panels for maps in its category's network coordinates."""
    panels = [garment.panels[side] for side in PANELS]
    return PanelSampler.build(
        [model.to_network(panel.panel_xy) for panel in panels],
        [panel.faces for panel in panels],
        [panel.vertex_index for panel in panels],
        resolution=resolution,
    )


def anchor_ramp(garment: Garment, *, length: float = ANCHOR_RAMP) -> Float[np.ndarray, " V"]:
    """0 at anchored vertices, rising to 1 at ``length`` [m] along the cloth. All 1 without anchors."""
    if len(garment.anchors) == 0:
        return np.ones(garment.num_vertices, np.float32)
    start, end = edges(garment.faces).vertices.T
    size = np.linalg.norm(garment.rest_vertices[start] - garment.rest_vertices[end], axis=1)
    # A zero weight would mean "no edge".
    graph = coo_array((np.maximum(size, 1e-9), (start, end)), shape=(garment.num_vertices,) * 2).tocsr()
    distance = dijkstra(graph, directed=False, indices=garment.anchors, min_only=True, limit=length)
    t = np.clip(np.where(np.isfinite(distance), distance, length) / length, 0, 1)
    return (t * t * (3 - 2 * t)).astype(np.float32)


@torch.no_grad()
def bind_displacement(
    field: DrapeField, sampler: PanelSampler, ramp: Float[np.ndarray, " V"]
) -> BoundDisplacement:
    """Sample the network's fixed maps at a garment's vertices.

    Args:
        field: The category's displacement network.
        sampler: The garment's sampler at ``field.config.map_size``.
        ramp: Factor on each vertex's displacement; see `anchor_ramp`.

    Raises:
        DrapeError: If the sampler is of another resolution.
    """
    if sampler.resolution != field.config.map_size:
        raise DrapeError(
            f"the displacement network has maps of {field.config.map_size} texels, "
            f"the sampler of {sampler.resolution}"
        )
    basis, mean = field.maps()
    scale = torch.as_tensor(ramp).to(mean)[:, None]
    return BoundDisplacement(sampler.sample(basis) * scale, sampler.sample(mean) * scale)


def displacements(
    bound: BoundDisplacement, field: DrapeField, features: Float[Tensor, "T F"]
) -> Float[Tensor, "T V 3"]:
    """Displacements of T frames in the canonical frame [m]."""
    coefficients = field.coefficients(features)
    return (coefficients @ bound.basis.flatten(1)).unflatten(1, bound.mean.shape) + bound.mean


def displace(
    vertices: Float[Tensor, "T V 3"],
    rotations: Float[Tensor, "T V 3 3"],
    displacement: Float[Tensor, "T V 3"],
) -> Float[Tensor, "T V 3"]:
    """Add displacements to skinned vertices [m], turned by the skinning transforms."""
    return vertices + (rotations @ displacement[..., None]).squeeze(-1)
