"""The skin field: weights, kernel limits, the paper's size, storage of its configuration."""

import json

import pytest
import torch

from isp_assets.networks.skin_field import SkinField, SkinFieldConfig

CENTERS = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])


def _field(**options: object) -> SkinField:
    field = SkinField(SkinFieldConfig(num_vertices=4, **options))
    field.place_on(CENTERS.expand(len(field.config.rest_poses), 4, 3), torch.ones(4))
    return field


@pytest.mark.parametrize("options", [{}, {"rank": 3}, {"kernel": False, "rank": 3}])
def test_weights_are_positive_and_sum_to_one(options: dict) -> None:
    weights = _field(**options)(torch.randn(7, 3))
    assert weights.shape == (7, 4)
    assert weights.min() >= 0
    assert torch.allclose(weights.sum(-1), torch.ones(7))


def test_narrow_kernel_picks_the_vertex_and_wide_kernel_the_areas() -> None:
    field = _field()
    last = field.trunk.layers[-1]
    area = torch.tensor([1.0, 2, 3, 2])
    field.place_on(CENTERS[None], area)
    with torch.no_grad():
        last.weight.zero_()
        last.bias[-1] = -4.0
        assert torch.allclose(field(CENTERS + 0.01), torch.eye(4), atol=1e-5)
        last.bias[-1] = 6.0
        assert torch.allclose(field(CENTERS), (area / area.sum()).expand(4, 4), atol=1e-4)


def test_rest_poses_have_their_own_kernel() -> None:
    field = _field(rest_poses=((0.0,) * 72, (0.1,) * 72))
    field.place_on(torch.stack([CENTERS, CENTERS.flip(0)]), torch.ones(4))
    with torch.no_grad():
        for rest, expected in enumerate((torch.eye(4), torch.eye(4).flip(0))):
            assert torch.equal(field(CENTERS, rest=rest).argmax(-1), expected.argmax(-1))


def test_head_starts_without_effect_and_learns() -> None:
    points = torch.randn(5, 3)
    plain, headed = _field(), _field(rank=3)
    headed.trunk.layers[-1].weight.data[-1] = 0.0
    plain.trunk.layers[-1].weight.data[-1] = 0.0
    assert torch.allclose(plain(points), headed(points), atol=1e-6)
    headed(points)[:, 0].sum().backward()
    assert all(p.grad is not None for p in headed.parameters())


def test_paper_size_and_config_round_trip() -> None:
    config = SkinFieldConfig.paper()
    assert SkinFieldConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config
    count = sum(p.numel() for p in SkinField(config).parameters())
    assert 5.3e6 < count < 5.5e6


def test_field_without_kernel_and_head_is_refused() -> None:
    with pytest.raises(ValueError, match="rank"):
        SkinFieldConfig(num_vertices=4, kernel=False)
