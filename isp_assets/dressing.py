"""Putting an outfit on: everything about a shot's garments that no frame changes, built once.

Decoding, binding and projecting the networks' fixed maps onto the vertices cost
about a second a garment; after that a frame is a few matrix products.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from isp_assets.bake import bake_texture
from isp_assets.body import Body, PosedBody
from isp_assets.conventions import NUM_JOINTS
from isp_assets.decode import decode_garment
from isp_assets.displacement import BoundDisplacement, anchor_ramp, bind_displacement, panel_sampler
from isp_assets.frames import Layer
from isp_assets.garment import Garment
from isp_assets.geometry.energy import Fabric, cloth_rest
from isp_assets.geometry.grading import edge_lengths, graded_rest
from isp_assets.geometry.obstacle import CollisionMesh
from isp_assets.geometry.relaxation import ElasticCloth
from isp_assets.geometry.stretch import StretchLimit
from isp_assets.layering import BoundLayering, bind_layering
from isp_assets.networks.drape_field import DrapeField
from isp_assets.networks.placement import on_device
from isp_assets.outfit import Outfit, OutfitItem
from isp_assets.skinning import BoundGarment, bind, shape_garment, skin_garment
from isp_assets.trimming import Piece, trim_tucked


@dataclass(frozen=True, eq=False)
class WornGarment:
    """One garment of V vertices, bound to the body."""

    layer: Layer
    code: Float[Tensor, " Z"]
    rest: Float[np.ndarray, "V 3"]
    """Skinned to the wearer in T-pose [m]."""
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


def dress(
    outfit: Outfit,
    body: Body,
    betas: Float[Tensor, " B"],
    *,
    resolution: int,
    device: str = "cpu",
    tuck_depth: float | None = None,
) -> tuple[WornGarment, ...]:
    """Decode and bind every garment of an outfit, innermost first.

    Args:
        outfit: The garments and their networks.
        body: The body that the outfit was trained on, on ``device``.
        betas: The wearer's shape, on ``device``; patterns are graded to it.
        resolution: Grid cells across a panel; see `decode_garment`.
        device: Where the networks run.
        tuck_depth: How far tucked cloth is kept [m], see `trim_tucked`; None keeps all.

    Raises:
        DecodeError: If a code gives no valid garment.
        DrapeError: If the skin field does not fit the body.
    """
    standing = body.pose(torch.zeros(1, NUM_JOINTS, 3, device=betas.device), betas=betas)
    pieces = tuple(
        _bound(item, outfit, body, standing, betas, resolution=resolution, device=device) for item in outfit
    )
    if tuck_depth is not None:
        pieces = trim_tucked(pieces, depth=tuck_depth)
    return tuple(_wear(outfit, index, piece, betas, device=device) for index, piece in enumerate(pieces))


@torch.no_grad()
def _bound(
    item: OutfitItem, outfit: Outfit, body: Body, standing: PosedBody, betas: Tensor, *,
    resolution: int, device: str,
) -> Piece:  # fmt: skip
    garment = decode_garment(item.bundle.model, item.code, resolution=resolution, name=item.name)
    skin = bind(garment, body, on_device(outfit.skin.skin_field, device))
    rest = skin_garment(skin, standing, betas)[0][0]
    return Piece(garment, skin, rest.cpu().numpy().astype(np.float64))


@torch.no_grad()
def _wear(outfit: Outfit, index: int, piece: Piece, betas: Tensor, *, device: str) -> WornGarment:
    item, garment, skin = outfit.items[index], piece.garment, piece.skin
    fabric = Fabric()
    flat = cloth_rest(garment.faces, garment.corner_xy, garment.num_vertices, fabric)
    graded = graded_rest(flat.to(device, torch.float32), skin.canonical, shape_garment(skin, betas))
    ramp = anchor_ramp(garment)
    field, displacement = item.bundle.drape_field, None
    if field is not None:
        field = on_device(field, device).eval()
        sampler = panel_sampler(garment, item.bundle.model, resolution=field.config.map_size)
        displacement = bind_displacement(field, sampler.to(device), ramp)
    return WornGarment(
        layer=_layer(outfit.layer_name(index), piece, item, edge_lengths(graded)),
        code=torch.as_tensor(item.code, device=device),
        rest=piece.rest,
        faces=torch.as_tensor(garment.faces, device=device),
        skin=skin,
        field=field,
        displacement=displacement,
        layering=_layering(outfit, garment, item, device),
        ramp=torch.as_tensor(ramp, device=device),
        collision=piece.collision,
        stretch=StretchLimit.build(graded, held=ramp == 0),
        elastic=ElasticCloth.build(graded, fabric, held=ramp == 0),
    )


def _layering(outfit: Outfit, garment: Garment, item: OutfitItem, device: str) -> BoundLayering | None:
    if outfit.layering is None:
        return None
    network = on_device(outfit.layering.layering_net, device).eval()
    sampler = panel_sampler(garment, item.bundle.model, resolution=network.config.map_size)
    return bind_layering(network, garment, sampler, device=device)


def _layer(name: str, piece: Piece, item: OutfitItem, lengths: Float[np.ndarray, "F 3"]) -> Layer:
    texture = np.ascontiguousarray(bake_texture(piece.garment, item.style))
    return Layer(name, piece.garment, texture, item.style.color, piece.trimmed, lengths)
