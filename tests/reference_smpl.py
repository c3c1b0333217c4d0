"""A second SMPL forward pass: float64 NumPy, vertex by vertex and joint by joint, straight from the paper.

Slow and plain on purpose: it shares no code and no array layout with ``isp_assets.body``.
"""

import numpy as np
from scipy.spatial.transform import Rotation


def pose_reference(body, pose, betas, translation):
    """Vertices ``[N, 3]`` and joints ``[24, 3]`` of one pose, ``[24, 3]`` axis-angle.

    ``body`` is any object with the arrays of ``isp_assets.body.Body``.
    """
    template = np.asarray(body.template, dtype=np.float64)
    rotations = [Rotation.from_rotvec(vector).as_matrix() for vector in pose]
    shaped = template + sum(beta * np.asarray(body.shape_dirs[..., k]) for k, beta in enumerate(betas))
    rest_joints = np.asarray(body.joint_regressor, dtype=np.float64) @ shaped
    corrected = shaped.copy()
    for joint in range(1, 24):
        difference = rotations[joint] - np.eye(3)
        for entry in range(9):
            direction = np.asarray(body.pose_dirs[..., 9 * (joint - 1) + entry], dtype=np.float64)
            corrected += difference[entry // 3, entry % 3] * direction
    turn, joints = [rotations[0]], [rest_joints[0] + translation]
    for joint in range(1, 24):
        parent = body.parents[joint]
        turn.append(turn[parent] @ rotations[joint])
        joints.append(joints[parent] + turn[parent] @ (rest_joints[joint] - rest_joints[parent]))
    vertices = np.zeros_like(template)
    for joint in range(24):
        rigid = (corrected - rest_joints[joint]) @ turn[joint].T + joints[joint]
        vertices += np.asarray(body.weights[:, joint], dtype=np.float64)[:, None] * rigid
    return vertices, np.stack(joints)


def tiny_smpl_arrays(vertices=40, betas=4, seed=0):
    """The arrays of a random body in SMPL's format, small enough for gradient checks; float64."""
    rng = np.random.default_rng(seed)
    weights = rng.random((vertices, 24)) ** 4
    regressor = rng.random((24, vertices)) ** 4
    parents = [4294967295, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21]
    return {
        "v_template": rng.normal(size=(vertices, 3)),
        "f": rng.integers(0, vertices, (2 * vertices, 3)).astype(np.uint32),
        "shapedirs": 0.1 * rng.normal(size=(vertices, 3, betas)),
        "posedirs": 0.01 * rng.normal(size=(vertices, 3, 207)),
        "J_regressor": regressor / regressor.sum(1, keepdims=True),
        "weights": weights / weights.sum(1, keepdims=True),
        "kintree_table": np.array([parents, range(24)]),
    }
