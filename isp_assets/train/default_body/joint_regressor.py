"""The joint regressor: every joint as a mixture of a few skin vertices.

Rows are sparse, not negative, and sum to 1, so a joint stays inside the body
whatever its shape.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import nnls

from isp_assets.conventions import JOINT_PARENTS, NUM_JOINTS
from isp_assets.train.default_body.rig import FLIP, MIRROR
from isp_assets.train.default_body.topology import Topology

_MIDLINE_JOINTS = (0, 3, 6, 9, 12, 15)
_REGRESSOR_PEOPLE = 160
_SUM_WEIGHT = 30.0  # how firmly a regressor row is made to sum to 1
_EVENNESS = 2e-2  # keeps a regressor row spread over a dozen vertices or more


def fit_joint_regressor(
    people: Float[np.ndarray, "P V 3"],
    joints: Float[np.ndarray, "P 24 3"],
    weights: Float[np.ndarray, "V 24"],
    topology: Topology,
    generator: np.random.Generator,
) -> Float[np.ndarray, "24 V"]:
    """Fit one row a joint over a population; left and right mirror one another.

    Args:
        people: Symmetric T-posed people [m].
        joints: Their joints [m].
        weights: Skin weights, which say which vertices lie about a joint.
        topology: Gives the mirror images.
        generator: Draws the people that each row is fitted to.
    """
    mean, mean_joints, mirror = people.mean(0), joints.mean(0), topology.mirror
    one_side = np.arange(len(mirror)) < topology.num_midline + topology.num_side
    regressor = np.zeros((NUM_JOINTS, len(mirror)))
    for joint in range(NUM_JOINTS):
        partner = int(MIRROR[joint])
        if partner < joint:
            regressor[joint] = regressor[partner][mirror]
            continue
        near = _near(joint, mean, mean_joints[joint], weights)
        if partner == joint:
            near &= one_side
        index = np.nonzero(near)[0]
        chosen = generator.choice(len(people), _REGRESSOR_PEOPLE, replace=False)
        points = people[chosen][:, index]
        if partner == joint:
            points = 0.5 * (points + people[chosen][:, mirror[index]] * FLIP)
        row = _convex_weights(points - mean_joints[joint], joints[chosen, joint] - mean_joints[joint])
        if partner == joint:
            row = row / 2
            np.add.at(regressor[joint], mirror[index], row)
        regressor[joint, index] += row
    return regressor


def _near(
    joint: int,
    mean: Float[np.ndarray, "V 3"],
    centre: Float[np.ndarray, "3"],
    weights: Float[np.ndarray, "V 24"],
) -> Bool[np.ndarray, " V"]:
    """The vertices that may take part in a joint's regressor row."""
    distance = np.linalg.norm(mean - centre, axis=1)
    if joint in _MIDLINE_JOINTS:  # a slab all around the trunk, neck or head
        trunk = weights[:, [0, 1, 2, 3, 6, 9, 12, 13, 14, 15]].sum(1) > 0.3
        return trunk & (np.abs(mean[:, 1] - centre[1]) < (0.10 if joint < 12 else 0.06))
    if joint in (1, 13):  # hip and collar: everything close by, on this side
        return (distance < 0.22) & (mean[:, 0] * np.sign(centre[0]) > -0.01)
    moved = np.nonzero(weights[:, joint] + weights[:, JOINT_PARENTS[joint]] > 0.05)[0]
    near = np.zeros(len(mean), dtype=bool)
    near[moved[np.argsort(distance[moved])[:220]]] = True
    return near


def _convex_weights(
    points: Float[np.ndarray, "P C 3"], targets: Float[np.ndarray, "P 3"]
) -> Float[np.ndarray, " C"]:
    """Weights, none negative, of sum 1, whose mixture of the points comes nearest the targets."""
    count = points.shape[1]
    system = np.vstack(
        [
            points.transpose(0, 2, 1).reshape(-1, count),
            _SUM_WEIGHT * np.ones((1, count)),
            _EVENNESS * np.sqrt(count) * np.eye(count),
        ]
    )
    goal = np.concatenate([targets.reshape(-1), [_SUM_WEIGHT], np.zeros(count)])
    weights, _ = nnls(system, goal, maxiter=20000)
    weights[weights < 1e-3] = 0
    return weights / weights.sum()
