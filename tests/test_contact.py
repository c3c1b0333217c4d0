"""Eq. 12 on planes and spheres, its gradients, and how several surfaces combine."""

import math

import numpy as np
import pytest
import torch
from collision_shapes import folded_tube
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from isp_assets.errors import GeometryError
from isp_assets.geometry.contact import Surface, clearance, collision_loss, force


def _plane(height: float = 0.0, *, batch: tuple[int, ...] = (), reach: float = math.inf) -> Surface:
    grid = torch.linspace(-1, 1, 21, dtype=torch.float64)
    x, z = torch.meshgrid(grid, grid, indexing="ij")
    points = torch.stack([x, torch.full_like(x, height), z], -1).reshape(-1, 3)
    normals = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64).expand_as(points)
    shape = (*batch, *points.shape)
    return Surface(points.expand(shape), normals.expand(shape), reach)


def _points(seed: int, count: int = 20, *, batch: tuple[int, ...] = ()) -> Tensor:
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.uniform(-0.9, 0.9, (*batch, count, 3)))


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 1000), st.integers(-50, 50))
def test_on_a_plane_force_is_the_push_to_the_plane(seed: int, centimetres: int) -> None:
    height = centimetres / 100
    vertices = _points(seed)
    push = force(vertices, [_plane(height)])
    expected = torch.zeros_like(vertices)
    expected[:, 1] = (height - vertices[:, 1]).clamp(min=0)
    torch.testing.assert_close(push, expected)
    assert clearance(vertices + push, _plane(height)).min() >= -1e-12


def test_vertices_that_are_clear_get_exactly_no_force() -> None:
    vertices = _points(0)
    vertices[:, 1] = vertices[:, 1].abs() + 1e-9
    assert (force(vertices, [_plane()]) == 0).all()


def test_margin_asks_for_more_clearance() -> None:
    vertices = torch.tensor([[0.0, 0.001, 0.0], [0.0, 0.1, 0.0]], dtype=torch.float64)
    push = force(vertices, [_plane()], margin=0.003)
    torch.testing.assert_close(push[:, 1], torch.tensor([0.002, 0.0], dtype=torch.float64))


def test_largest_push_wins_whatever_the_order() -> None:
    vertices = _points(3)
    both = force(vertices, [_plane(0.1), _plane(0.3)])
    torch.testing.assert_close(both, force(vertices, [_plane(0.3)]))
    torch.testing.assert_close(both, force(vertices, [_plane(0.3), _plane(0.1)]))


def test_samples_beyond_reach_do_not_push() -> None:
    vertices = torch.tensor([[0.0, -0.01, 0.0], [1.5, -0.01, 0.0]], dtype=torch.float64)
    near = _plane(reach=0.1)
    assert force(vertices, [near])[:, 1].tolist() == pytest.approx([0.01, 0.0])
    assert clearance(vertices, near)[1] == math.inf
    assert collision_loss(vertices, [near], margin=0.0).item() == pytest.approx(1e-6)


@pytest.mark.parametrize("margin", [0.0, 0.05])
def test_gradients_in_the_positions(margin: float) -> None:
    vertices = _points(1, 8, batch=(2,)).requires_grad_()
    sphere = _sphere(batch=(2,))
    assert torch.autograd.gradcheck(
        lambda v: force(v, [sphere, _plane(-0.2, batch=(2,))], margin=margin), vertices
    )
    assert torch.autograd.gradcheck(lambda v: collision_loss(v, [sphere], margin=margin), vertices)


def test_every_penetrating_vertex_gets_a_gradient() -> None:
    vertices = _points(2).requires_grad_()
    collision_loss(vertices, [_plane(0.2)]).backward()
    assert ((vertices.grad[:, 1] < 0) == (vertices[:, 1] < 0.202)).all()


def test_loss_is_cubic_in_depth() -> None:
    def loss(depth: float) -> float:
        return collision_loss(
            torch.tensor([[0.0, -depth, 0.0]], dtype=torch.float64), [_plane()], margin=0.0
        ).item()

    assert loss(0.02) / loss(0.01) == pytest.approx(8)


def test_batch_equals_frame_by_frame() -> None:
    vertices = _points(5, batch=(2, 3))
    whole = force(vertices, [_sphere(batch=(2, 3))])
    for i in range(2):
        for j in range(3):
            torch.testing.assert_close(whole[i, j], force(vertices[i, j], [_sphere()]))


def test_blocks_of_distances_find_what_trees_find(monkeypatch: pytest.MonkeyPatch) -> None:
    from isp_assets.geometry import contact

    vertices, sphere = _points(6, batch=(2,)), _sphere(batch=(2,))
    expected = contact._nearest(vertices, sphere)
    monkeypatch.setattr(contact, "_BLOCK", 1000)  # several blocks
    meta = torch.device("meta")
    monkeypatch.setattr(contact, "_on_cpu", lambda tensor: tensor.device == meta)
    distance, index = contact._nearest(vertices, sphere)
    torch.testing.assert_close(distance, expected[0])
    assert (index == expected[1]).all()


def test_mesh_samples_lie_on_the_mesh_and_point_outwards() -> None:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=3)
    vertices, faces = torch.from_numpy(np.asarray(ball.vertices)), torch.from_numpy(np.asarray(ball.faces))
    surface = Surface.of_mesh(vertices, faces, centroids=True)
    assert surface.points.shape[0] == len(ball.vertices) + len(ball.faces)
    assert ((surface.points * surface.normals).sum(-1) > 0.98).all()


def test_samples_of_cloth_point_outwards_where_a_fold_turned_it_over() -> None:
    vertices, faces = (torch.from_numpy(part) for part in folded_tube())
    smooth = vertices * torch.tensor([1.0, 0, 1.0])
    smooth = 0.1 * smooth / smooth.norm(dim=1, keepdim=True) + vertices * torch.tensor([0, 1.0, 0])
    smooth[:, 1] = torch.linspace(-0.2, 0.2, len(smooth) // 60).repeat_interleave(60)
    away = torch.nn.functional.normalize(vertices * torch.tensor([1.0, 0, 1.0]), dim=1)
    plain = Surface.of_mesh(vertices, faces)
    surface = Surface.of_cloth(vertices, faces, smooth, reach=0.05)
    turned = (plain.normals * away).sum(1) < -0.01
    assert turned.any()
    assert ((surface.normals * away).sum(1) > -0.01).all()
    assert torch.equal(surface.normals[~turned], plain.normals[~turned])
    assert torch.equal(surface.points, vertices)
    assert surface.reach == 0.05


def test_bad_input_is_refused() -> None:
    empty = torch.zeros(0, 3)
    with pytest.raises(GeometryError, match="no sample points"):
        Surface(empty, empty)
    with pytest.raises(GeometryError, match="reach"):
        Surface(torch.zeros(1, 3), torch.zeros(1, 3), reach=0.0)
    with pytest.raises(GeometryError, match="margin"):
        force(_points(0), [_plane()], margin=-1.0)
    with pytest.raises(GeometryError, match="margin"):
        collision_loss(_points(0), [_plane()], margin=-1.0)
    with pytest.raises(GeometryError, match="batch"):
        force(_points(0, batch=(2,)), [_plane()])


def _sphere(*, radius: float = 0.6, batch: tuple[int, ...] = ()) -> Surface:
    rng = np.random.default_rng(9)
    normals = rng.normal(size=(4000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    unit = torch.from_numpy(normals).expand(*batch, 4000, 3)
    return Surface(unit * radius, unit)
