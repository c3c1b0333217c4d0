"""The map of one flat panel to its place on the rest body.

Reference: Li, Guillard and Fua, "ISP: Multi-Layered Garment Draping with
Implicit Sewing Patterns", NeurIPS 2023, Eq. 3.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from isp_assets.networks.mlp import Mlp

_FLAT = ((0.0, 0.0), (0.0, 0.0), (0.0, 0.0))


@dataclass(frozen=True)
class AtlasConfig:
    """Size of an atlas and the affine map that it starts from; stored with its weights."""

    code_size: int = 32
    width: int = 128
    depth: int = 7
    skip: int | None = 3
    input_scale: float = 10.0
    """Factor on panel coordinates before the first layer."""
    output_scale: float = 0.1
    """Factor on the network's output [m]."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the panel's origin before the network moves it [m]."""
    slope: tuple[tuple[float, float], ...] = _FLAT
    """Change of that position along panel x and y, a 3x2 matrix [m per network unit]."""
    weight_norm: bool = False

    @classmethod
    def paper(cls) -> "AtlasConfig":
        """The size used by the paper: 0.35 million parameters a panel."""
        return cls(width=256, weight_norm=True)

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "AtlasConfig":
        """Read plain values, as JSON gives them back."""
        plain = dict(values)
        plain["offset"] = tuple(plain["offset"])
        plain["slope"] = tuple(tuple(row) for row in plain["slope"])
        return cls(**plain)


class Atlas(nn.Module):
    """Positions of one panel on the rest body: a fixed affine map plus a learnt displacement.

    The affine map is the best one for the whole category. It leaves the network
    only what differs between garments and what bends.
    """

    offset: Tensor
    slope: Tensor

    def __init__(self, config: AtlasConfig) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("offset", torch.tensor(config.offset), persistent=False)
        self.register_buffer("slope", torch.tensor(config.slope), persistent=False)
        self.mlp = Mlp(
            (2, config.code_size), 3, width=config.width, depth=config.depth,
            skip=config.skip, weight_norm=config.weight_norm,
        )  # fmt: skip

    def forward(
        self, xy: Float[Tensor, "*#batch 2"], code: Float[Tensor, "*#batch Z"]
    ) -> Float[Tensor, "*batch 3"]:
        """Positions on the rest body [m] of points of the panel [network units] (Eq. 3)."""
        moved = self.mlp(xy * self.config.input_scale, code)
        return self.offset + xy @ self.slope.T + self.config.output_scale * moved
