"""How far bodies were bent in training: shapes and poses beyond it are extrapolated."""

from functools import cache

import numpy as np
import torch
from jaxtyping import Float

from isp_assets.conventions import JOINT_NAMES
from isp_assets.geometry.rotations import axis_angle_to_matrix
from isp_assets.train.poses import PoseSource, draw_poses, load_clips

_NO_CLOTH = ("head", "left_foot", "right_foot", "left_hand", "right_hand")
_DRAWN = 8000
_KEPT = 0.999


def joint_angles(poses: Float[np.ndarray, "T 24 3"]) -> Float[np.ndarray, "T 24"]:
    """Turn of every joint against its parent [degrees]; for the root, how far the body leans."""
    angles = np.degrees(np.linalg.norm(poses.astype(float), axis=2))
    upright = axis_angle_to_matrix(torch.from_numpy(poses[:, 0].astype(float)))[:, 1, 1].numpy()
    angles[:, 0] = np.degrees(np.arccos(upright.clip(-1, 1)))
    return angles


@cache
def trained_angles() -> Float[np.ndarray, " 24"]:
    """Angle of every joint that 99.9 % of training poses stay below [degrees].

    Of poses drawn as training draws them today, from the built-in motions. Networks that saw further
    motions know a little more than that, networks that were trained before less: of the built-in
    ones, the tops' have not seen squats as deep as today's. Joints that move no cloth have no limit.
    """
    clips = load_clips(PoseSource())
    poses = draw_poses(list(clips.train.values()), _DRAWN, torch.Generator().manual_seed(0))
    limit = np.quantile(joint_angles(poses.numpy()), _KEPT, axis=0)
    limit[[JOINT_NAMES.index(name) for name in _NO_CLOTH]] = np.inf
    return limit
