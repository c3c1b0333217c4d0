"""The displacement network D_s: one map of displacements a frame, from shape, pose and garment code.

A small network gives K coefficients; they combine K fixed maps and a mean map. Since
sampling a map at the garment's vertices is linear too, the fixed maps can be
sampled once a garment, and a frame then costs one product of a K-vector with a
matrix: the same result as making the map and sampling it.

Reference: Li, Guillard and Fua, "ISP: Multi-Layered Garment Draping with
Implicit Sewing Patterns", NeurIPS 2023, Section 3.2.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from isp_assets.networks.mlp import Mlp

POSE_FEATURES = 3 + 21 * 6
"""Gravity's direction, and six numbers for each of 21 joints."""


@dataclass(frozen=True)
class DrapeFieldConfig:
    """Size of a displacement network; stored with its weights."""

    code_size: int = 32
    num_betas: int = 10
    width: int = 512
    depth: int = 4
    """Layers from the features to the coefficients."""
    skip: int | None = None
    activation: str = "silu"
    basis: int = 64
    """Number K of fixed maps."""
    map_size: int = 64
    """Texels R along a side of a map."""
    coarse_size: int = 16
    """Texels of a coarse map that is enlarged and added to each, which spreads what is learnt; 0 for none."""
    displacement_scale: float = 0.05
    """Factor on the maps [m]."""
    code_scale: float = 1.0
    """Factor on codes, which brings them to unit size."""

    @classmethod
    def paper(cls) -> "DrapeFieldConfig":
        """The size used by the paper: 8 layers of 512, then 200² texels (125 million weights)."""
        return cls(depth=8, skip=4, activation="relu", basis=512, map_size=200, coarse_size=0)

    @property
    def num_features(self) -> int:
        """Length of the input: pose, betas, code."""
        return POSE_FEATURES + self.num_betas + self.code_size

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "DrapeFieldConfig":
        return cls(**values)


class DrapeField(nn.Module):
    """Displacement maps of one category of garments; untrained it gives zero everywhere."""

    def __init__(self, config: DrapeFieldConfig) -> None:
        super().__init__()
        self.config = config
        size = config.map_size
        parts = (POSE_FEATURES, config.num_betas, config.code_size)
        self.mlp = Mlp(
            parts, config.basis, width=config.width, depth=config.depth, skip=config.skip,
            activation=config.activation,
        )  # fmt: skip
        # The last map is the mean. Texels that no garment covers keep the smooth maps they start with.
        coarse = (
            torch.randn(config.basis + 1, 6, *(config.coarse_size or size // 4,) * 2) * config.basis**-0.5
        )
        coarse[-1] = 0
        if config.coarse_size:
            self.coarse = nn.Parameter(coarse)
            self.fine = nn.Parameter(torch.zeros(config.basis + 1, 6, size, size))
        else:
            self.fine = nn.Parameter(_enlarged(coarse, size))
        for parameter in self.mlp.layers[-1].parameters():
            nn.init.zeros_(parameter)

    def coefficients(self, features: Float[Tensor, "T F"]) -> Float[Tensor, "T K"]:
        """Coefficients of the fixed maps.

        Args:
            features: Pose (129), betas, and the garment's code, side by side.
        """
        config = self.config
        pose, betas, code = features.split([POSE_FEATURES, config.num_betas, config.code_size], -1)
        return self.mlp(pose, 0.5 * betas, config.code_scale * code)

    def maps(self) -> tuple[Float[Tensor, "K 6 R R"], Float[Tensor, "6 R R"]]:
        """The fixed maps and the mean map [m]; channels 0-2 are the front panel, 3-5 the back."""
        texels: Tensor = self.fine
        if self.config.coarse_size:
            texels = texels + _enlarged(self.coarse, self.config.map_size)
        texels = self.config.displacement_scale * texels
        return texels[:-1], texels[-1]

    def forward(self, features: Float[Tensor, "T F"]) -> Float[Tensor, "T 6 R R"]:
        """Displacement maps of T frames [m]; arguments as in `coefficients`."""
        basis, mean = self.maps()
        return (self.coefficients(features) @ basis.flatten(1)).unflatten(1, mean.shape) + mean


def _enlarged(maps: Float[Tensor, "K 6 r r"], size: int) -> Float[Tensor, "K 6 R R"]:
    return nn.functional.interpolate(maps, size=(size, size), mode="bilinear", align_corners=False)
