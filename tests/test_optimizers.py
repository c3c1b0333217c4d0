"""Optimizers: what SOAP is for, codes apart from networks, the state in a checkpoint, the missing extra."""

import json
import sys

import pytest
import torch

from isp_assets.errors import MissingExtraError
from isp_assets.train.optimizers import LOOKUP, make_optimizer, restore_state, state_tensors


def descend(name: str, left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    """A matrix after some steps of least squares in coordinates turned by ``left`` and ``right``."""
    generator = torch.Generator().manual_seed(3)
    inputs, outputs, wanted, start = torch.randn(4, 6, 6, generator=generator, dtype=torch.float64)
    weight = torch.nn.Parameter(left @ start @ right.T)
    optimizer = make_optimizer(name, [{"params": [weight], "lr": 0.01}])
    for _ in range(60):
        optimizer.zero_grad()
        (inputs @ (left.T @ weight @ right) @ outputs - wanted).square().sum().backward()
        optimizer.step()
    return (left.T @ weight @ right).detach()


def test_soap_takes_the_same_way_in_turned_coordinates_and_adam_does_not():
    one = torch.eye(6, dtype=torch.float64)
    generator = torch.Generator().manual_seed(4)
    turned = [torch.linalg.qr(torch.randn(6, 6, generator=generator, dtype=torch.float64))[0] for _ in "lr"]
    off = {
        name: float((descend(name, one, one) - descend(name, *turned)).abs().max())
        for name in ("adam", "soap")
    }
    assert off["soap"] < 1e-4
    assert off["adam"] > 0.05


def test_codes_take_the_steps_of_plain_adam():
    """No basis is shared by rows that belong to single garments, whatever their number."""
    start = torch.randn(5, 3, generator=torch.Generator().manual_seed(0))
    found = []
    for make in (
        lambda p: make_optimizer("soap", [{"params": [p], "lr": 0.01, **LOOKUP}]),
        lambda p: torch.optim.Adam([p], lr=0.01),
    ):
        codes = torch.nn.Parameter(start.clone())
        optimizer = make(codes)
        for step in range(21):
            optimizer.zero_grad()
            codes.square().sum().backward()
            # SOAP learns its basis from the first gradient and moves from the second on.
            if step or not isinstance(optimizer, torch.optim.Adam):
                optimizer.step()
        found.append(codes.detach())
    torch.testing.assert_close(found[0], found[1], atol=1e-5, rtol=0)


@pytest.mark.parametrize("name", ["adam", "soap"])
def test_a_restored_optimizer_goes_on_as_if_it_had_not_stopped(name):
    def run(optimizer, layer, steps, generator):
        for _ in range(steps):
            x = torch.randn(16, 4, generator=generator)
            optimizer.zero_grad()
            layer(x).square().mean().backward()
            optimizer.step()

    def fresh():
        torch.manual_seed(0)
        layer = torch.nn.Linear(4, 6)
        groups = [{"params": [layer.weight], "lr": 1e-2}, {"params": [layer.bias], "lr": 1e-2, **LOOKUP}]
        return layer, make_optimizer(name, groups)

    whole, optimizer = fresh()
    generator = torch.Generator().manual_seed(5)
    run(optimizer, whole, 25, generator)
    tensors, rest = state_tensors(optimizer)
    tensors = {key: value.clone() for key, value in tensors.items()}
    rest, between = json.loads(json.dumps(rest)), generator.get_state()
    parts, other = fresh()
    parts.load_state_dict({key: value.clone() for key, value in whole.state_dict().items()})
    restore_state(other, tensors, rest)
    run(optimizer, whole, 25, generator)
    run(other, parts, 25, torch.Generator().set_state(between))
    assert torch.equal(whole.weight, parts.weight)
    assert torch.equal(whole.bias, parts.bias)


def test_a_missing_library_names_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pytorch_optimizer", None)
    with pytest.raises(MissingExtraError, match=r"isp-assets\[train\]"):
        make_optimizer("soap", [{"params": [torch.nn.Parameter(torch.zeros(2, 2))], "lr": 1.0}])
