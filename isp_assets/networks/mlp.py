"""A fully connected network whose input may come in parts.

The parts act as if they were concatenated, but stay apart: a latent code that
many points share is multiplied once, not once a point. With ``input_scale`` and
Softplus(beta=100), points ten times larger than [-1, 1] give the network enough
frequency to draw sharp corners; SiLU or unscaled inputs leave about three times the error.
"""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils.parametrizations import weight_norm as add_weight_norm

_ACTIVATIONS = ("softplus", "relu", "leaky_relu", "silu")


class Mlp(nn.Module):
    """``depth`` linear layers of ``width`` units; the input may enter a second time at layer ``skip``.

    Weights start as ``torch.nn.Linear`` does: uniform in ``±1/sqrt(inputs)``.

    Args:
        inputs: Size of every input part.
        outputs: Size of the last layer.
        width: Units of the hidden layers.
        depth: Number of linear layers, the last one included.
        skip: Index of the layer that sees the input again; None for no second entry.
        activation: "softplus" (beta 100), "relu", "leaky_relu" or "silu".
        activate_last: Whether the last layer is followed by the activation.
        weight_norm: Whether weights are stored as direction and length.
    """

    def __init__(
        self, inputs: Sequence[int], outputs: int, *, width: int, depth: int, skip: int | None = None,
        activation: str = "softplus", activate_last: bool = False, weight_norm: bool = False,
    ) -> None:  # fmt: skip
        super().__init__()
        if activation not in _ACTIVATIONS:
            raise ValueError(f"activation must be one of {_ACTIVATIONS}, got {activation!r}")
        if skip is not None and not 0 < skip < depth:
            raise ValueError(f"skip must be a layer in 1..{depth - 1}, got {skip}")
        self.input_sizes, self.skip = tuple(inputs), skip
        self.activation, self.activate_last = activation, activate_last
        total = sum(self.input_sizes)
        layers: list[nn.Linear] = []
        for index in range(depth):
            size = total if index == 0 else width + (total if index == skip else 0)
            layer = nn.Linear(size, outputs if index == depth - 1 else width)
            layers.append(add_weight_norm(layer) if weight_norm else layer)
        self.layers = nn.ModuleList(layers)

    def forward(self, *parts: Float[Tensor, "..."]) -> Float[Tensor, "*batch out"]:
        """Evaluate the network; leading axes of the parts broadcast against each other."""
        hidden = _linear(self.layers[0], parts)
        for index, layer in enumerate(self.layers[1:], start=1):
            hidden = self._activate(hidden)
            hidden = _linear(layer, (hidden, *parts)) if index == self.skip else layer(hidden)
        return self._activate(hidden) if self.activate_last else hidden

    def _activate(self, x: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch n"]:
        match self.activation:
            case "softplus":
                return nn.functional.softplus(x, beta=100.0)
            case "relu":
                return torch.relu(x)
            case "leaky_relu":
                return nn.functional.leaky_relu(x)
            case _:
                return nn.functional.silu(x)


def _linear(layer: Any, parts: Sequence[Tensor]) -> Tensor:
    """``layer(cat(parts))`` with broadcasting and without the concatenation."""
    if len(parts) == 1:
        return layer(parts[0])
    blocks = layer.weight.split([part.shape[-1] for part in parts], dim=1)
    result = nn.functional.linear(parts[-1], blocks[-1], layer.bias)
    for part, block in zip(reversed(parts[:-1]), reversed(blocks[:-1]), strict=True):
        if result.ndim == 1:  # one code for all points: what it adds is a bias
            result = nn.functional.linear(part, block, result)
        elif part.ndim == result.ndim == 2 and len(part) == len(result):
            result = torch.addmm(result, part, block.T)
        else:
            result = nn.functional.linear(part, block) + result
    return result
