"""Body poses to train on: frames of motions, blended and disturbed; deliberate poses; any heading and tilt.

Captured motion holds few arms along the torso, few wide steps and no lying bodies, so a
share of the poses is drawn from `pose_families`, and a share is turned over as a whole.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from isp_assets.conventions import NUM_JOINTS
from isp_assets.errors import TrainError
from isp_assets.geometry.rotations import slerp
from isp_assets.motion import Motion, builtin_motions
from isp_assets.train.pose_families import FAMILIES, draw_family, random_turns

BETA_RANGE = 2.0
"""Shape coefficients in training lie within this of 0."""

_NOISE = 0.05  # of every joint [rad]
_LARGEST_BLEND = 0.5
_FAMILY_SHARE = 0.35  # of the poses
_TUMBLED_SHARE = 0.1  # of the poses: lying, rolled, upside down


@dataclass(frozen=True)
class PoseSource:
    """Which motions to learn from, and which to keep for the test."""

    folder: Path | None = None
    """Further motions: every ``.npz`` of this folder."""
    held_out: tuple[str, ...] = ()
    """Names of motions that are kept for the test as a whole."""
    held_tails: dict[str, float] = field(default_factory=lambda: {"walk": 0.33})
    """Share at the end of a motion that is kept for the test."""


@dataclass(frozen=True, eq=False)
class Clips:
    """Frames to train on and frames to test on, by motion."""

    train: dict[str, Float[np.ndarray, "_ 24 3"]]
    test: dict[str, Float[np.ndarray, "_ 24 3"]]


def load_clips(source: PoseSource) -> Clips:
    """Read the built-in motions and those of a folder.

    Raises:
        MotionError: If a file is no motion.
        TrainError: If a motion named as held out does not exist, or nothing is left to train on.
    """
    motions = [Motion.load(name) for name in builtin_motions()]
    if source.folder is not None:
        motions += [Motion.load(path) for path in sorted(Path(source.folder).glob("*.npz"))]
    names = {motion.name for motion in motions}
    if missing := set(source.held_out) - names:
        raise TrainError(f"held-out motions {sorted(missing)} do not exist; there are {sorted(names)}")
    clips = Clips({}, {})
    for motion in motions:
        if motion.name in source.held_out:
            clips.test[motion.name] = motion.poses
            continue
        cut = round(len(motion) * (1 - source.held_tails.get(motion.name, 0.0)))
        clips.train[motion.name] = motion.poses[:cut]
        if cut < len(motion):
            clips.test[motion.name] = motion.poses[cut:]
    if not clips.train:
        raise TrainError("every motion is held out; leave some to train on")
    return clips


def draw_poses(
    clips: Sequence[Float[np.ndarray, "_ 24 3"]], count: int, generator: torch.Generator
) -> Float[Tensor, "count 24 3"]:
    """Random poses [rad]; every motion is as likely as any other, however long."""
    first, second = _frames(clips, count, generator), _frames(clips, count, generator)
    blend = _LARGEST_BLEND * torch.rand(count, 1, generator=generator)
    second[:, 0] = first[:, 0]  # a blend of two headings would lean the body
    poses = slerp(first, second, blend.expand(-1, NUM_JOINTS))
    poses = poses + _NOISE * torch.randn(poses.shape, generator=generator)
    poses = _deliberate(poses, generator)
    tumbled = torch.rand(count, generator=generator) < _TUMBLED_SHARE
    poses[:, 0] = torch.where(tumbled[:, None], random_turns(count, generator), poses[:, 0])
    poses[:, -2:] = 0  # hands
    return poses


def _deliberate(poses: Float[Tensor, "n 24 3"], generator: torch.Generator) -> Float[Tensor, "n 24 3"]:
    """Some of the poses carried part or all of the way to a pose of a family."""
    count = len(poses)
    chosen = torch.rand(count, generator=generator) < _FAMILY_SHARE
    weights = torch.tensor([family.weight for family in FAMILIES])
    which = torch.multinomial(weights, count, replacement=True, generator=generator)
    share = torch.rand(count, 1, generator=generator).sqrt()  # rather far than near
    result = poses.clone()
    for number, family in enumerate(FAMILIES):
        rows = (chosen & (which == number)).nonzero()[:, 0]
        goal = draw_family(family, poses[rows], generator)
        result[rows] = slerp(poses[rows], goal, share[rows].expand(-1, NUM_JOINTS))
    return result


def _frames(clips: Sequence[np.ndarray], count: int, generator: torch.Generator) -> Tensor:
    clip = torch.randint(len(clips), (count,), generator=generator)
    place = torch.rand(count, generator=generator)
    rows = [clips[int(c)][int(p * len(clips[int(c)]))] for c, p in zip(clip, place, strict=True)]
    return torch.tensor(np.stack(rows), dtype=torch.float32)
