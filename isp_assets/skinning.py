"""Skinning a garment with the body: bind once, then a few matrix products a frame.

Skinning is linear in the body's weights and blend shapes, so the diffused weights
``w(v)`` over thousands of body vertices are folded into 24 joint weights and a few
hundred projected directions a vertex, with no loss (Eqs. 6-7).

Positions are in metres. "Canonical" space is the T-pose of the mean body, before
blend shapes; it is found by skinning the rest shape backwards, exactly.

Reference: Li, Guillard and Fua, "ISP: Multi-Layered Garment Draping with
Implicit Sewing Patterns", NeurIPS 2023, Eqs. 6-7.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from isp_assets.body import Body, PosedBody
from isp_assets.errors import DrapeError
from isp_assets.garment import Garment
from isp_assets.networks.skin_field import SkinField

_CHUNK = 512  # garment vertices whose weights over all body vertices are held at once
_ITERATIONS = 12


@dataclass(frozen=True, eq=False)
class BoundGarment:
    """A garment of V vertices, ready to be skinned."""

    canonical: Float[Tensor, "V 3"]
    """Positions in canonical space [m]."""
    joint_weights: Float[Tensor, "V 24"]
    shape_dirs: Float[Tensor, "V 3 B"]
    """Displacement [m] per unit of each shape coefficient."""
    pose_dirs: Float[Tensor, "V 3 207"]
    """Displacement [m] per unit of each pose feature."""

    def to(
        self, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> "BoundGarment":
        """A copy on another device or in another floating type."""
        return replace(self, **{k: v.to(device=device, dtype=dtype) for k, v in vars(self).items()})


def bind(garment: Garment, body: Body, skin: SkinField) -> BoundGarment:
    """Fold the diffused weights of a garment's vertices and undo its rest pose.

    A rest pose that the field was trained on takes one exact step. Any other is
    unposed by fixed-point iteration: weights of the present estimate in the field's
    first rest pose, inverse skinning, again. That holds as long as the garment
    lies nearer to its own limb than to another in that pose.

    Raises:
        DrapeError: If the field belongs to a body with another number of vertices.
    """
    if skin.config.num_vertices != len(body.template):
        raise DrapeError(
            f"garment {garment.name!r}: the skin field is for a body of {skin.config.num_vertices} vertices, "
            f"body {body.name!r} has {len(body.template)}; train one with: isp-assets train skin"
        )
    like = body.template
    vertices = torch.as_tensor(garment.rest_vertices).to(like)
    rest_pose = torch.as_tensor(garment.rest_pose).to(like)
    rest = body.pose(rest_pose[None])
    known = torch.tensor(skin.config.rest_poses).to(like).unflatten(1, rest_pose.shape)
    mismatch = (known - rest_pose).abs().amax((1, 2))
    if float(mismatch.min()) < 1e-4:
        return _unpose(vertices, rest, _fold(vertices, body, skin, int(mismatch.argmin())))
    first = body.pose(known[:1])
    points = vertices
    for _ in range(_ITERATIONS):
        bound = _unpose(vertices, rest, _fold(points, body, skin, 0))
        points = skin_garment(bound, first)[0][0]
    return bound


def skin_garment(
    bound: BoundGarment, posed: PosedBody, betas: Float[Tensor, "*frames K"] | None = None
) -> tuple[Float[Tensor, "T V 3"], Float[Tensor, "T V 3 3"]]:
    """Skin a garment over T frames (Eq. 6).

    Args:
        bound: The bound garment.
        posed: The body in those frames.
        betas: The shape coefficients ``posed`` was made with, ``[K]`` or ``[T, K]``; None for zeros.

    Returns:
        World positions [m], and the blended linear part of each vertex's skinning transform.
    """
    corrected = shape_garment(bound, betas) + _pose_offset(bound, posed)
    blended = _blend(bound, posed)
    linear = blended[..., :3]
    return (linear @ corrected[..., None]).squeeze(-1) + blended[..., 3], linear


def shape_garment(
    bound: BoundGarment, betas: Float[Tensor, "*frames K"] | None
) -> Float[Tensor, "*frames V 3"]:
    """The garment in canonical space on a body of another shape [m]."""
    if betas is None:
        return bound.canonical
    directions = bound.shape_dirs[..., : betas.shape[-1]].flatten(0, 1)
    return bound.canonical + (betas.to(directions) @ directions.T).unflatten(-1, (-1, 3))


def _pose_offset(bound: BoundGarment, posed: PosedBody) -> Float[Tensor, "T V 3"]:
    return (posed.pose_feature @ bound.pose_dirs.flatten(0, 1).T).unflatten(-1, (-1, 3))


def _blend(bound: BoundGarment, posed: PosedBody) -> Float[Tensor, "T V 3 4"]:
    return (bound.joint_weights @ posed.joint_transforms[..., :3, :].flatten(-2)).unflatten(-1, (3, 4))


@torch.no_grad()
def _fold(points: Float[Tensor, "V 3"], body: Body, skin: SkinField, rest: int) -> BoundGarment:
    """Project the body's weights and blend shapes to points; their canonical positions are not yet known."""
    count = body.shape_dirs.shape[-1]
    every = torch.cat([body.weights, body.shape_dirs.flatten(1), body.pose_dirs.flatten(1)], 1)
    folded = torch.cat([skin(part, rest=rest) @ every for part in points.split(_CHUNK)])
    joints, shape, pose = folded.split([body.weights.shape[1], 3 * count, 3 * body.pose_dirs.shape[-1]], 1)
    return BoundGarment(points, joints, shape.unflatten(1, (3, count)), pose.unflatten(1, (3, -1)))


def _unpose(vertices: Float[Tensor, "V 3"], rest: PosedBody, bound: BoundGarment) -> BoundGarment:
    """Canonical positions that skinning takes to ``vertices`` in the rest pose."""
    blended = _blend(bound, rest)[0].double()
    moved = (vertices.double() - blended[..., 3])[..., None]
    corrected = torch.linalg.solve(blended[..., :3], moved).squeeze(-1).to(vertices)
    return replace(bound, canonical=corrected - _pose_offset(bound, rest)[0])
