"""The panel field: its sizes, its two outputs, and how codes broadcast."""

import json

import torch

from isp_assets.networks.panel_field import PanelField, PanelFieldConfig


def count(module: torch.nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def test_the_papers_size_is_expressible():
    assert round(count(PanelField(PanelFieldConfig.paper(11))) / 1e6, 2) == 0.69


def test_one_code_serves_a_grid():
    field = PanelField(PanelFieldConfig(num_labels=4, width=16)).double()
    xy, code = torch.rand(5, 6, 2).double(), torch.randn(32).double()
    distance, logits = field(xy, code)
    again, logits_again = field(xy, code.expand(5, 6, 32))
    assert distance.shape == (5, 6)
    assert logits.shape == (5, 6, 5)
    torch.testing.assert_close(distance, again)
    torch.testing.assert_close(logits, logits_again)
    torch.testing.assert_close(field.signed_distance(xy, code), distance)


def test_both_outputs_depend_on_point_and_code():
    field = PanelField(PanelFieldConfig(num_labels=4, width=16))
    for output in (0, 1):
        xy, code = torch.rand(8, 2).requires_grad_(), torch.randn(8, 32).requires_grad_()
        field(xy, code)[output].square().sum().backward()
        assert (xy.grad.abs().sum(1) > 0).all()
        assert (code.grad.abs().sum(1) > 0).all()


def test_the_config_survives_json():
    config = PanelFieldConfig(num_labels=7, width=64, input_scale=8.0)
    assert PanelFieldConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config
