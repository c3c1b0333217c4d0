"""The layering network D_m: corrects one garment so that it lies over everything beneath it.

A U-Net over the panel maps of a garment: where its cloth is at rest, where it hangs
now, and the forces that push it out of the surfaces beneath. It returns a map of
displacements. Front and back panels both enter, and one network serves every category.

Reference: Li, Guillard and Fua, "ISP: Multi-Layered Garment Draping with
Implicit Sewing Patterns", NeurIPS 2023, Section 3.2, Eqs. 11-12.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d

from isp_assets.errors import BundleError

INPUT_CHANNELS = 18
"""Rest map, draped map, force map: xyz of the front and of the back panel each."""
_GATE_FULL = 0.1  # force (in network units) around which the correction acts in full


@dataclass(frozen=True)
class LayeringConfig:
    """Size of a layering network and the units of its maps; stored with its weights."""

    features: int = 16
    """Channels of the finest level; they double from level to level."""
    map_size: int = 96
    """Texels R along a side of a map."""
    levels: int = 4
    """How often the map is halved."""
    norm: str = "none"
    """``"none"`` or ``"instance"``. Without it a contact at the back leaves the front alone."""
    texel_weights: bool = False
    """A separate last layer for every texel."""
    gate: int = 4
    """Texels around a contact where the network acts, 0 for everywhere. With a gate a garment that
    touches nothing is left exactly as it is."""
    position_scale: float = 0.5
    """Length of one unit of the rest and draped maps [m]."""
    force_scale: float = 0.02
    """Length of one unit of the force map [m]."""
    displacement_scale: float = 0.02
    """Length of one unit of the output [m]."""
    force_margin: float = 0.004
    """Clearance from which forces act [m]; 0 is the paper's Eq. 12."""

    def __post_init__(self) -> None:
        if self.norm not in ("none", "instance"):
            raise BundleError(f'layering network: norm must be "none" or "instance", got {self.norm!r}')
        if min(self.features, self.levels) < 1 or self.map_size < 2**self.levels:
            raise BundleError(
                f"layering network: expected features and levels of at least 1 and a map_size of at least "
                f"2**levels; got {self.features}, {self.levels} and {self.map_size}"
            )

    @classmethod
    def paper(cls) -> "LayeringConfig":
        """The size the paper used: 100 features on 200² texels (about a hundred million weights)."""
        return cls(
            features=100, map_size=200, levels=4, norm="instance", texel_weights=True, gate=0,
            displacement_scale=0.01, force_margin=0.0,
        )  # fmt: skip

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "LayeringConfig":
        return cls(**values)


class LayeringNet(nn.Module):
    """Displacement maps from rest, draped and force maps; untrained it gives zero everywhere."""

    def __init__(self, config: LayeringConfig) -> None:
        super().__init__()
        self.config = config
        width = [config.features * 2**level for level in range(config.levels + 1)]
        self.down = nn.ModuleList(
            _Block(a, b, config.norm) for a, b in zip([INPUT_CHANNELS, *width], width, strict=False)
        )
        self.up = nn.ModuleList(
            _Block(a + b, a, config.norm) for a, b in zip(width[-2::-1], width[:0:-1], strict=True)
        )
        if config.texel_weights:
            self.texel = nn.Parameter(torch.zeros(6, config.features + 1, config.map_size, config.map_size))
        else:
            self.head = nn.Conv2d(config.features, 6, 1)
            nn.init.zeros_(self.head.weight)
            nn.init.zeros_(self.head.bias)  # type: ignore[arg-type]

    def forward(self, maps: Float[Tensor, "B 18 R R"]) -> Float[Tensor, "B 6 R R"]:
        """Displacement maps, in the units of ``config.displacement_scale``."""
        levels = [self.down[0](maps)]
        for block in self.down[1:]:
            levels.append(block(avg_pool2d(levels[-1], 2)))
        hidden = levels.pop()
        for block in self.up:
            finer = levels.pop()
            hidden = block(torch.cat([finer, interpolate(hidden, size=finer.shape[-2:])], 1))
        if self.config.texel_weights:
            out = torch.einsum("bfyx,cfyx->bcyx", hidden, self.texel[:, :-1]) + self.texel[:, -1]
        else:
            out = self.head(hidden)
        return out * self._gate(maps[:, 12:]) if self.config.gate else out

    def _gate(self, force: Float[Tensor, "B 6 R R"]) -> Float[Tensor, "B 6 R R"]:
        """1 near forces, falling smoothly to exactly 0 at ``config.gate`` texels from them; per panel."""
        radius = self.config.gate
        size = force.detach().unflatten(1, (2, 3)).norm(dim=2)
        spread = max_pool2d((size / _GATE_FULL).clamp(max=1), 2 * (radius // 2) + 1, 1, radius // 2)
        window = 2 * (radius - radius // 2) + 1
        return avg_pool2d(spread, window, 1, window // 2).repeat_interleave(3, 1)


class _Block(nn.Module):
    """Two convolutions of 3x3 texels."""

    def __init__(self, inputs: int, outputs: int, norm: str) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for channels in (inputs, outputs):
            convolution = nn.Conv2d(channels, outputs, 3, padding=1, bias=True)
            nn.init.kaiming_normal_(convolution.weight, nonlinearity="relu")
            nn.init.zeros_(convolution.bias)  # type: ignore[arg-type]
            layers.append(convolution)
            if norm == "instance":
                layers.append(nn.InstanceNorm2d(outputs))
            layers.append(nn.SiLU())
        self.layers = nn.Sequential(*layers)

    def forward(self, maps: Tensor) -> Tensor:
        return self.layers(maps)
