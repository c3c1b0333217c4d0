"""Networks on another device: shared ones stay where they are."""

import torch
from torch import nn

from isp_assets.networks.placement import on_device


def test_network_that_is_there_is_itself_another_is_a_copy() -> None:
    network = nn.Linear(2, 3)
    network.register_buffer("scale", torch.ones(1))
    assert on_device(network, "cpu") is network
    moved = on_device(network, "meta")
    assert {tensor.device.type for tensor in [*moved.parameters(), *moved.buffers()]} == {"meta"}
    assert {tensor.device.type for tensor in [*network.parameters(), *network.buffers()]} == {"cpu"}
    moved.requires_grad_(False)
    assert all(parameter.requires_grad for parameter in network.parameters())


def test_network_with_one_tensor_elsewhere_is_copied() -> None:
    network = nn.Linear(2, 3)
    network.register_buffer("scale", torch.ones(1, device="meta"))
    assert on_device(network, "meta") is not network
