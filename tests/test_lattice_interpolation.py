"""Bicubic interpolation from a lattice."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from isp_assets.geometry.lattice_interpolation import LatticeInterpolation
from isp_assets.geometry.triangulate import triangulate_panel


def _disc(spacing: float, radius: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Points of a triangulated disc away from the origin, and which of them are on its border."""
    count = round(2 * np.pi * radius / spacing)
    turn = 2 * np.pi * np.arange(count) / count
    loop = radius * np.stack([np.cos(turn), np.sin(turn)], axis=1) + [0.2, -0.1]
    return triangulate_panel([loop], spacing)[0], np.arange(count)


def _error(step: float) -> tuple[float, LatticeInterpolation]:
    points, border = _disc(0.01)

    def wave(xy: torch.Tensor) -> torch.Tensor:
        return torch.stack([torch.sin(6 * xy[:, 0]) * torch.cos(5 * xy[:, 1]), xy[:, 0] * xy[:, 1]], 1)

    lattice = LatticeInterpolation.build(points, border, step=step)
    like = torch.zeros((), dtype=torch.float64)
    found, expected = lattice(wave, like), wave(torch.from_numpy(points))
    torch.testing.assert_close(found[border], expected[border])  # evaluated themselves
    return float((found - expected).abs().max()), lattice


def test_a_quadratic_is_reproduced_exactly():
    points, border = _disc(0.02)
    lattice = LatticeInterpolation.build(points, border, step=0.05)
    assert len(lattice.points) > len(lattice.exact)

    def quadratic(xy: torch.Tensor) -> torch.Tensor:
        x, y = xy.T
        return torch.stack([1 + x - 2 * y, x * y, x**2 - 3 * y**2], dim=1)

    found = lattice(quadratic, torch.zeros((), dtype=torch.float64))
    torch.testing.assert_close(found, quadratic(torch.from_numpy(points)))
    np.testing.assert_allclose(lattice.weights.sum(axis=1), 1)


def test_the_error_falls_with_the_third_power_of_the_step():
    coarse, fine = _error(0.08)[0], _error(0.04)[0]
    assert fine < coarse / 6


def test_a_fine_mesh_needs_few_evaluations():
    _, lattice = _error(0.05)
    assert len(lattice.places) < 0.4 * (len(lattice.points) + len(lattice.exact))


def test_a_mesh_too_small_for_the_lattice_is_evaluated_as_it_is():
    points, border = _disc(0.02, radius=0.06)
    lattice = LatticeInterpolation.build(points, border, step=0.1)
    assert len(lattice.points) == 0
    found = lattice(torch.sin, torch.zeros((), dtype=torch.float64))
    torch.testing.assert_close(found, torch.sin(torch.from_numpy(points)))


@given(st.integers(-40, 40), st.integers(-40, 40))
def test_moving_by_whole_steps_moves_the_lattice_along(right: int, up: int):
    points, border = _disc(0.03)
    shift = 0.0625 * np.array([right, up])  # a power of two: exact in floating point
    here = LatticeInterpolation.build(points, border, step=0.0625)
    there = LatticeInterpolation.build(points + shift, border, step=0.0625)
    np.testing.assert_allclose(there.places, here.places + shift, atol=1e-12)
    np.testing.assert_allclose(there.weights, here.weights, atol=1e-9)


def test_gradients_reach_the_function():
    points, border = _disc(0.05)
    lattice = LatticeInterpolation.build(points, border, step=0.1)
    assert len(lattice.points)
    factor = torch.tensor([0.7, -1.3], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda f: lattice(lambda xy: torch.sin(xy * f), f), factor)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_precision_follows_the_caller(dtype: torch.dtype):
    points, border = _disc(0.05)
    lattice = LatticeInterpolation.build(points, border, step=0.1)
    assert lattice(lambda xy: xy, torch.zeros((), dtype=dtype)).dtype == dtype
