"""What the displacement network sees of a frame: gravity, joint rotations, body shape, garment code.

The features do not change with the direction the body faces, nor with where it
stands: gravity is given in the pelvis's own frame, and the root's rotation is left out.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from isp_assets.body import PosedBody

_JOINTS = 21  # all but the root and the two hands


def pose_features(posed: PosedBody) -> Float[Tensor, "T 129"]:
    """Direction of gravity in the pelvis's frame, then two columns of ``R - I`` of joints 1 to 21."""
    root = posed.joint_transforms[:, 0, :3, :3]
    gravity = -root[:, 1, :]  # the root's inverse applied to (0, -1, 0)
    rotation = posed.pose_feature.unflatten(-1, (-1, 3, 3))[:, :_JOINTS, :, :2]
    return torch.cat([gravity, rotation.flatten(1)], -1)


def drape_features(
    posed: PosedBody, betas: Float[Tensor, "*frames B"], code: Float[Tensor, " Z"], *, num_betas: int
) -> Float[Tensor, "T F"]:
    """The whole input of the displacement network.

    Args:
        posed: The body over T frames.
        betas: Shape coefficients, ``[B]`` or ``[T, B]``; missing ones count as zero.
        code: The garment's latent code.
        num_betas: Coefficients that the network was made for.
    """
    pose = pose_features(posed)
    frames = len(pose)
    shape = pose.new_zeros(frames, num_betas)
    known = min(num_betas, betas.shape[-1])
    shape[:, :known] = betas[..., :known].to(pose)
    return torch.cat([pose, shape, code.to(pose).expand(frames, -1)], -1)
