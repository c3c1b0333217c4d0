"""Garments to train draping on: decoded, bound and measured once."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from isp_assets.body import Body
from isp_assets.bundle import GarmentBundle
from isp_assets.decode import RESOLUTIONS
from isp_assets.displacement import anchor_ramp, panel_sampler
from isp_assets.errors import DecodeError, GeometryError, TrainError
from isp_assets.garment import Garment
from isp_assets.geometry.energy import ClothRest, Fabric, cloth_rest
from isp_assets.geometry.grading import face_strain
from isp_assets.geometry.obstacle import body_parts
from isp_assets.geometry.panel_map import PanelSampler
from isp_assets.networks.skin_field import SkinField
from isp_assets.skinning import BoundGarment, bind

_JITTER = 0.15  # of a code, per standard deviation over the category's codes
_MAX_STRAIN = 0.5  # p99 at rest above which a decoded garment is not fit to learn from


@dataclass(frozen=True, eq=False)
class WornSample:
    """One garment, ready for training and measuring."""

    garment: Garment
    code: Float[Tensor, " Z"]
    bound: BoundGarment
    sampler: PanelSampler
    ramp: Float[Tensor, "V 1"]
    """Factor on displacements; 0 where the body holds the garment."""
    rest: ClothRest
    parts: Bool[Tensor, "V 6"]
    """Which of `BODY_PARTS` each vertex belongs to."""

    def to(self, device: torch.device | str) -> "WornSample":
        """A copy on another device."""
        return WornSample(
            self.garment,
            self.code.to(device),
            self.bound.to(device),
            self.sampler.to(device),
            self.ramp.to(device),
            self.rest.to(device),
            self.parts.to(device),
        )


@dataclass(frozen=True)
class WardrobeOptions:
    """How many garments, and how fine."""

    garments: int = 60
    """Training garments; every third has a jittered or mixed code. Named ones come first."""
    edge_length: float = 0.02
    """Triangle side [m]."""
    map_size: int = 64


def make_sample(
    garment: Garment, bundle: GarmentBundle, body: Body, skin: SkinField, *, map_size: int, fabric: Fabric
) -> WornSample:
    """Bind a garment and prepare its energy.

    Raises:
        GeometryError: If the garment's panels are degenerate.
    """
    rest = cloth_rest(garment.faces, garment.corner_xy, garment.num_vertices, fabric)
    bound = bind(garment, body, skin)
    return WornSample(
        garment=garment,
        code=torch.as_tensor(garment.code, dtype=torch.float32),
        bound=bound,
        sampler=panel_sampler(garment, bundle.model, resolution=map_size),
        ramp=torch.from_numpy(anchor_ramp(garment))[:, None],
        rest=rest.to(dtype=torch.float32),
        parts=torch.from_numpy(body_parts(bound.joint_weights.cpu().numpy())[0]),
    )


def require_same_body(body: Body, made_for: Mapping[str, str]) -> None:
    """Refuse bundles of another body.

    Args:
        body: The body to train on.
        made_for: By bundle, the digest of the body that it was made for.

    Raises:
        TrainError: If one of them is not the body's.
    """
    for what, digest in made_for.items():
        if digest != body.sha256:
            raise TrainError(
                f"the {what} was made for body {digest[:12]}, the body given is {body.sha256[:12]}; "
                "give the body that all were trained on"
            )


def build_wardrobe(
    bundle: GarmentBundle, body: Body, skin: SkinField, options: WardrobeOptions, *, seed: int = 0
) -> list[WornSample]:
    """Decode and bind garments of a bundle; codes that give no sound garment are passed over.

    Raises:
        TrainError: If fewer than half of the garments asked for can be made.
    """
    wardrobe: list[WornSample] = []
    lowest, highest = RESOLUTIONS
    resolution = round(np.clip(2 * bundle.model.panel_scale / options.edge_length, lowest, highest))
    for code in _codes(bundle, 3 * options.garments, np.random.default_rng(seed)):
        if len(wardrobe) == options.garments:
            break
        try:
            garment = bundle.decode(code, resolution=resolution)
            sample = make_sample(garment, bundle, body, skin, map_size=options.map_size, fabric=Fabric())
        except (DecodeError, GeometryError):
            continue
        if _rest_strain(sample) < _MAX_STRAIN:
            wardrobe.append(sample)
    if 2 * len(wardrobe) < options.garments:
        raise TrainError(
            f"only {len(wardrobe)} of {options.garments} garments of {bundle.category!r} "
            "could be decoded soundly; train its pattern networks and atlases longer"
        )
    return wardrobe


def _rest_strain(sample: WornSample) -> float:
    rest = torch.as_tensor(sample.garment.rest_vertices, dtype=torch.float32)[None]
    return float(face_strain(rest, sample.rest).quantile(0.99))


def _codes(bundle: GarmentBundle, count: int, rng: np.random.Generator) -> Iterator[Float[np.ndarray, " Z"]]:
    """Trained codes, after every two of them a jittered one or a mixture of two, in turn.

    Garments with a name of their own are the ones that will be worn, and often the extremes of their
    category: they come first, then those that `garment_maker` numbered, in random order.
    """
    codes = np.stack(list(bundle.codes.values()))
    spread = codes.std(axis=0)
    order = rng.permutation(len(codes))
    numbered = re.compile(rf"{re.escape(bundle.category)}_\d+")
    named = [numbered.fullmatch(name) is None for name in bundle.codes]
    trained = iter(codes[order[np.argsort(~np.asarray(named)[order], kind="stable")]])
    for number in range(count):
        first, second = codes[rng.integers(len(codes), size=2)]
        share, noise = rng.uniform(0, 1), rng.normal(size=spread.shape)
        jittered = (first + _JITTER * spread * noise).astype(np.float32)
        other = jittered if number % 2 else ((1 - share) * first + share * second).astype(np.float32)
        yield next(trained, other) if number % 3 < 2 else other
