"""The U-Net: shapes, where it acts, what both panels do, and its configuration."""

import pytest
import torch

from isp_assets.errors import BundleError
from isp_assets.networks.layering_net import LayeringConfig, LayeringNet

SMALL = LayeringConfig(features=4, map_size=32, levels=2)


def _random_net(config: LayeringConfig) -> LayeringNet:
    """The last layer starts at zero; a random one shows what reaches it."""
    net = LayeringNet(config)
    with torch.no_grad():
        for parameter in net.parameters():
            if not parameter.any():
                parameter.normal_(0, 0.1)
    return net


def _maps(config: LayeringConfig, batch: int = 2) -> torch.Tensor:
    maps = torch.randn(batch, 18, config.map_size, config.map_size)
    maps[:, 12:] = 0
    return maps


@pytest.mark.parametrize("size", [32, 50])  # 50 is no multiple of 2**levels, as 200 is none of 2**4
def test_output_has_one_displacement_per_panel_and_texel(size: int) -> None:
    config = LayeringConfig(features=4, map_size=size, levels=2)
    assert LayeringNet(config)(torch.randn(3, 18, size, size)).shape == (3, 6, size, size)


def test_untrained_network_moves_nothing() -> None:
    assert (LayeringNet(SMALL)(torch.randn(1, 18, 32, 32)) == 0).all()


def test_without_force_nothing_moves_at_all() -> None:
    assert (_random_net(SMALL)(_maps(SMALL)) == 0).all()


def test_correction_stays_near_the_contact_and_on_its_panel() -> None:
    maps = _maps(SMALL)
    maps[:, 12:15, 10, 10] = 1.0  # a push on the front only
    moved = _random_net(SMALL)(maps).norm(dim=1)
    front, back = _random_net(SMALL)(maps).split(3, 1)
    assert moved[:, 10, 10].min() > 0
    assert (moved[:, 16:] == 0).all()
    assert front.abs().max() > 0
    assert (back == 0).all()


def test_both_panels_reach_the_output() -> None:
    """A known slip is to feed the front panel twice: then the back's maps change nothing."""
    net = _random_net(LayeringConfig(features=4, map_size=32, levels=2, gate=0))
    maps = torch.randn(1, 18, 32, 32, requires_grad=True)
    net(maps).square().sum().backward()
    per_channel = maps.grad.abs().sum((0, 2, 3))
    assert per_channel.shape == (18,)
    assert (per_channel > 0).all()


@pytest.mark.parametrize("texel_weights", [False, True])
@pytest.mark.parametrize("norm", ["none", "instance"])
def test_every_parameter_gets_a_gradient(norm: str, texel_weights: bool) -> None:
    config = LayeringConfig(features=4, map_size=32, levels=2, norm=norm, texel_weights=texel_weights, gate=0)
    net = _random_net(config)
    net(torch.randn(2, 18, 32, 32)).square().sum().backward()
    without = [name for name, p in net.named_parameters() if p.grad is None or not p.grad.any()]
    # A bias before an instance norm has no effect; that is the paper's network, kept as it is.
    assert all(norm == "instance" and name.endswith("bias") for name in without)


def test_batch_entries_do_not_mix() -> None:
    net, maps = _random_net(SMALL).eval(), torch.randn(3, 18, 32, 32)
    whole = net(maps)
    for k in range(3):
        torch.testing.assert_close(net(maps[k : k + 1])[0], whole[k], atol=1e-5, rtol=1e-4)


def test_paper_size_is_expressible() -> None:
    with torch.device("meta"):
        net = LayeringNet(LayeringConfig.paper())
    assert 8e7 < sum(p.numel() for p in net.parameters()) < 2e8
    assert net.texel.shape[-2:] == (200, 200)


def test_config_round_trip_and_refusals() -> None:
    assert LayeringConfig.from_dict(SMALL.to_dict()) == SMALL
    with pytest.raises(BundleError, match="norm"):
        LayeringConfig(norm="batch")
    with pytest.raises(BundleError, match="map_size"):
        LayeringConfig(map_size=8, levels=4)
