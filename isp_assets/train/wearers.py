"""Garments that can be draped without gradients: what layers are stacked from."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from isp_assets.body import Body, PosedBody
from isp_assets.bundle import GarmentBundle, SkinBundle
from isp_assets.displacement import (
    BoundDisplacement,
    bind_displacement,
    displace,
    displacements,
    panel_sampler,
)
from isp_assets.drape_features import drape_features
from isp_assets.geometry.energy import ClothRest
from isp_assets.geometry.obstacle import CollisionMesh
from isp_assets.layering import BoundLayering, bind_layering
from isp_assets.networks.drape_field import DrapeField
from isp_assets.networks.layering_net import LayeringNet
from isp_assets.networks.placement import on_device
from isp_assets.skinning import BoundGarment, skin_garment
from isp_assets.train.wardrobe import WardrobeOptions, build_wardrobe


@dataclass(frozen=True, eq=False)
class Wearer:
    """One garment with its fixed displacement maps and its layering network."""

    name: str
    bound: BoundGarment
    rest: ClothRest
    code: Float[Tensor, " Z"]
    ramp: Float[Tensor, " V"]
    parts: Bool[Tensor, "V 6"]
    """Which of `BODY_PARTS` each vertex belongs to."""
    field: DrapeField | None
    displacement: BoundDisplacement | None
    layering: BoundLayering
    collision: CollisionMesh

    def drape(
        self, posed: PosedBody, betas: Float[Tensor, " B"]
    ) -> tuple[Float[Tensor, "T V 3"], Float[Tensor, "T V 3"]]:
        """Positions after skinning, and after D_s [m]."""
        skinned, linear = skin_garment(self.bound, posed, betas)
        if self.field is None or self.displacement is None:
            return skinned, skinned
        features = drape_features(posed, betas, self.code, num_betas=self.field.config.num_betas)
        return skinned, displace(skinned, linear, displacements(self.displacement, self.field, features))


@torch.no_grad()
def build_wearers(
    bundle: GarmentBundle,
    body: Body,
    skin: SkinBundle,
    options: WardrobeOptions,
    network: LayeringNet,
    *,
    device: torch.device,
    seed: int = 0,
) -> list[Wearer]:
    """Decode and bind garments of a bundle, whether or not it has a displacement network.

    Raises:
        TrainError: If too few garments can be made.
    """
    wearers, skin_field = [], on_device(skin.skin_field, device)
    for sample in build_wardrobe(bundle, body.to(device), skin_field, options, seed=seed):
        field, displacement = bundle.drape_field, None
        if field is not None:
            field = on_device(field, device).eval()
            sampler = panel_sampler(sample.garment, bundle.model, resolution=field.config.map_size)
            displacement = bind_displacement(field, sampler.to(device), sample.ramp[:, 0].cpu().numpy())
        wearers.append(
            Wearer(
                name=f"{bundle.category}/{sample.garment.name}",
                bound=sample.bound.to(device),
                rest=sample.rest.to(device),
                code=sample.code.to(device),
                ramp=sample.ramp[:, 0].to(device),
                parts=sample.parts.to(device),
                field=field,
                displacement=displacement,
                layering=bind_layering(network, sample.garment, sample.sampler, device=device),
                collision=CollisionMesh.build(sample.garment.faces, sample.bound.joint_weights.cpu().numpy()),
            )
        )
    return wearers
