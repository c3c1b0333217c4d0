"""The stress poses are what they claim, measured on the posed joints."""

import numpy as np
import pytest
import torch

from isp_assets.body import Body
from isp_assets.conventions import JOINT_NAMES
from isp_assets.evaluate import stress_motions as motions
from isp_assets.geometry.rotations import axis_angle_to_matrix
from isp_assets.motion import Motion
from isp_assets.train.leg_ik import Figure


@pytest.fixture(scope="module")
def body():
    return Body.load()


@pytest.fixture(scope="module")
def figure(body):
    return Figure.of(body)


def joints_of(body: Body, motion: Motion) -> dict[str, np.ndarray]:
    posed = body.to(dtype=torch.float64).pose(
        torch.from_numpy(motion.poses).double(), translation=torch.from_numpy(motion.translation).double()
    )
    return {name: posed.joints[:, k].numpy() for k, name in enumerate(JOINT_NAMES)}


def test_arms_have_their_angle_from_straight_down(body, figure):
    angles = [40.0, 15.0, 0.0, -30.0]
    joints = joints_of(body, motions.arms_swept(figure, angles))
    for side, out in (("left", 1), ("right", -1)):
        arm = joints[f"{side}_elbow"] - joints[f"{side}_shoulder"]
        np.testing.assert_allclose(np.degrees(np.arctan2(out * arm[:, 0], -arm[:, 1])), angles, atol=1e-4)
        np.testing.assert_allclose(arm[:, 2], 0, atol=1e-6)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_wrists_turn_by_their_angle_and_mirrored(body, figure, axis):
    motion = motions.wrists_turned(figure, [-80.0, 0.0, 40.0], axis)
    turned = motion.poses[:, JOINT_NAMES.index("left_wrist")]
    np.testing.assert_allclose(
        np.degrees(turned["xyz".index(axis) == np.arange(3)[None].repeat(3, 0)]), [-80, 0, 40]
    )
    joints = joints_of(body, motion)
    np.testing.assert_allclose(joints["left_hand"] * [-1, 1, 1], joints["right_hand"], atol=1e-3)


def test_hands_on_hips_have_their_distance_and_elbows_out(body, figure):
    distances = [34.0, 20.0, 10.0]
    joints = joints_of(body, motions.hands_on_hips(figure, distances))
    for side, out in (("left", 1), ("right", -1)):
        np.testing.assert_allclose(100 * out * joints[f"{side}_wrist"][:, 0], distances, atol=1e-3)
        assert (out * joints[f"{side}_elbow"][1:, 0] > out * joints[f"{side}_wrist"][1:, 0]).all()
    waist = figure.joints[JOINT_NAMES.index("spine1"), 1]
    np.testing.assert_allclose(joints["left_wrist"][:, 1], waist - 0.02, atol=1e-5)


def test_a_point_out_of_reach_is_approached_in_its_direction(body, figure):
    pose = np.zeros((24, 3))
    far = np.array([0.3, 5.0, 0.4])
    motions.reach_with_arm(figure, "left", pose, far, np.array([1.0, 0.0, 0.0]))
    joints = joints_of(body, Motion(pose[None], np.zeros((1, 3)), fps=30))
    arm, way = (p - joints["left_shoulder"][0] for p in (joints["left_wrist"][0], far))
    assert arm @ way == pytest.approx(np.linalg.norm(arm) * np.linalg.norm(way), rel=1e-6)


def test_crossing_starts_hanging_and_ends_crossed():
    clip = Motion.load("arms_crossed")
    made = motions.arms_crossed([0.0, 0.5, 1.0])
    middle = len(clip) // 2
    for pose, expected in ((made.poses[0], clip.poses[0]), (made.poses[2], clip.poses[middle])):
        matrices = (axis_angle_to_matrix(torch.from_numpy(p).double()) for p in (pose, expected))
        torch.testing.assert_close(*matrices, atol=1e-5, rtol=0)


def test_squats_have_their_depth_with_the_feet_where_they_were(body, figure):
    depths = [10.0, 30.0, 50.0]
    joints = joints_of(body, motions.deep_squat(figure, depths))
    pelvis = 100 * (figure.standing[1] - joints["pelvis"][:, 1])
    np.testing.assert_allclose(pelvis, np.array(depths) + 0.5, atol=0.1)
    np.testing.assert_allclose(np.ptp(joints["left_ankle"], axis=0), 0, atol=2e-3)


def test_deep_squats_have_knees_over_toes_and_hips_that_bend_no_further_than_a_body_can(body, figure):
    motion = motions.deep_squat(figure, [20.0, 40.0, 65.0])
    joints = joints_of(body, motion)

    def apart(name):
        return joints[f"left_{name}"][:, 0] - joints[f"right_{name}"][:, 0]

    assert (apart("knee") > apart("ankle")).all()
    for side in ("left", "right"):
        flexion = np.degrees(np.linalg.norm(motion.poses[:, JOINT_NAMES.index(f"{side}_hip")], axis=1))
        assert flexion.max() < 155


@pytest.mark.parametrize(("rule", "axis"), [(motions.stride, 2), (motions.split, 0)])
def test_legs_have_their_angle_and_straight_knees(body, figure, rule, axis):
    angles = [0.0, 45.0, 90.0]
    motion = rule(figure, angles)
    joints = joints_of(body, motion)
    tilt = {}
    for side in ("left", "right"):
        leg = joints[f"{side}_ankle"] - joints[f"{side}_hip"]
        tilt[side] = np.degrees(np.arctan2(leg[:, axis], -leg[:, 1]))
    np.testing.assert_allclose(tilt["left"] - tilt["right"], angles, atol=1e-4)
    np.testing.assert_allclose(tilt["left"], -tilt["right"], atol=1e-4)
    assert np.abs(motion.poses[:, JOINT_NAMES.index("left_knee")]).max() == 0


def test_rolling_takes_the_body_onto_its_face_and_its_back(body, figure):
    joints = joints_of(body, motions.rolled(figure, [0.0, 90.0, -90.0, 0.5]))
    spine = joints["neck"] - joints["pelvis"]
    upright, length = spine[0], np.linalg.norm(spine[0])
    np.testing.assert_allclose(spine[1], [upright[0], -upright[2], upright[1]], atol=1e-6)
    np.testing.assert_allclose(spine[2], [upright[0], upright[2], -upright[1]], atol=1e-6)
    assert np.degrees(np.arccos(spine[0] @ spine[3] / length**2)) == pytest.approx(0.5, abs=1e-3)


def test_turning_keeps_the_height_of_every_joint(body, figure):
    joints = joints_of(body, motions.turned_on_the_spot(figure, [0.0, 90.0]))
    for name, points in joints.items():
        assert points[0, 1] == pytest.approx(points[1, 1]), name
    ahead = joints["left_foot"] - joints["left_ankle"]
    np.testing.assert_allclose(ahead[1, [0, 2]], [ahead[0, 2], -ahead[0, 0]], atol=1e-6)


def test_noise_keeps_within_its_amplitude_and_is_the_same_every_time():
    clip = Motion.load("walk")
    sizes = [0.05] * 40 + [0.4] * 40
    made = [motions.noisy(clip, frame=3, amplitudes=sizes, seed=5) for _ in range(2)]
    np.testing.assert_array_equal(made[0].poses, made[1].poses)
    off = np.degrees(np.abs(made[0].poses - clip.poses[3]))
    assert 0.045 < off[:40].max() <= 0.0501
    assert 0.37 < off[40:].max() <= 0.4001
    assert off[:, -2:].max() == 0
