"""Correcting a layer: exactness where nothing touches, held vertices, turning with the body."""

import numpy as np
import pytest
import torch
from torch import Tensor

from isp_assets.body import PosedBody
from isp_assets.errors import DrapeError
from isp_assets.geometry.contact import Surface
from isp_assets.geometry.panel_map import PanelSampler
from isp_assets.geometry.rotations import axis_angle_to_matrix
from isp_assets.layering import BoundLayering, bind_layering, correct_layer
from isp_assets.networks.layering_net import LayeringConfig, LayeringNet
from isp_assets.synthetic import synthetic_garment

CONFIG = LayeringConfig(features=4, map_size=32, levels=2)
GARMENT = synthetic_garment("vest", radius=0.24)


def _sampler(resolution: int = 32) -> PanelSampler:
    panels = list(GARMENT.panels.values())
    scale = max(np.abs(p.panel_xy).max() for p in panels)
    return PanelSampler.build(
        [p.panel_xy / scale for p in panels],
        [p.faces for p in panels],
        [p.vertex_index for p in panels],
        resolution=resolution,
    )


def _bound() -> BoundLayering:
    torch.manual_seed(3)
    net = LayeringNet(CONFIG)
    torch.nn.init.normal_(net.head.weight)
    return bind_layering(net, GARMENT, _sampler())


def _posed(root: Tensor, joint: Tensor) -> PosedBody:
    count = len(root)
    transforms = torch.eye(4).repeat(count, 24, 1, 1)
    transforms[:, 0, :3, :3] = root
    joints = torch.zeros(count, 24, 3)
    joints[:, 0] = joint
    return PosedBody(torch.zeros(count, 1, 3), joints, transforms, torch.zeros(count, 207))


def _ball(radius: float) -> Surface:
    normals = torch.nn.functional.normalize(
        torch.randn(3000, 3, generator=torch.Generator().manual_seed(0)), dim=1
    )
    return Surface(normals[None] * radius, normals[None])


def _vertices() -> Tensor:
    rest = torch.as_tensor(GARMENT.rest_vertices, dtype=torch.float32)
    return (rest - rest.mean(0))[None]


def test_a_layer_that_touches_nothing_is_returned_as_it_is() -> None:
    vertices = _vertices()
    lifted, touched = correct_layer(
        _bound(), vertices, [_ball(0.05)], _posed(torch.eye(3)[None], torch.zeros(1, 3))
    )
    assert not touched.any()
    assert torch.equal(lifted, vertices)


def test_frames_are_treated_one_by_one() -> None:
    """One frame touches, one does not: skipping the second changes neither."""
    bound, vertices = _bound(), _vertices()
    ball = _ball(0.26)
    both = Surface(torch.cat([ball.points, ball.points * 0.1]), ball.normals.repeat(2, 1, 1))
    posed = _posed(torch.eye(3).repeat(2, 1, 1), torch.zeros(2, 3))
    lifted, touched = correct_layer(bound, vertices.repeat(2, 1, 1), [both], posed)
    alone, _ = correct_layer(bound, vertices, [ball], _posed(torch.eye(3)[None], torch.zeros(1, 3)))
    assert touched.tolist() == [True, False]
    assert (lifted[0] - vertices[0]).abs().max() > 1e-4
    torch.testing.assert_close(lifted[0], alone[0])
    assert torch.equal(lifted[1], vertices[0])


def test_the_correction_turns_and_travels_with_the_body() -> None:
    bound, vertices, ball = _bound(), _vertices(), _ball(0.26)
    turn = axis_angle_to_matrix(torch.tensor([[0.4, -1.2, 2.0]]))
    travel = torch.tensor([[1.0, -2.0, 3.0]])
    still, _ = correct_layer(bound, vertices, [ball], _posed(torch.eye(3)[None], torch.zeros(1, 3)))
    there = Surface(ball.points @ turn.mT + travel, ball.normals @ turn.mT)
    moved, _ = correct_layer(bound, vertices @ turn.mT + travel, [there], _posed(turn, travel))
    torch.testing.assert_close(moved, still @ turn.mT + travel, atol=2e-5, rtol=0)


def test_held_vertices_stay() -> None:
    vertices, ramp = _vertices(), torch.zeros(GARMENT.num_vertices)
    ramp[5] = 1
    posed = _posed(torch.eye(3)[None], torch.zeros(1, 3))
    lifted, _ = correct_layer(_bound(), vertices, [_ball(0.26)], posed, ramp=ramp)
    moved = (lifted - vertices).norm(dim=-1)[0]
    assert moved[5] > 0
    assert (moved[torch.arange(GARMENT.num_vertices) != 5] == 0).all()


def test_weights_get_gradients_through_the_correction() -> None:
    bound = _bound()
    posed = _posed(torch.eye(3)[None], torch.zeros(1, 3))
    correct_layer(bound, _vertices(), [_ball(0.26)], posed)[0].square().sum().backward()
    assert all(p.grad is not None and p.grad.any() for p in bound.network.parameters())


def test_a_sampler_of_another_size_is_refused() -> None:
    with pytest.raises(DrapeError, match="32 texels"):
        bind_layering(LayeringNet(CONFIG), GARMENT, _sampler(16))
