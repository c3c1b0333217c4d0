"""Flat triangles against their place in space: how far each is strained, and grading a pattern to a body.

The rest metric of a garment is that of its flat panels, graded to the body: for betas
other than zero each flat triangle is stretched as the garment's shape-skinned T-pose
stretches it, as a tailor grades a pattern. So a shirt for a large body is a larger
shirt, not a small one torn. Bending weights and masses stay those of the ungraded
pattern. Positions are in metres; functions are pure and differentiable.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from isp_assets.geometry.energy import ClothRest


def graded_rest(rest: ClothRest, canonical: Float[Tensor, "V 3"], shaped: Float[Tensor, "V 3"]) -> ClothRest:
    """The pattern graded from the mean body to another.

    Args:
        rest: The pattern as drawn.
        canonical: The garment on the mean body in T-pose.
        shaped: The garment skinned to the other shape, in T-pose.
    """
    start, shape_edges = _flat_edges(canonical[rest.faces]), _flat_edges(shaped[rest.faces])
    # Stretch from the mean body to the other, in the tangent frame of the mean garment.
    metric = shape_edges.transpose(-1, -2) @ shape_edges
    inverse = torch.linalg.inv(start)
    stretch = _root(inverse.transpose(-1, -2) @ metric @ inverse)
    # The panel lies in that frame turned by the rotation of the map panel -> garment.
    turn = _rotation(start @ rest.inverse_rest)
    graded = turn.transpose(-1, -2) @ stretch @ turn @ torch.linalg.inv(rest.inverse_rest)
    return replace(rest, inverse_rest=torch.linalg.inv(graded), area=0.5 * torch.linalg.det(graded).abs())


def face_strain(vertices: Float[Tensor, "T V 3"], rest: ClothRest) -> Float[Tensor, "T F"]:
    """Largest relative change of length in each face."""
    deformation = _flat_edges(vertices[:, rest.faces]) @ rest.inverse_rest
    metric = deformation.transpose(-1, -2) @ deformation
    middle, half = (
        0.5 * (metric[..., 0, 0] + metric[..., 1, 1]),
        0.5 * (metric[..., 0, 0] - metric[..., 1, 1]),
    )
    spread = (half.square() + metric[..., 0, 1].square()).sqrt()
    return torch.maximum((middle + spread).sqrt() - 1, 1 - (middle - spread).clamp_min(0).sqrt())


def edge_lengths(rest: ClothRest) -> Float[np.ndarray, "F 3"]:
    """Flat lengths of every face's edges, from each corner to the next [m]."""
    flat = np.linalg.inv(rest.inverse_rest.cpu().double().numpy())
    sides = np.stack([flat[..., 0], flat[..., 1] - flat[..., 0], -flat[..., 1]], axis=1)
    return np.linalg.norm(sides, axis=-1)


def edge_strain(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], lengths: Float[np.ndarray, "F 3"]
) -> Float[np.ndarray, "F 3"]:
    """Relative change of length of every face's edges (an inner edge counts twice).

    Args:
        vertices: Positions [m].
        faces: Triangles.
        lengths: Flat lengths from each corner to the next [m].
    """
    corner = vertices[faces]
    sides = np.roll(corner, -1, axis=1) - corner
    return np.sqrt(np.einsum("fkc,fkc->fk", sides, sides)) / lengths - 1


def _flat_edges(corner: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 2 2"]:
    """Two edges of each triangle (columns) in an orthonormal frame of its plane; the first lies along x."""
    first, second = corner[..., 1, :] - corner[..., 0, :], corner[..., 2, :] - corner[..., 0, :]
    length = first.norm(dim=-1).clamp_min(1e-9)
    along = (second * first).sum(-1) / length
    height = torch.linalg.cross(first, second).norm(dim=-1) / length
    rows = [torch.stack([length, along], -1), torch.stack([torch.zeros_like(length), height], -1)]
    return torch.stack(rows, -2)


def _root(matrix: Float[Tensor, "F 2 2"]) -> Float[Tensor, "F 2 2"]:
    """Square root of symmetric positive 2x2 matrices."""
    root = torch.linalg.det(matrix).clamp_min(0).sqrt()
    trace = matrix.diagonal(dim1=-2, dim2=-1).sum(-1)
    identity = torch.eye(2, dtype=matrix.dtype, device=matrix.device)
    return (matrix + root[:, None, None] * identity) / (trace + 2 * root).sqrt()[:, None, None]


def _rotation(matrix: Float[Tensor, "F 2 2"]) -> Float[Tensor, "F 2 2"]:
    """The orthogonal factor of the polar decomposition; a reflection where the determinant is negative."""
    sign = torch.linalg.det(matrix).sign()[:, None, None]
    cofactor = torch.stack(
        [
            torch.stack([matrix[:, 1, 1], -matrix[:, 1, 0]], -1),
            torch.stack([-matrix[:, 0, 1], matrix[:, 0, 0]], -1),
        ],
        -2,
    )
    total = matrix + sign * cofactor
    return total / torch.linalg.det(total).abs().sqrt()[:, None, None]
