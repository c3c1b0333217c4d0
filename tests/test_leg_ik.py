"""The bent leg reaches its target, and the foot rolls without slipping."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from isp_assets.body import Body
from isp_assets.train.leg_ik import LEGS, Figure, FootPlacement, ankle_of, bend_leg, turn


@pytest.fixture(scope="module")
def body():
    return Body.load()


@pytest.fixture(scope="module")
def figure(body):
    return Figure.of(body)


@settings(max_examples=30, deadline=None)
@given(st.sampled_from(["left", "right"]), st.booleans(), st.integers(0, 10**6))
def test_ankle_and_foot_arrive_where_they_should(body, figure, side, aimed, seed):
    rng = np.random.default_rng(seed)
    root = Rotation.from_rotvec(0.4 * rng.normal(size=3)).as_matrix()
    foot = Rotation.from_rotvec(0.4 * rng.normal(size=3)).as_matrix()
    pelvis = figure.standing + 0.1 * rng.normal(size=3)
    hip, knee, ankle, _ = LEGS[side]
    reach = rng.uniform(0.35, 0.78)  # the leg is 0.81 m long
    direction = np.array([0.3 * rng.normal(), -1, 0.5 * rng.normal()])
    socket = pelvis + root @ (figure.joints[hip] - figure.joints[0])
    target = socket + reach * direction / np.linalg.norm(direction)
    pose = np.zeros((24, 3))
    goal = target + np.array([0.2 * rng.normal(), 0.4, 0.3]) if aimed else None
    bend_leg(figure, side, pose, (pelvis, root), (target, foot), knee_towards=goal)
    pose[0] = Rotation.from_matrix(root).as_rotvec()
    translation = torch.from_numpy(pelvis - figure.joints[0]).float()[None]
    posed = body.pose(torch.from_numpy(pose).float()[None], translation=translation)
    np.testing.assert_allclose(posed.joints[0, ankle], target, atol=1e-5)
    np.testing.assert_allclose(posed.joint_transforms[0, ankle, :3, :3], foot, atol=1e-5)
    assert pose[knee, 0] > 0, "a knee bends one way"
    if aimed:
        axis = (target - socket) / reach
        thigh = posed.joints[0, knee].double().numpy() - socket
        bent, asked = (v - (v @ axis) * axis for v in (thigh, goal - socket))
        np.testing.assert_allclose(bent / np.linalg.norm(bent), asked / np.linalg.norm(asked), atol=1e-3)


def test_target_out_of_reach_gives_an_almost_straight_leg(figure):
    pose = np.zeros((24, 3))
    far = figure.standing - [0, 2.0, 0]
    bend_leg(figure, "left", pose, (figure.standing, np.eye(3)), (far, np.eye(3)))
    assert np.isfinite(pose).all()
    assert abs(pose[4, 0]) < 0.15


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize(("pitch", "contact"), [(0.2, "heel"), (-0.6, "ball")])
def test_rolling_foot_turns_about_its_point_of_contact(figure, side, pitch, contact):
    _, _, ankle, ball = LEGS[side]
    resting = figure.joints[ball] * [1, 0, 1] + [0, figure.floor, 0]
    point = figure.heels[side] if contact == "heel" else resting

    def where(pitch):
        placement = FootPlacement(np.array([0.1, 0, 0.5]), 0.3, pitch, lift=0.0, toe_bend=0.0)
        position, rotation = ankle_of(figure, side, placement)
        return position + rotation @ (point - figure.joints[ankle])

    np.testing.assert_allclose(where(pitch), where(0.0), atol=1e-12)
    assert where(pitch)[1] == pytest.approx(0, abs=1e-12)


def test_turn_is_right_handed():
    np.testing.assert_allclose(turn("y", np.pi / 2) @ [0, 0, 1], [1, 0, 0], atol=1e-15)
