"""Cloth energy against closed forms: rigid motion, uniform strain, bent cylinders, gradients."""

import numpy as np
import pytest
import torch
from scipy.spatial import Delaunay

from isp_assets.errors import GeometryError
from isp_assets.geometry.energy import Fabric, bending_energy, cloth_rest, gravity_energy, membrane_energy
from isp_assets.geometry.rotations import axis_angle_to_matrix

FABRIC = Fabric()


def strip(nx: int, ny: int, width: float = 0.3, height: float = 0.1):
    """A flat grid of right triangles, their diagonals alternating: xy, faces, flat corners."""
    x, y = np.meshgrid(np.linspace(0, width, nx + 1), np.linspace(0, height, ny + 1), indexing="ij")
    xy = np.stack([x, y], -1).reshape(-1, 2)
    faces = []
    for i in range(nx):
        for j in range(ny):
            a, b, c, d = (
                i * (ny + 1) + j,
                (i + 1) * (ny + 1) + j,
                (i + 1) * (ny + 1) + j + 1,
                i * (ny + 1) + j + 1,
            )
            faces += [(a, b, c), (a, c, d)] if (i + j) % 2 else [(a, b, d), (b, c, d)]
    faces = np.array(faces)
    return xy, faces, xy[faces]


def in_space(xy: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.pad(xy, ((0, 0), (0, 1))))


def test_rigid_motion_costs_nothing_but_height():
    xy, faces, corners = strip(6, 3)
    rest = cloth_rest(faces, corners, len(xy), FABRIC)
    rotation = axis_angle_to_matrix(torch.tensor([[0.3, -1.1, 0.7], [2.0, 0.1, -0.4]], dtype=torch.float64))
    moved = in_space(xy) @ rotation.mT + torch.tensor([1.0, 2.0, -3.0], dtype=torch.float64)
    assert moved.shape == (2, len(xy), 3)
    assert membrane_energy(moved, rest, FABRIC).abs().max() < 1e-24
    assert bending_energy(moved, rest, FABRIC).abs().max() < 1e-20
    lifted = gravity_energy(moved + torch.tensor([0.0, 0.5, 0.0]), rest) - gravity_energy(moved, rest)
    weight = 0.3 * 0.1 * FABRIC.density * 9.81
    assert torch.allclose(lifted, torch.full((2,), 0.5 * weight, dtype=torch.float64))


@pytest.mark.parametrize("stretch", [(1.1, 1.0), (0.9, 1.2), (1.3, 1.3)])
def test_uniform_stretch_is_the_stvk_density_times_the_area(stretch):
    xy, faces, corners = strip(5, 4)
    # The second panel of a garment is wound the other way in its plane; the energy must not notice.
    corners[::2] = corners[::2, [0, 2, 1]]
    faces[::2] = faces[::2, [0, 2, 1]]
    rest = cloth_rest(faces, corners, len(xy), FABRIC)
    e = (np.square(stretch) - 1) / 2
    expected = 0.03 * (FABRIC.mu * (e**2).sum() + 0.5 * FABRIC.lam * e.sum() ** 2)
    energy = membrane_energy(in_space(xy * stretch), rest, FABRIC)
    assert energy.item() == pytest.approx(expected, rel=1e-12)


def test_simple_shear_is_the_stvk_density_times_the_area():
    xy, faces, corners = strip(5, 4)
    rest = cloth_rest(faces, corners, len(xy), FABRIC)
    gradient = np.array([[1.0, 0.3], [0.0, 1.0]])
    green = (gradient.T @ gradient - np.eye(2)) / 2
    expected = 0.03 * (FABRIC.mu * (green**2).sum() + 0.5 * FABRIC.lam * np.trace(green) ** 2)
    assert membrane_energy(in_space(xy @ gradient.T), rest, FABRIC).item() == pytest.approx(
        expected, rel=1e-12
    )


def lattice(spacing: float, turn: float, size: float = 0.3):
    """A disc of the regular lattice, turned: xy, faces, flat corners, area."""
    y = np.arange(-size, size, spacing * np.sqrt(3) / 2)
    x = np.arange(-size, size, spacing)
    grid = np.stack(np.meshgrid(x, y), -1)
    grid[1::2, :, 0] += spacing / 2
    xy = grid.reshape(-1, 2)
    faces = Delaunay(xy).simplices
    inside = (np.linalg.norm(xy[faces].mean(1), axis=-1) < 0.1) & (
        np.linalg.norm(np.ptp(xy[faces], axis=1), axis=-1) < 2 * spacing
    )
    used, faces = np.unique(faces[inside], return_inverse=True)
    faces = faces.reshape(-1, 3)
    xy = xy[used] @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    return xy, faces, xy[faces], np.sqrt(3) / 4 * spacing**2 * len(faces)


