"""SMPL's 24 joints, skin weights and T-pose on MakeHuman's body.

MakeHuman rests in an A-pose with a leaning trunk and splayed feet; SMPL in a T-pose.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from isp_assets.conventions import JOINT_NAMES, JOINT_PARENTS, NUM_JOINTS
from isp_assets.train.default_body.makehuman import NEUTRAL, MakeHuman

PELVIS = np.array([0.0, -0.22, 0.03])
"""Where the rest pelvis joint is put [m]: about where SMPL has it."""
MIRROR = np.array(
    [
        JOINT_NAMES.index({"l": "right", "r": "left"}[n[0]] + n[n.index("_") :] if "_" in n else n)
        for n in JOINT_NAMES
    ]
)
"""The joint on the other side; midline joints are their own."""
FLIP = np.array([-1.0, 1.0, 1.0])
"""Mirrors a point."""

_LEAN = np.radians(3.0)  # the trunk is tilted back, to stand over the ankles
_COLLAR_UP = np.radians(13.0)  # how far the clavicle rises between A-pose and T-pose
_FOOT_YAW = np.radians(10.0)
_BLEND_HEIGHT = 0.022  # width of the soft steps between the spine joints' weights [m]
_SPINE = (0, 3, 6, 9)


def _direction(x: float, y: float, z: float) -> Float[np.ndarray, "3"]:
    return np.array([x, y, z]) / np.linalg.norm([x, y, z])


def _slope(degrees: float) -> float:
    return float(np.tan(np.radians(degrees)))


# Rest direction of the left bone that ends in each joint; the right side is mirrored. Rounded angles.
_REST = {
    18: _direction(1.0, -_slope(3.0), -_slope(6.0)),
    20: _direction(1.0, _slope(2.0), 0.0),
    22: _direction(1.0, -_slope(5.0), -_slope(8.0)),
    4: _direction(_slope(5.0), -1.0, -_slope(1.0)),
    7: _direction(-_slope(2.0), -1.0, -_slope(4.5)),
}


class Rig:
    """Joints and skin weights of MakeHuman's base mesh, in SMPL's terms."""

    weights: Float[np.ndarray, "M 24"]
    """Weights of every base vertex."""

    def __init__(self, makehuman: MakeHuman) -> None:
        self._cubes = {
            name.removeprefix("joint-"): np.unique(quads)
            for name, quads in makehuman.groups.items()
            if name.startswith("joint-")
        }
        self.weights = self._merged_weights(makehuman)

    def joints(self, vertices: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, "24 3"]:
        """SMPL's joints in the A-pose [m]: mixtures of the centres of MakeHuman's joint cubes."""

        def at(name: str) -> Float[np.ndarray, "3"]:
            return vertices[self._cubes[name]].mean(0)

        joints = np.zeros((NUM_JOINTS, 3))
        joints[0] = 0.5 * at("pelvis") + 0.5 * at("spine-4")
        joints[0, 2] = at("pelvis")[2]
        joints[3] = at("spine-3")
        joints[6] = (2 * at("spine-2") + at("spine-1")) / 3
        joints[9] = 0.25 * at("spine-2") + 0.75 * at("spine-1")
        joints[12] = at("neck")
        joints[15] = 0.2 * at("neck") + 0.8 * at("head")
        for offset, side in enumerate(("l", "r")):
            joints[1 + offset] = 0.85 * at(f"{side}-upper-leg") + 0.15 * at("pelvis")
            joints[4 + offset] = at(f"{side}-knee")
            joints[7 + offset] = at(f"{side}-ankle")
            joints[10 + offset] = np.mean([at(f"{side}-toe-{k}-1") for k in range(1, 6)], axis=0)
            collar = 0.5 * at(f"{side}-clavicle") + 0.3 * at(f"{side}-scapula") + 0.2 * at("spine-1")
            joints[13 + offset] = collar
            joints[16 + offset] = at(f"{side}-shoulder")
            joints[18 + offset] = at(f"{side}-elbow")
            joints[20 + offset] = at(f"{side}-hand")
            joints[22 + offset] = np.mean([at(f"{side}-finger-{k}-1") for k in range(2, 6)], axis=0)
        return joints

    def _merged_weights(self, makehuman: MakeHuman) -> Float[np.ndarray, "M 24"]:
        """Sum MakeHuman's bones into SMPL's joints; the trunk is split anew, by height."""
        vertices = makehuman.shape(NEUTRAL)
        joints = self.joints(vertices)
        weights, trunk = np.zeros((len(vertices), NUM_JOINTS)), np.zeros(len(vertices))
        for bone, rows in makehuman.bone_weights().items():
            if not rows:
                continue
            index, weight = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
            shares = _smpl_joints(bone)
            if shares is None:
                trunk[index] += weight
                continue
            for joint, share in shares.items():
                weights[index, joint] += share * weight
        lower, middle, upper = (
            1 / (1 + np.exp(-(vertices[:, 1] - joints[joint, 1]) / _BLEND_HEIGHT)) for joint in _SPINE[1:]
        )
        shares_of_trunk = (
            1 - lower,
            lower * (1 - middle),
            lower * middle * (1 - upper),
            lower * middle * upper,
        )
        for joint, share in zip(_SPINE, shares_of_trunk, strict=True):
            weights[:, joint] += trunk * share
        return weights / np.maximum(weights.sum(1, keepdims=True), 1e-12)


def _smpl_joints(bone: str) -> dict[int, float] | None:
    """Shares of SMPL's joints in a MakeHuman bone; ``None`` for the trunk."""
    name, side = bone.split(".")[0], 0 if bone.endswith("L") else 1
    if name in ("root", "pelvis", "breast") or name.startswith("spine"):
        return None
    if name == "neck03":
        return {12: 0.5, 15: 0.5}
    if name == "finger1-1":  # the thumb's first bone moves with the palm
        return {20 + side: 1.0}
    left_joints = {
        "upperleg": 1, "lowerleg": 4, "foot": 7, "toe": 10, "clavicle": 13, "shoulder01": 13, "upperarm": 16,
        "lowerarm": 18, "wrist": 20, "metacarpal": 20, "finger": 22,
    }  # fmt: skip
    for prefix, joint in left_joints.items():
        if name.startswith(prefix):
            return {joint + side: 1.0}
    return {12: 1.0} if name in ("neck01", "neck02") else {15: 1.0}


