"""Putting an outfit on: everything about a shot's garments that no frame changes, built once.

Decoding, binding and projecting the networks' fixed maps onto the vertices cost
about a second a garment; after that a frame is a few matrix products.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from isp_assets.bake import bake_texture
from isp_assets.body import Body
from isp_assets.decode import decode_garment
from isp_assets.displacement import BoundDisplacement, anchor_ramp, bind_displacement, panel_sampler
from isp_assets.frames import Layer
from isp_assets.garment import Garment
from isp_assets.geometry.elastic_cloth import ElasticCloth
from isp_assets.geometry.energy import Fabric, cloth_rest
from isp_assets.geometry.grading import graded_rest
from isp_assets.geometry.obstacle import CollisionMesh
from isp_assets.geometry.stretch import StretchLimit
from isp_assets.layering import BoundLayering, bind_layering
from isp_assets.networks.drape_field import DrapeField
from isp_assets.networks.placement import on_device
from isp_assets.outfit import Outfit, OutfitItem
from isp_assets.skinning import BoundGarment, bind, shape_garment


@dataclass(frozen=True, eq=False)
class WornGarment:
    """One garment of V vertices, bound to the body."""

    layer: Layer
    code: Float[Tensor, " Z"]
    faces: Int[Tensor, "F 3"]
    skin: BoundGarment
    field: DrapeField | None
    displacement: BoundDisplacement | None
    layering: BoundLayering | None
    ramp: Float[Tensor, " V"]
    """0 at vertices that the body itself holds, 1 away from them."""
    collision: CollisionMesh
    stretch: StretchLimit
    elastic: ElasticCloth
    tucked: Bool[np.ndarray, " V"]
    """Cloth that is hidden beneath another layer, which has no room for it; see `tucking`."""


def dress(
    outfit: Outfit, body: Body, betas: Float[Tensor, " B"], *, resolution: int, device: str = "cpu"
) -> tuple[WornGarment, ...]:
    """Decode and bind every garment of an outfit, innermost first.

    Args:
        outfit: The garments and their networks.
        body: The body that the outfit was trained on, on ``device``.
        betas: The wearer's shape, on ``device``; patterns are graded to it.
        resolution: Grid cells across a panel; see `decode_garment`.
        device: Where the networks run.

    Raises:
        DecodeError: If a code gives no valid garment.
        DrapeError: If the skin field does not fit the body.
    """
    return tuple(
        _wear(outfit, index, body, betas, resolution=resolution, device=device)
        for index in range(len(outfit))
    )


@torch.no_grad()
def _wear(
    outfit: Outfit, index: int, body: Body, betas: Tensor, *, resolution: int, device: str
) -> WornGarment:
    item = outfit.items[index]
    garment = decode_garment(item.bundle.model, item.code, resolution=resolution, name=item.name)
    skin = bind(garment, body, on_device(outfit.skin.skin_field, device))
    fabric = Fabric()
    flat = cloth_rest(garment.faces, garment.corner_xy, garment.num_vertices, fabric)
    graded = graded_rest(flat.to(device, torch.float32), skin.canonical, shape_garment(skin, betas))
    ramp = anchor_ramp(garment)
    elastic = ElasticCloth(graded, fabric, free=ramp > 0)
    field, displacement = item.bundle.drape_field, None
    if field is not None:
        field = on_device(field, device).eval()
        sampler = panel_sampler(garment, item.bundle.model, resolution=field.config.map_size)
        displacement = bind_displacement(field, sampler.to(device), ramp)
    return WornGarment(
        layer=_layer(outfit.layer_name(index), garment, item, elastic.flat_lengths),
        code=torch.as_tensor(item.code, device=device),
        faces=torch.as_tensor(garment.faces, device=device),
        skin=skin,
        field=field,
        displacement=displacement,
        layering=_layering(outfit, garment, item, device),
        ramp=torch.as_tensor(ramp, device=device),
        collision=CollisionMesh.build(garment.faces, skin.joint_weights.cpu().numpy()),
        stretch=StretchLimit.build(graded, held=ramp == 0),
        elastic=elastic,
        tucked=np.zeros(garment.num_vertices, bool),
    )


def _layering(outfit: Outfit, garment: Garment, item: OutfitItem, device: str) -> BoundLayering | None:
    if outfit.layering is None:
        return None
    network = on_device(outfit.layering.layering_net, device).eval()
    sampler = panel_sampler(garment, item.bundle.model, resolution=network.config.map_size)
    return bind_layering(network, garment, sampler, device=device)


def _layer(name: str, garment: Garment, item: OutfitItem, lengths: Float[np.ndarray, "F 3"]) -> Layer:
    texture = np.ascontiguousarray(bake_texture(garment, item.style))
    return Layer(name, garment, texture, item.style.color, lengths)
