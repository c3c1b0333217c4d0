"""Where a bundle's networks are evaluated."""

import copy
from typing import TypeVar

import torch
from torch import nn

Network = TypeVar("Network", bound=nn.Module)


def on_device(network: Network, device: torch.device | str) -> Network:
    """The network itself if it is on the device, else a copy there: bundles share their networks."""
    wanted = torch.device(device)
    if all(tensor.device.type == wanted.type for tensor in [*network.parameters(), *network.buffers()]):
        return network
    return copy.deepcopy(network).to(wanted)