@pytest.mark.parametrize("turn", [0.0, 0.3, np.pi / 6])
def test_a_cylinder_of_regular_triangles_has_the_plate_energy_in_the_limit(turn):
    """``3 k/2 / radius^2`` per area, whatever the direction; the error shrinks under refinement."""
    radius, errors = 0.08, []
    for spacing in (0.016, 0.008, 0.004):
        xy, faces, corners, area = lattice(spacing, turn)
        rest = cloth_rest(faces, corners, len(xy), FABRIC)
        angle = xy[:, 0] / radius
        bent = np.stack([radius * np.sin(angle), xy[:, 1], radius * np.cos(angle)], axis=1)
        expected = 0.5 * 3 * FABRIC.bending * area / radius**2
        errors.append(abs(bending_energy(torch.from_numpy(bent), rest, FABRIC).item() / expected - 1))
    assert errors[2] < 0.05  # what is left is the rim, whose edges have no hinge
    assert errors[2] < 0.6 * errors[1] < 0.36 * errors[0]


def test_a_shallow_bowl_costs_the_squared_mean_curvature():
    """``k/2 (3 + 3 - 2) kappa^2`` per area."""
    xy, faces, corners, area = lattice(0.004, 0.0)
    rest = cloth_rest(faces, corners, len(xy), FABRIC)
    bowl = in_space(xy) + torch.tensor([0.0, 0.0, 0.5], dtype=torch.float64) * in_space(xy).square().sum(
        -1, keepdim=True
    )
    expected = 0.5 * FABRIC.bending * 4 * area
    assert bending_energy(bowl, rest, FABRIC).item() == pytest.approx(expected, rel=0.05)


def test_gradients_match_finite_differences():
    xy, faces, corners = strip(2, 1)
    rest = cloth_rest(faces, corners, len(xy), Fabric(bending=0.3))
    start = in_space(xy) + 0.01 * torch.randn(len(xy), 3, dtype=torch.float64)
    start.requires_grad_(True)
    fabric = Fabric(bending=0.3)
    assert torch.autograd.gradcheck(lambda x: membrane_energy(x, rest, fabric), start)
    assert torch.autograd.gradcheck(lambda x: bending_energy(x, rest, fabric), start)
    assert torch.autograd.gradcheck(lambda x: gravity_energy(x, rest), start)


def test_batches_equal_single_evaluations_and_forces_balance():
    xy, faces, corners = strip(4, 3)
    rest = cloth_rest(faces, corners, len(xy), FABRIC)
    poses = (in_space(xy) + 0.01 * torch.randn(2, 3, len(xy), 3, dtype=torch.float64)).requires_grad_(True)
    for energy in (membrane_energy, bending_energy):
        value = energy(poses, rest, FABRIC)
        assert value.shape == (2, 3)
        assert torch.allclose(value[1, 2], energy(poses[1, 2], rest, FABRIC), rtol=1e-12)
        (force,) = torch.autograd.grad(value.sum(), poses)
        assert force.abs().sum(-1).min() > 0  # every vertex feels it
        assert force.sum(-2).abs().max() < 1e-10  # inner forces have no sum


def test_to_changes_floats_only():
    xy, faces, corners = strip(2, 2)
    rest = cloth_rest(faces, corners, len(xy), FABRIC).to(dtype=torch.float32)
    assert rest.area.dtype == torch.float32
    assert rest.faces.dtype == rest.hinges.dtype == torch.int64
    assert membrane_energy(in_space(xy).float(), rest, FABRIC).dtype == torch.float32


def test_bad_input_is_named():
    xy, faces, corners = strip(2, 2)
    with pytest.raises(GeometryError, match=r"faces must index 0\.\.7"):
        cloth_rest(faces, corners, 8, FABRIC)
    corners[3] = [[0, 0], [1, 1], [2, 2]]
    with pytest.raises(GeometryError, match="face 3 has no area"):
        cloth_rest(faces, corners, len(xy), FABRIC)
    with pytest.raises(GeometryError, match="density"):
        Fabric(density=0.0)