def to_t_pose(
    vertices: Float[np.ndarray, "V 3"], joints: Float[np.ndarray, "24 3"], weights: Float[np.ndarray, "V 24"]
) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "24 3"]]:
    """Skin an A-posed body into the T-pose [m]; vertices and joints."""
    turns = _t_pose_rotations(joints)
    posed = joints.copy()
    for joint in range(1, NUM_JOINTS):
        parent = JOINT_PARENTS[joint]
        posed[joint] = posed[parent] + turns[parent] @ (joints[joint] - joints[parent])
    shifts = posed - np.einsum("jab,jb->ja", turns, joints)
    blended = np.einsum("vj,jab->vab", weights, turns)
    return np.einsum("vab,vb->va", blended, vertices) + weights @ shifts, posed


def _t_pose_rotations(joints: Float[np.ndarray, "24 3"]) -> Float[np.ndarray, "24 3 3"]:
    """World rotation of each joint that takes the A-pose to the T-pose."""
    turns = np.tile(np.eye(3), (NUM_JOINTS, 1, 1))
    turns[list(_SPINE)] = _about("x", -_LEAN)
    turns[12] = _about("x", -_LEAN / 2)
    for offset, sign in ((0, 1), (1, -1)):
        aligned = _aligner(joints, turns, offset, sign)
        turns[13 + offset] = _about("z", sign * _COLLAR_UP) @ turns[9]
        turns[16 + offset] = aligned(13, 16, 18)
        turns[18 + offset] = aligned(16, 18, 20)
        turns[20 + offset] = turns[22 + offset] = aligned(18, 20, 22)
        turns[1 + offset] = _shortest_turn(joints[4 + offset] - joints[1 + offset], _REST[4] * [sign, 1, 1])
        turns[4 + offset] = aligned(1, 4, 7)
        foot = joints[10 + offset] - joints[7 + offset]
        yaw = np.arctan2(foot[0] * sign, foot[2])
        turns[7 + offset] = turns[10 + offset] = _about("y", sign * (_FOOT_YAW - yaw))
    return turns


def _aligner(
    joints: Float[np.ndarray, "24 3"], turns: Float[np.ndarray, "24 3 3"], offset: int, sign: int
) -> Callable[[int, int, int], Float[np.ndarray, "3 3"]]:
    """Makes: turn a bone, carried along by its parent, on into its rest direction."""

    def aligned(parent: int, start: int, end: int) -> Float[np.ndarray, "3 3"]:
        carried = turns[parent + offset] @ (joints[end + offset] - joints[start + offset])
        return _shortest_turn(carried, _REST[end] * [sign, 1, 1]) @ turns[parent + offset]

    return aligned


def _about(axis: str, angle: float) -> Float[np.ndarray, "3 3"]:
    return Rotation.from_euler(axis, angle).as_matrix()


def _shortest_turn(start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    axis = np.cross(start, end)
    sine = np.linalg.norm(axis)
    if sine < 1e-12:
        return np.eye(3)
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, start @ end)).as_matrix()
