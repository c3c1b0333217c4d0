"""The baseline's network: distance to a garment's surface, for all garments of a category.

Written from the papers: Guillard, Stella and Fua, "MeshUDF", ECCV 2022; De Luigi et al.,
"DrapeNet: Garment Generation and Self-Supervised Draping", CVPR 2023.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from isp_assets.networks.mlp import Mlp


@dataclass(frozen=True)
class UdfConfig:
    """Size of the network, and where its unit cube lies."""

    center: tuple[float, float, float]
    """Middle of the box around all garments [m]."""
    scale: float
    """Half the side of the cube [m]: network positions are ``(x - center) / scale``."""
    code_size: int = 32
    width: int = 128
    depth: int = 7
    skip: int = 3
    input_scale: float = 10.0
    clip: float = 0.1
    """Distances are learned up to here [network units]; MeshUDF and DrapeNet clip as well."""
    output: str = "hypot"
    """How distances are made: "hypot", or "sigmoid" as in DrapeNet."""
    num_places: int = 4000
    """How many points on garments are kept, to tell where garments may be."""

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "UdfConfig":
        return cls(**{**values, "center": tuple(values["center"])})


class UdfField(nn.Module):
    """Distance to the surface at positions of [-1, 1]^3, in the same units.

    The papers put one output through a sigmoid, which leaves the bottom round. Here two outputs,
    across the surface and beyond its border, give the distance as ``hypot(across, beyond)``:
    sharp at the surface, as ``across`` passes through zero there. ``beyond`` is supervised:
    otherwise ``across``, whose sign has to change back somewhere, caps all openings.
    """

    floor: Tensor
    """What the field says on the surface itself, where it should say 0 [network units]."""
    places: Tensor
    """Points on the garments it was trained on [network units]."""

    def __init__(self, config: UdfConfig) -> None:
        super().__init__()
        self.config = config
        entry = (3, config.code_size)
        self.net = Mlp(entry, 2, width=config.width, depth=config.depth, skip=config.skip)
        self.register_buffer("floor", torch.zeros(()))
        self.register_buffer("places", torch.zeros(config.num_places, 3))

    def forward(self, points: Tensor, codes: Tensor) -> Tensor:
        """Distances [...] at points [..., 3] for codes [..., code_size]; leading axes broadcast."""
        return self.parts(points, codes)[0]

    def parts(self, points: Tensor, codes: Tensor) -> tuple[Tensor, Tensor]:
        """Distances [...], and the part of them that leads beyond the border [...]."""
        across, beyond = self.net(self.config.input_scale * points, codes).unbind(-1)
        if self.config.output == "sigmoid":
            return self.config.clip * torch.sigmoid(across), beyond
        return (across.square() + beyond.square() + 1e-12).sqrt(), beyond

    def to_network(self, metres: np.ndarray) -> np.ndarray:
        """Positions [N, 3] in metres, in network units."""
        return (metres - np.array(self.config.center)) / self.config.scale

    def to_metres(self, points: np.ndarray) -> np.ndarray:
        """Positions [N, 3] in network units, in metres."""
        return points * self.config.scale + np.array(self.config.center)


def distance_errors(found: Tensor, true: Tensor, clip: float) -> Tensor:
    """Errors [...] of distances; those above ``clip`` need only be above it."""
    return torch.where(true < clip, (found - true).abs(), (clip - found).relu())
