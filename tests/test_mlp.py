"""Input parts act as their concatenation, whatever their leading axes."""

import pytest
import torch

from isp_assets.networks.mlp import Mlp


@pytest.mark.parametrize("skip", [None, 2])
@pytest.mark.parametrize("weight_norm", [False, True])
def test_parts_act_as_their_concatenation(skip, weight_norm):
    net = Mlp((2, 5), 3, width=16, depth=4, skip=skip, weight_norm=weight_norm).double()
    joined = Mlp((7,), 3, width=16, depth=4, skip=skip, weight_norm=weight_norm).double()
    joined.load_state_dict(net.state_dict())
    xy, code = torch.randn(6, 4, 2).double(), torch.randn(6, 1, 5).double()
    everywhere = torch.cat([xy, code.expand(6, 4, 5)], dim=-1)
    torch.testing.assert_close(net(xy, code), joined(everywhere))


def test_gradients_are_exact():
    net = Mlp((2, 3), 2, width=6, depth=3, skip=1, activation="silu").double()
    inputs = (torch.randn(4, 2).double().requires_grad_(), torch.randn(3).double().requires_grad_())
    assert torch.autograd.gradcheck(net, inputs)


def test_every_layer_learns():
    net = Mlp((2, 3), 2, width=16, depth=5, skip=3)
    net(torch.randn(64, 2), torch.randn(64, 3)).square().sum().backward()
    assert all(p.grad.abs().sum() > 0 for p in net.parameters())


def test_the_activation_can_follow_the_last_layer():
    net = Mlp((2,), 8, width=16, depth=2, activation="relu", activate_last=True)
    assert (net(torch.randn(100, 2)) >= 0).all()


def test_bad_settings_are_refused():
    with pytest.raises(ValueError, match="activation"):
        Mlp((2,), 1, width=4, depth=2, activation="tanh")
    with pytest.raises(ValueError, match="skip"):
        Mlp((2,), 1, width=4, depth=2, skip=2)
