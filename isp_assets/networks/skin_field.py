"""Diffused skinning: weights over the body's vertices at any point around the body, ``w(v)`` of Eq. 6.

The weights are a Gaussian kernel over the body's vertices whose width a small
network gives at every point: about the cloth's thickness on the skin, growing with
the distance from it. A learnt linear head may be added to the kernel's exponents, or
replace it as in the paper, at a hundred times the weights.

A body in a spread pose has other neighbours than one with its legs together, so the
field knows the few rest poses that garments are modelled on, and is asked about
a point in the space of one of them. Then a trouser leg is never near the other leg.

Reference: Li, Guillard and Fua, "ISP: Multi-Layered Garment Draping with
Implicit Sewing Patterns", NeurIPS 2023, Eqs. 6-7.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from isp_assets.networks.mlp import Mlp

_T_POSE = (0.0,) * 72
_FIRST_WIDTH = 0.05  # kernel width before training [m]


@dataclass(frozen=True)
class SkinFieldConfig:
    """Size of a skin field and the rest poses it knows; stored with its weights."""

    num_vertices: int
    """Vertices N of the body."""
    rest_poses: tuple[tuple[float, ...], ...] = (_T_POSE,)
    """Axis-angle poses of 24 joints [rad]; garments are modelled on the body in one of them."""
    kernel: bool = True
    """Whether the exponents start from the Gaussian kernel."""
    rank: int = 0
    """Inputs of the linear head to all vertices; 0 for none."""
    width: int = 96
    depth: int = 5
    activation: str = "softplus"
    input_scale: float = 10.0
    """Factor on positions before the first layer [1/m]."""

    def __post_init__(self) -> None:
        if not self.kernel and self.rank < 1:
            raise ValueError("a skin field needs its kernel, or a head of rank >= 1")

    @classmethod
    def paper(cls, num_vertices: int = 6890) -> "SkinFieldConfig":
        """The size used by the paper: 5.4 million parameters, no kernel."""
        return cls(
            num_vertices=num_vertices, kernel=False, rank=512, width=512, depth=8, activation="leaky_relu"
        )

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "SkinFieldConfig":
        """Read plain values, as JSON gives them back."""
        plain = dict(values)
        plain["rest_poses"] = tuple(tuple(float(x) for x in pose) for pose in plain["rest_poses"])
        return cls(**plain)


class SkinField(nn.Module):
    """Weights over the vertices of one body: a small network, exponents for all vertices, a softmax.

    Before use the buffers hold no body; see `place_on`.
    """

    centers: Tensor
    area: Tensor

    def __init__(self, config: SkinFieldConfig) -> None:
        super().__init__()
        self.config = config
        poses, count = len(config.rest_poses), config.num_vertices
        self.trunk = Mlp(
            (3, poses), config.rank + config.kernel, width=config.width, depth=config.depth,
            activation=config.activation,
        )  # fmt: skip
        if config.rank:
            self.head = nn.Linear(config.rank, count)
        if config.kernel:
            self.register_buffer("centers", torch.zeros(poses, count, 3))
            self.register_buffer("area", torch.ones(count))
            self._start_at_kernel()

    def _start_at_kernel(self) -> None:
        bias = self.trunk.layers[-1].get_parameter("bias")
        with torch.no_grad():
            bias[-1] = torch.log(torch.tensor(_FIRST_WIDTH))
            if self.config.rank:
                self.head.weight.zero_()
                self.head.bias.zero_()

    def place_on(self, vertices: Float[Tensor, "poses N 3"], area: Float[Tensor, " N"]) -> None:
        """Put the kernel on the mean body in every rest pose; ``area`` weighs its vertices [any unit]."""
        if self.config.kernel:
            self.centers.copy_(vertices)
            self.area.copy_(area / area.mean())

    def log_width(self, points: Float[Tensor, "P 3"], *, rest: int = 0) -> Float[Tensor, " P"]:
        """Logarithm of the kernel's width [m]; arguments as in `forward`."""
        return self._hidden(points, rest)[:, -1]

    def logits(self, points: Float[Tensor, "P 3"], *, rest: int = 0) -> Float[Tensor, "P N"]:
        """Unnormalised logarithms of the weights; arguments as in `forward`."""
        hidden = self._hidden(points, rest)
        if not self.config.kernel:
            return self.head(nn.functional.leaky_relu(hidden))
        square = torch.cdist(points, self.centers[rest]).square()
        kernel = self.area.log() - 0.5 * square * torch.exp(-2 * hidden[:, -1:])
        return kernel + self.head(hidden[:, :-1]) if self.config.rank else kernel

    def forward(self, points: Float[Tensor, "P 3"], *, rest: int = 0) -> Float[Tensor, "P N"]:
        """Weights over the body's vertices, positive, summing to 1.

        Args:
            points: Positions around the mean body (betas 0) in rest pose number ``rest`` [m].
            rest: Which of ``config.rest_poses`` the points belong to.
        """
        return self.logits(points, rest=rest).softmax(-1)

    def _hidden(self, points: Tensor, rest: int) -> Tensor:
        choice = torch.zeros(len(self.config.rest_poses), dtype=points.dtype, device=points.device)
        choice[rest] = 1.0
        return self.trunk(points * self.config.input_scale, choice)
