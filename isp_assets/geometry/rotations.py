"""Rotations: axis-angle vectors, matrices, and interpolation along the shortest arc.

An axis-angle vector is the rotation axis times the angle [rad]. Every function
is pure, batched and differentiable, also at the identity; the logarithm of a
half turn has two answers, and one of them is returned.
Quaternions (w, x, y, z) serve inside this module only.
"""

import torch
from jaxtyping import Float
from torch import Tensor

# Below this squared angle [rad²] sin(t)/t is taken from its series: three terms err by under 1e-21,
# and the direct quotient would divide zero by zero at the identity.
_SMALL_SQUARED_ANGLE = 1e-6


def axis_angle_to_matrix(axis_angle: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices by Rodrigues' formula, ``I + sin(t)/t K + (1 - cos t)/t² K²``."""
    squared = (axis_angle * axis_angle).sum(-1)
    # (1 - cos t)/t² = (sin(t/2)/(t/2))²/2: the left side cancels to nothing in float32.
    first = _sinc(squared)[..., None, None]
    second = 0.5 * _sinc(squared / 4).square()[..., None, None]
    cross = _cross_matrix(axis_angle)
    identity = torch.eye(3, dtype=axis_angle.dtype, device=axis_angle.device)
    return identity + first * cross + second * (cross @ cross)


def matrix_to_axis_angle(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Axis-angle vectors of rotation matrices, with angles in [0, pi].

    Stable at the identity and near a half turn: of the four quaternion formulas
    the one with the largest pivot is used.
    """
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = matrix.flatten(-2).unbind(-1)
    # Row k is 4 q_k (w, x, y, z); all rows are the same quaternion up to scale.
    rows = torch.stack(
        [
            torch.stack([1 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01], -1),
            torch.stack([m21 - m12, 1 + m00 - m11 - m22, m10 + m01, m02 + m20], -1),
            torch.stack([m02 - m20, m10 + m01, 1 - m00 + m11 - m22, m21 + m12], -1),
            torch.stack([m10 - m01, m02 + m20, m21 + m12, 1 - m00 - m11 + m22], -1),
        ],
        -2,
    )
    pivot = rows.diagonal(dim1=-2, dim2=-1).argmax(-1)
    index = pivot[..., None, None].expand(*pivot.shape, 1, 4)
    quaternion = rows.gather(-2, index).squeeze(-2)
    return _quaternion_to_axis_angle(quaternion / quaternion.norm(dim=-1, keepdim=True))


def slerp(
    a: Float[Tensor, "*batch 3"], b: Float[Tensor, "*batch 3"], fraction: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 3"]:
    """Rotate from ``a`` to ``b`` along the shortest arc, at constant speed.

    Args:
        a: Axis-angle vectors at fraction 0.
        b: Axis-angle vectors at fraction 1.
        fraction: Where to stop; values outside [0, 1] extrapolate.

    Returns:
        Axis-angle vectors with angles in [0, pi].
    """
    start, end = _axis_angle_to_quaternion(a), _axis_angle_to_quaternion(b)
    conjugate = start * start.new_tensor([1.0, -1.0, -1.0, -1.0])
    arc = _quaternion_to_axis_angle(_quaternion_product(conjugate, end))
    step = _axis_angle_to_quaternion(arc * fraction[..., None])
    return _quaternion_to_axis_angle(_quaternion_product(start, step))


def _sinc(squared: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """``sin(t)/t`` as a smooth function of ``t²``."""
    small = squared < _SMALL_SQUARED_ANGLE
    # The inner `where` keeps the unused branch finite: its gradient is multiplied by 0, and 0 * inf is NaN.
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    series = 1 - squared / 6 + squared.square() / 120
    return torch.where(small, series, angle.sin() / angle)


def _cross_matrix(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def _axis_angle_to_quaternion(axis_angle: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
    squared = (axis_angle * axis_angle).sum(-1, keepdim=True)
    small = squared < _SMALL_SQUARED_ANGLE
    half = torch.where(small, torch.ones_like(squared), squared).sqrt() / 2
    cosine = torch.where(small, 1 - squared / 8 + squared.square() / 384, half.cos())
    return torch.cat([cosine, 0.5 * _sinc(squared / 4) * axis_angle], -1)


def _quaternion_to_axis_angle(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3"]:
    """Logarithm of unit quaternions; ``q`` and ``-q`` are one rotation, the shorter arc is taken."""
    quaternion = torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    real, imaginary = quaternion[..., :1], quaternion[..., 1:]
    squared = (imaginary * imaginary).sum(-1, keepdim=True)
    small = squared < _SMALL_SQUARED_ANGLE
    length = torch.where(small, torch.ones_like(squared), squared).sqrt()
    # asin(s)/s with s = sin(t/2); the half turn never lands in the small branch.
    series = 1 + squared / 6 + 3 * squared.square() / 40
    scale = torch.where(small, series, torch.atan2(length, real) / length)
    return 2 * scale * imaginary


def _quaternion_product(
    a: Float[Tensor, "*batch 4"], b: Float[Tensor, "*batch 4"]
) -> Float[Tensor, "*batch 4"]:
    real_a, real_b, vector_a, vector_b = a[..., :1], b[..., :1], a[..., 1:], b[..., 1:]
    real = real_a * real_b - (vector_a * vector_b).sum(-1, keepdim=True)
    cross = torch.linalg.cross(vector_a, vector_b)
    return torch.cat([real, real_a * vector_b + real_b * vector_a + cross], -1)
