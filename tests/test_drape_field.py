"""D_s: starts at zero, folds exactly into a garment, keeps anchors, does not see the heading."""

import json

import numpy as np
import pytest
import torch

from isp_assets.body import Body
from isp_assets.displacement import anchor_ramp, bind_displacement, displace, displacements
from isp_assets.drape_features import drape_features, pose_features
from isp_assets.errors import DrapeError
from isp_assets.geometry.panel_map import PanelSampler
from isp_assets.networks.drape_field import DrapeField, DrapeFieldConfig
from isp_assets.synthetic import synthetic_garment

SMALL = DrapeFieldConfig(code_size=4, width=16, basis=5, map_size=16, coarse_size=4)


def _trained(config: DrapeFieldConfig = SMALL) -> DrapeField:
    """A field with random weights everywhere."""
    field = DrapeField(config)
    for parameter in field.parameters():
        torch.nn.init.normal_(parameter, 0.0, 0.3)
    return field


def _sampler(resolution: int) -> PanelSampler:
    garment = synthetic_garment("tube", radius=0.25)
    panels = list(garment.panels.values())
    size = max(np.abs(p.panel_xy).max() for p in panels) * 1.1
    parts = ([p.panel_xy / size for p in panels], [p.faces for p in panels], [p.vertex_index for p in panels])
    return PanelSampler.build(*parts, resolution=resolution)


def test_untrained_network_moves_nothing_but_can_learn() -> None:
    field = DrapeField(SMALL)
    maps = field(torch.randn(3, SMALL.num_features))
    assert torch.equal(maps, torch.zeros(3, 6, 16, 16))
    maps.square().sum().backward()
    (field(torch.randn(3, SMALL.num_features)) - 1).square().sum().backward()
    assert field.mlp.layers[-1].weight.grad.abs().sum() > 0
    assert field.fine.grad[-1].abs().sum() > 0
    assert field.coarse.grad[-1].abs().sum() > 0


def test_folded_basis_equals_sampling_the_maps() -> None:
    field, sampler, features = _trained(), _sampler(16), torch.randn(4, SMALL.num_features)
    ramp = np.linspace(0, 1, sampler.num_vertices).astype(np.float32)
    with torch.no_grad():
        through_maps = sampler.sample(field(features)) * torch.tensor(ramp)[:, None]
        folded = displacements(bind_displacement(field, sampler, ramp), field, features)
    assert torch.allclose(folded, through_maps, atol=1e-5)
    assert through_maps.abs().max() > 1e-3


def test_resolution_mismatch_is_refused() -> None:
    with pytest.raises(DrapeError, match="16 texels, the sampler of 8"):
        bind_displacement(_trained(), _sampler(8), np.ones(1, np.float32))


def test_features_ignore_heading_and_place_but_see_tilt() -> None:
    body = Body.load()
    poses = 0.4 * torch.randn(1, 24, 3).expand(4, -1, -1).clone()
    poses[:, 0] = torch.tensor([[0.0, 0, 0], [0, 2.1, 0], [0, -1, 0], [0.5, 0, 0]])
    shift = torch.tensor([[0.0, 0, 0], [3, 0, -2], [0, 1, 0], [0, 0, 0]])
    feature = pose_features(body.pose(poses, translation=shift))
    assert torch.allclose(feature[0], torch.cat([torch.tensor([0.0, -1, 0]), feature[0, 3:]]), atol=1e-6)
    assert torch.allclose(feature[:1].expand(3, -1), feature[:3], atol=1e-5)
    assert (feature[3, :3] - feature[0, :3]).norm() > 0.4


def test_rest_pose_gives_zero_rotation_features_and_hands_are_not_seen() -> None:
    poses = torch.zeros(2, 24, 3)
    poses[1, 22:] = 1.0
    feature = pose_features(Body.load().pose(poses))
    assert torch.allclose(feature, torch.tensor([0.0, -1, 0] + [0.0] * 126).expand(2, -1), atol=1e-6)


def test_full_features_pad_betas_and_end_in_the_code() -> None:
    posed = Body.load().pose(torch.zeros(2, 24, 3))
    feature = drape_features(posed, torch.tensor([1.0, 2.0]), torch.full((4,), 7.0), num_betas=10)
    assert feature.shape == (2, SMALL.num_features)
    assert torch.equal(feature[:, 129:], torch.tensor([[1.0, 2] + [0] * 8 + [7] * 4]).expand(2, -1))


def test_ramp_is_zero_at_anchors_and_one_beyond_its_length() -> None:
    garment = synthetic_garment("tube", radius=0.25)
    top = np.flatnonzero(garment.rest_vertices[:, 1] > garment.rest_vertices[:, 1].max() - 1e-6)
    anchored = type(garment)(**{**vars(garment), "anchors": top})
    depth = garment.rest_vertices[:, 1].max() - garment.rest_vertices[:, 1]
    ramp = anchor_ramp(anchored, length=0.2)
    assert np.array_equal(ramp[top], np.zeros(len(top)))
    assert np.array_equal(ramp[depth > 0.2], np.ones((depth > 0.2).sum()))
    columns = (ramp > 0) & (ramp < 1)
    t = depth[columns] / 0.2
    assert np.allclose(ramp[columns], t * t * (3 - 2 * t), atol=1e-5)
    bare = type(garment)(**{**vars(garment), "anchors": np.zeros(0, np.int64)})
    assert np.array_equal(anchor_ramp(bare), np.ones(garment.num_vertices))


def test_displacements_turn_with_the_skinning() -> None:
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = displace(
        torch.zeros(1, 2, 3), quarter.expand(1, 2, 3, 3), torch.tensor([[[1.0, 0, 0], [0, 2, 0]]])
    )
    assert torch.equal(moved, torch.tensor([[[0.0, 1, 0], [-2, 0, 0]]]))


def test_paper_size_and_config_round_trip() -> None:
    config = DrapeFieldConfig.paper()
    assert DrapeFieldConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config
    with torch.device("meta"):
        count = sum(p.numel() for p in DrapeField(config).parameters())
    assert 120e6 < count < 130e6
