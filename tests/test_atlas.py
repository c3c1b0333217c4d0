"""The atlas: its size, its affine start, and its stored configuration."""

import json

import torch

from isp_assets.networks.atlas import Atlas, AtlasConfig

AFFINE = {"offset": (0.1, 1.2, -0.3), "slope": ((1.0, 0.0), (0.0, 0.5), (0.2, -0.1))}


def test_the_papers_size_is_expressible():
    count = sum(p.numel() for p in Atlas(AtlasConfig.paper()).parameters())
    assert round(count / 1e6, 2) == 0.35


def test_without_its_network_it_is_the_affine_map():
    atlas = Atlas(AtlasConfig(width=8, output_scale=0.0, **AFFINE)).double()
    xy, code = torch.rand(10, 2).double(), torch.randn(32).double()
    slope = torch.tensor(AFFINE["slope"], dtype=torch.float32).double()
    offset = torch.tensor(AFFINE["offset"], dtype=torch.float32).double()
    torch.testing.assert_close(atlas(xy, code), offset + xy @ slope.T)


def test_one_code_serves_all_points():
    atlas = Atlas(AtlasConfig(width=16, **AFFINE))
    xy, code = torch.rand(4, 7, 2), torch.randn(4, 1, 32)
    torch.testing.assert_close(atlas(xy, code), atlas(xy, code.expand(4, 7, 32)))


def test_the_config_survives_json():
    config = AtlasConfig(width=16, skip=None, depth=4, **AFFINE)
    assert AtlasConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


def test_weights_alone_are_stored():
    assert not {"offset", "slope"} & set(Atlas(AtlasConfig(width=8, **AFFINE)).state_dict())
