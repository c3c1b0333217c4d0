"""Deliberate poses: within their ranges, mirrored, and turned evenly."""

import numpy as np
import pytest
import torch

from isp_assets.body import Body
from isp_assets.conventions import JOINT_NAMES
from isp_assets.geometry.rotations import axis_angle_to_matrix
from isp_assets.train.pose_families import (
    FAMILIES,
    PoseFamily,
    draw_family,
    family_limits,
    random_turns,
)

NAMED = {family.name: family for family in FAMILIES}


def _draw(family: PoseFamily, count: int = 400, seed: int = 0) -> torch.Tensor:
    return draw_family(family, torch.zeros(count, 24, 3), torch.Generator().manual_seed(seed))


def _joint(name: str) -> int:
    return JOINT_NAMES.index(name)


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.name)
def test_turns_fill_their_ranges_and_leave_the_other_joints_alone(family: PoseFamily) -> None:
    poses, limits = _draw(family).numpy(), family_limits(family)
    low, high = limits[..., 0], limits[..., 1]
    used = ~np.isnan(low)
    assert (poses[:, used] >= low[used] - 1e-6).all()
    assert (poses[:, used] <= high[used] + 1e-6).all()
    width = high[used] - low[used]
    assert (np.ptp(poses[:, used], axis=0) > 0.9 * width).all()
    assert (poses[:, ~used] == 0).all()


def test_other_joints_keep_the_pose_they_had() -> None:
    start = torch.randn(5, 24, 3, generator=torch.Generator().manual_seed(0))
    poses = draw_family(NAMED["stride"], start, torch.Generator().manual_seed(1))
    elbow, hip = _joint("left_elbow"), _joint("left_hip")
    assert torch.equal(poses[:, elbow], start[:, elbow])
    assert not torch.equal(poses[:, hip], start[:, hip])


@pytest.mark.parametrize("family", [f for f in FAMILIES if f.alike], ids=lambda family: family.name)
def test_sides_that_do_the_same_are_mirror_images(family: PoseFamily) -> None:
    """Mirroring the T-pose body in x and swapping sides gives the same pose, spine aside."""
    poses = _draw(family, 20)
    for joint in family.limbs:
        left, right = poses[:, _joint(f"left_{joint}")], poses[:, _joint(f"right_{joint}")]
        mirror = torch.diag(torch.tensor([-1.0, 1.0, 1.0]))
        torch.testing.assert_close(
            axis_angle_to_matrix(right), mirror @ axis_angle_to_matrix(left) @ mirror, atol=1e-5, rtol=0
        )


def test_strides_step_forward_with_either_foot() -> None:
    body = Body.load()
    posed = body.pose(_draw(NAMED["stride"], 60))
    ahead = posed.joints[:, _joint("left_ankle"), 2] - posed.joints[:, _joint("right_ankle"), 2]
    assert (ahead.abs() > 0.05).float().mean() > 0.9
    assert 0.3 < (ahead > 0).float().mean() < 0.7


def test_arms_along_the_torso_come_closer_than_a_hand_to_it() -> None:
    body = Body.load()
    posed = body.pose(_draw(NAMED["arms along the torso"], 60))
    elbow, pelvis = posed.joints[:, _joint("left_elbow")], posed.joints[:, 0]
    assert ((elbow - pelvis)[:, 0] < 0.25).float().mean() > 0.2  # the T-pose has it at about half a metre
    assert ((elbow - pelvis)[:, 1] < 0.35).all()


def test_random_turns_are_even_over_all_rotations() -> None:
    turns = random_turns(20_000, torch.Generator().manual_seed(0))
    assert turns.norm(dim=-1).max() <= np.pi + 1e-5
    up = axis_angle_to_matrix(turns)[:, :, 1]
    np.testing.assert_allclose(up.mean(0), 0, atol=0.015)  # the image of an axis is even on the sphere
    np.testing.assert_allclose(up.T @ up / len(up), np.eye(3) / 3, atol=0.01)


def test_squats_have_their_knees_apart() -> None:
    posed = Body.load().pose(_draw(NAMED["squat"], 200))
    apart = posed.joints[:, _joint("left_knee"), 0] - posed.joints[:, _joint("right_knee"), 0]
    assert (apart > 0.05).float().mean() > 0.9
