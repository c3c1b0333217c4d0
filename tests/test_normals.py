"""Normals: exact on simple meshes, equivariant, differentiable, defined on degenerate faces."""

import numpy as np
import torch

from isp_assets.geometry.normals import face_normals, vertex_normals
from isp_assets.geometry.rotations import axis_angle_to_matrix

CUBE = torch.tensor([[x, y, z] for z in (0.0, 1.0) for y in (0.0, 1.0) for x in (0.0, 1.0)])
CUBE_FACES = torch.tensor(
    [[0, 2, 3], [0, 3, 1], [4, 5, 7], [4, 7, 6], [0, 1, 5], [0, 5, 4],
     [2, 6, 7], [2, 7, 3], [0, 4, 6], [0, 6, 2], [1, 3, 7], [1, 7, 5]]
)  # fmt: skip


def _bumpy_grid(n: int = 6) -> tuple[torch.Tensor, torch.Tensor]:
    x, y = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    v = np.stack([x, y, np.sin(x + 2.0 * y)], -1).reshape(-1, 3)
    at = np.arange(n * n).reshape(n, n)
    quads = np.stack([at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]], -1).reshape(-1, 4)
    return torch.tensor(v), torch.tensor(np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]))


def test_cube_faces_point_outward_along_axes() -> None:
    normal = face_normals(CUBE, CUBE_FACES)
    centre = CUBE[CUBE_FACES].mean(1) - 0.5
    assert torch.allclose((normal * centre).sum(-1), torch.full((12,), 0.5), atol=1e-6)
    assert torch.equal(normal.abs().sort(-1).values[:, :2], torch.zeros(12, 2))


def test_vertex_normals_weigh_faces_by_area() -> None:
    # Two faces share vertex 0: one of area 1/2 facing +Z, one of area 1 facing +X.
    v = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 2, 0], [0, 0, 1]], dtype=torch.float64)
    normal = vertex_normals(v, torch.tensor([[0, 1, 2], [0, 3, 4]]))
    expected = torch.tensor([2.0, 0, 1], dtype=torch.float64) / 5**0.5
    assert torch.allclose(normal[0], expected)


def test_batched_and_equivariant_to_rotation() -> None:
    v, f = _bumpy_grid()
    turn = axis_angle_to_matrix(torch.tensor([0.3, -1.0, 0.7], dtype=torch.float64))
    both = vertex_normals(torch.stack([v, v @ turn.T + 5]), f)
    assert torch.allclose(both[0] @ turn.T, both[1], atol=1e-12)
    assert torch.allclose(both.norm(dim=-1), torch.ones(2, len(v), dtype=torch.float64))


def test_gradients_are_right() -> None:
    v, f = _bumpy_grid(3)
    v.requires_grad_(True)
    assert torch.autograd.gradcheck(lambda x: vertex_normals(x, f), (v,))
    assert torch.autograd.gradcheck(lambda x: face_normals(x, f), (v,))


def test_degenerate_faces_and_lone_vertices_give_zero_and_finite_gradients() -> None:
    v = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [9, 9, 9]], requires_grad=True)
    normal = vertex_normals(v, torch.tensor([[0, 1, 2]]))
    normal.sum().backward()
    assert torch.equal(normal, torch.zeros(4, 3))
    assert v.grad is not None
    assert torch.isfinite(v.grad).all()


def test_tiny_faces_keep_their_direction() -> None:
    v = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]) * 1e-7
    assert torch.allclose(face_normals(v, torch.tensor([[0, 1, 2]])), torch.tensor([[0.0, 0, 1]]))
