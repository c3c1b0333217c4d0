"""Rotations are rotations, invert one another, and stay smooth at the identity."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from isp_assets.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle, slerp

MAGNITUDES = [0.0, 1e-12, 1e-7, 9.9e-4, 1.01e-3, 0.1, 1.0, 3.0, math.pi - 1e-6, math.pi - 1e-9]
numbers = st.floats(-1.8, 1.8, allow_subnormal=False)  # torch flushes subnormal numbers to zero in tests
vectors = st.lists(numbers, min_size=3, max_size=3).map(lambda v: torch.tensor(v, dtype=torch.float64))


def directions(count, seed=0):
    points = torch.randn(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return points / points.norm(dim=-1, keepdim=True)


@pytest.mark.parametrize("magnitude", [*MAGNITUDES, 4.0, 7.0])
def test_matrix_equals_scipy(magnitude):
    axis_angle = magnitude * directions(20)
    expected = Rotation.from_rotvec(axis_angle.numpy()).as_matrix()
    np.testing.assert_allclose(axis_angle_to_matrix(axis_angle), expected, atol=1e-14)


@pytest.mark.parametrize("magnitude", [0.0, 1e-6, 1e-3, 1e-2, 1.0, 3.1])
def test_matrix_is_accurate_in_single_precision(magnitude):
    axis_angle = (magnitude * directions(50)).float()
    exact = Rotation.from_rotvec(axis_angle.double().numpy()).as_matrix()
    np.testing.assert_allclose(axis_angle_to_matrix(axis_angle), exact, atol=4e-7)


@pytest.mark.parametrize("magnitude", MAGNITUDES)
def test_logarithm_inverts_exponential(magnitude):
    axis_angle = magnitude * directions(200)
    back = matrix_to_axis_angle(axis_angle_to_matrix(axis_angle))
    # A matrix fixes its rotation angle to rounding, near a half turn as well.
    torch.testing.assert_close(back, axis_angle, rtol=0, atol=1e-14 if magnitude < 1e-2 else 5e-15 / 1e-3)


def test_half_turn_keeps_its_axis():
    axes = torch.cat([torch.eye(3, dtype=torch.float64), directions(50)])
    back = matrix_to_axis_angle(2 * axes[:, :, None] * axes[:, None, :] - torch.eye(3, dtype=torch.float64))
    torch.testing.assert_close(back.norm(dim=-1), torch.full((53,), math.pi, dtype=torch.float64))
    torch.testing.assert_close((back / math.pi * axes).sum(-1).abs(), torch.ones(53, dtype=torch.float64))


@given(vectors)
def test_product_of_opposite_rotations_is_the_identity(vector):
    product = axis_angle_to_matrix(vector) @ axis_angle_to_matrix(-vector)
    torch.testing.assert_close(product, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-14)


@given(vectors, vectors)
def test_conjugation_rotates_the_axis(vector, frame):
    turn = axis_angle_to_matrix(frame)
    conjugated = turn @ axis_angle_to_matrix(vector) @ turn.T
    torch.testing.assert_close(conjugated, axis_angle_to_matrix(turn @ vector), rtol=0, atol=1e-13)


@pytest.mark.parametrize("magnitude", [0.0, 1e-5, 9e-4, 1.1e-3, 0.5, 3.0])
def test_gradients(magnitude):
    vector = (magnitude * directions(3, seed=1)).requires_grad_()
    assert torch.autograd.gradcheck(axis_angle_to_matrix, vector)
    assert torch.autograd.gradcheck(lambda x: matrix_to_axis_angle(axis_angle_to_matrix(x)), vector)
    assert torch.autograd.gradgradcheck(axis_angle_to_matrix, vector)


def test_derivative_at_identity_is_the_cross_matrix():
    jacobian = torch.autograd.functional.jacobian(axis_angle_to_matrix, torch.zeros(3))
    levi_civita = torch.zeros(3, 3, 3)
    for i, j, k in [(0, 1, 2), (1, 2, 0), (2, 0, 1)]:
        levi_civita[i, j, k], levi_civita[i, k, j] = -1, 1
    torch.testing.assert_close(jacobian, levi_civita)


def test_slerp_ends_and_constant_speed():
    a, b = 1.2 * directions(40, seed=2), 1.5 * directions(40, seed=3)
    fractions = torch.linspace(0, 1, 5, dtype=torch.float64)
    path = torch.stack([axis_angle_to_matrix(slerp(a, b, f.expand(40))) for f in fractions])
    torch.testing.assert_close(path[0], axis_angle_to_matrix(a))
    torch.testing.assert_close(path[-1], axis_angle_to_matrix(b))
    steps = matrix_to_axis_angle(path[:-1].transpose(-1, -2) @ path[1:]).norm(dim=-1)
    torch.testing.assert_close(steps, steps[:1].expand_as(steps))
    whole = matrix_to_axis_angle(axis_angle_to_matrix(a).mT @ axis_angle_to_matrix(b)).norm(dim=-1)
    torch.testing.assert_close(4 * steps[0], whole)


def test_slerp_takes_the_short_way_round():
    degrees = math.pi / 180
    a = torch.tensor([[0.0, 170 * degrees, 0.0]], dtype=torch.float64)
    b = torch.tensor([[0.0, -170 * degrees, 0.0]], dtype=torch.float64)
    middle = slerp(a, b, torch.tensor([0.25], dtype=torch.float64))
    torch.testing.assert_close(middle, torch.tensor([[0.0, 175 * degrees, 0.0]], dtype=torch.float64))


def test_slerp_of_equal_rotations_stays_put_and_has_gradients():
    a = (0.7 * directions(3)).requires_grad_()
    b = a.detach().clone().requires_grad_()
    fraction = torch.tensor([0.0, 0.3, 1.0], dtype=torch.float64, requires_grad=True)
    torch.testing.assert_close(slerp(a, b, fraction), a)
    assert torch.autograd.gradcheck(slerp, (a, b, fraction))


def test_batches_equal_single_calls():
    vectors = 2 * directions(6).reshape(2, 3, 3)
    batched = axis_angle_to_matrix(vectors)
    for i in range(2):
        for j in range(3):
            torch.testing.assert_close(batched[i, j], axis_angle_to_matrix(vectors[i, j]))
            torch.testing.assert_close(
                matrix_to_axis_angle(batched)[i, j], matrix_to_axis_angle(batched[i, j])
            )
