"""Layering: correct one garment against everything beneath it with D_m, in a single pass.

Body and all finished inner garments push in one force map, so the cost grows with
the number of layers and not with their pairs. Maps are in the pelvis's frame, so
the correction turns with the body, even when it lies down.

Reference: Li, Guillard and Fua, "ISP: Multi-Layered Garment Draping with
Implicit Sewing Patterns", NeurIPS 2023, Section 3.2, Eqs. 11-12.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from isp_assets.body import PosedBody
from isp_assets.errors import DrapeError
from isp_assets.garment import Garment
from isp_assets.geometry.contact import Surface, force
from isp_assets.geometry.panel_map import PanelSampler
from isp_assets.networks.layering_net import LayeringNet

_TOUCH = 1e-5  # forces below this [m] count as none


@dataclass(frozen=True, eq=False)
class BoundLayering:
    """The layering network and what it needs of one garment of V vertices."""

    network: LayeringNet
    sampler: PanelSampler
    rest_map: Float[Tensor, "6 R R"]
    """Rest positions, in the network's units."""


def bind_layering(
    network: LayeringNet, garment: Garment, sampler: PanelSampler, *, device: torch.device | str = "cpu"
) -> BoundLayering:
    """Prepare a garment for layering.

    Args:
        network: D_m, on ``device``.
        garment: The garment.
        sampler: Its sampler at ``network.config.map_size``.
        device: Where frames will be.

    Raises:
        DrapeError: If the sampler is of another resolution.
    """
    if sampler.resolution != network.config.map_size:
        raise DrapeError(
            f"the layering network has maps of {network.config.map_size} texels, "
            f"the sampler of {sampler.resolution}"
        )
    rest = torch.as_tensor(garment.rest_vertices, dtype=torch.float32) / network.config.position_scale
    return BoundLayering(network, sampler.to(device), sampler.rasterise(rest).to(device))


def correct_layer(
    bound: BoundLayering,
    vertices: Float[Tensor, "T V 3"],
    beneath: Sequence[Surface],
    posed: PosedBody,
    *,
    ramp: Float[Tensor, " V"] | None = None,
) -> tuple[Float[Tensor, "T V 3"], Bool[np.ndarray, " T"]]:
    """Lift a draped garment over what lies beneath it; differentiable in the network's weights.

    Args:
        bound: The garment's network and maps.
        vertices: The garment after D_s [m].
        beneath: The body and all finished inner garments.
        posed: The body, for the pelvis's frame.
        ramp: Factor on each vertex's displacement; 0 holds it.

    Returns:
        Corrected vertices [m], and the frames in which anything touched. Other frames
        come back unchanged; with a gated network that is what it would have given.
    """
    config = bound.network.config
    push = force(vertices, beneath, margin=config.force_margin)
    touched = (push.square().sum(-1) > _TOUCH**2).any(-1)
    rows = touched.nonzero()[:, 0]
    if len(rows) == 0:
        return vertices, touched.cpu().numpy()
    world_from_pelvis = posed.joint_transforms[rows, 0, :3, :3]
    local = (vertices[rows] - posed.joints[rows, :1]) @ world_from_pelvis / config.position_scale
    local_push = push[rows] @ world_from_pelvis / config.force_scale
    rest = bound.rest_map.expand(len(rows), -1, -1, -1)
    maps = [rest, bound.sampler.rasterise(local), bound.sampler.rasterise(local_push)]
    moved = bound.sampler.sample(bound.network(torch.cat(maps, 1))) * config.displacement_scale
    if ramp is not None:
        moved = moved * ramp[:, None]
    lifted = vertices.index_add(0, rows, moved @ world_from_pelvis.transpose(-1, -2))
    return lifted, touched.cpu().numpy()
