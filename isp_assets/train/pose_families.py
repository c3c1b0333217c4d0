"""Poses by what the body does: arms along the torso, crossed arms, squats, strides, any limb anywhere.

Captured motion holds few of these, and networks trained on it alone fail there. A
family gives a range of turns to joints; a pose is drawn uniformly from the ranges.
Ranges are rotation vectors in degrees, for the left side in SMPL's T-pose axes
(x left, y up, z forward); the right side is the mirror image.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from isp_assets.conventions import JOINT_NAMES, NUM_JOINTS

Range = tuple[int, int]
Ranges = tuple[Range, Range, Range]

_MIRROR = torch.tensor([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class PoseFamily:
    """Ranges of the joints that a family sets; it leaves the others alone."""

    name: str
    limbs: dict[str, Ranges]
    """By joint without its side; drawn for both sides."""
    spine: dict[str, Ranges]
    alike: bool = False
    """Both sides get the same turns, mirrored."""
    lagging: dict[str, Ranges] | None = None
    """Ranges of the other side, where a family is lopsided; which side that is is drawn."""
    weight: float = 1.0
    """How often it is drawn, relative to the others."""


FAMILIES = (
    PoseFamily(
        "arms along the torso",
        limbs={
            "collar": ((-4, 4), (-6, 6), (-18, 4)), "shoulder": ((-45, 45), (-35, 25), (-105, -50)),
            "elbow": ((-20, 20), (-95, 0), (-10, 10)), "wrist": ((-60, 60), (-25, 25), (-60, 60)),
        },
        spine={"spine1": ((-5, 15), (-12, 12), (-8, 8)), "spine3": ((-5, 10), (-10, 10), (-6, 6))},
    ),
    PoseFamily(
        "hands on the hips",
        limbs={
            "collar": ((-4, 4), (-6, 6), (-8, 10)), "shoulder": ((-35, 10), (-10, 40), (-70, -35)),
            "elbow": ((-15, 15), (-125, -70), (-10, 20)), "wrist": ((-80, 80), (-30, 30), (-60, 60)),
        },
        spine={"spine2": ((-6, 6), (-12, 12), (-10, 10))},
        alike=True,
    ),
    PoseFamily(
        "crossed arms",
        limbs={
            "collar": ((-4, 6), (-14, 4), (-12, 4)), "shoulder": ((-5, 40), (-95, -50), (-75, -35)),
            "elbow": ((-15, 15), (-105, -50), (-15, 15)), "wrist": ((-20, 20), (-30, 20), (-30, 20)),
        },
        spine={"spine1": ((-5, 20), (-8, 8), (-6, 6))},
    ),
    PoseFamily(
        "squat",
        limbs={
            "hip": ((-150, -20), (-25, 30), (0, 40)), "knee": ((10, 150), (-5, 5), (-5, 5)),
            "ankle": ((-40, 10), (-8, 15), (-25, 8)), "shoulder": ((-30, 30), (-90, 10), (-80, 0)),
        },
        spine={"spine1": ((-5, 30), (-10, 10), (-8, 8)), "spine2": ((-5, 28), (-8, 8), (-6, 6))},
        alike=True,
        weight=2.0,
    ),
    PoseFamily(
        "stride",
        limbs={"hip": ((-90, -10), (-10, 10), (-5, 15)), "knee": ((0, 70), (-4, 4), (-4, 4))},
        lagging={"hip": ((5, 45), (-10, 10), (-5, 15)), "knee": ((0, 60), (-4, 4), (-4, 4))},
        spine={"spine1": ((-8, 15), (-15, 15), (-8, 8))},
    ),
    PoseFamily(
        "straddle",
        limbs={"hip": ((-35, 15), (-20, 20), (0, 50)), "knee": ((0, 50), (-4, 4), (-4, 4))},
        spine={"spine1": ((-8, 20), (-12, 12), (-15, 15))},
    ),
    PoseFamily(
        "arms anywhere",
        limbs={
            "collar": ((-6, 6), (-12, 12), (-15, 20)), "shoulder": ((-60, 60), (-90, 50), (-100, 75)),
            "elbow": ((-30, 30), (-130, 0), (-20, 20)), "wrist": ((-80, 80), (-30, 30), (-70, 70)),
        },
        spine={
            "spine1": ((-15, 30), (-20, 20), (-15, 15)), "spine2": ((-10, 20), (-15, 15), (-12, 12)),
            "spine3": ((-8, 15), (-12, 12), (-10, 10)),
        },
    ),
)  # fmt: skip


def draw_family(
    family: PoseFamily, poses: Float[Tensor, "n 24 3"], generator: torch.Generator
) -> Float[Tensor, "n 24 3"]:
    """Poses with the family's joints set [rad]; the other joints stay as they are.

    Args:
        family: What to do.
        poses: Poses to start from [rad].
        generator: Draws the turns.
    """
    result, count = poses.clone(), len(poses)
    for joint, ranges in family.spine.items():
        result[:, JOINT_NAMES.index(joint)] = _turns(ranges, count, generator)
    swapped = torch.rand(count, 1, generator=generator) < 0.5
    for joint, ranges in family.limbs.items():
        first = _turns(ranges, count, generator)
        other = first if family.alike else _turns((family.lagging or family.limbs)[joint], count, generator)
        left, right = torch.where(swapped, other, first), torch.where(swapped, first, other)
        result[:, JOINT_NAMES.index(f"left_{joint}")] = left
        result[:, JOINT_NAMES.index(f"right_{joint}")] = right * _MIRROR
    return result


def random_turns(count: int, generator: torch.Generator) -> Float[Tensor, "n 3"]:
    """Rotation vectors spread evenly over all rotations [rad]: standing, lying, upside down."""
    quaternion = torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1)
    quaternion = torch.where(quaternion[:, :1] < 0, -quaternion, quaternion)
    sine = quaternion[:, 1:].norm(dim=-1, keepdim=True).clamp_min(1e-9)
    return quaternion[:, 1:] / sine * 2 * torch.atan2(sine, quaternion[:, :1])


def family_limits(family: PoseFamily) -> Float[np.ndarray, "24 3 2"]:
    """Lowest and highest turn of every joint that the family sets [rad]; NaN for the others."""
    limits = np.full((NUM_JOINTS, 3, 2), np.nan)
    for joint, ranges in family.spine.items():
        limits[JOINT_NAMES.index(joint)] = np.radians(ranges)
    for joint, ranges in family.limbs.items():
        both = np.radians([ranges, (family.lagging or family.limbs)[joint]])
        left = np.stack([both[..., 0].min(0), both[..., 1].max(0)], axis=-1)
        limits[JOINT_NAMES.index(f"left_{joint}")] = left
        mirrored = left * np.array([1.0, -1.0, -1.0])[:, None]
        limits[JOINT_NAMES.index(f"right_{joint}")] = np.sort(mirrored, axis=-1)
    return limits


def _turns(ranges: Ranges, count: int, generator: torch.Generator) -> Float[Tensor, "n 3"]:
    low, high = torch.tensor(ranges).deg2rad().unbind(-1)
    return low + (high - low) * torch.rand(count, 3, generator=generator)
