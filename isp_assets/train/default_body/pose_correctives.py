"""Pose directions: what linear blend skinning gets wrong, as a linear function of ``R - I``.

For each joint, rotations are drawn from its range of motion. The target is a skin
that interpolates rotations (a vertex of weight w turns by w times the angle) and
keeps its surface detail (delta mush). The difference to linear blend skinning is
fitted to the joint's nine features, vertex by vertex. Left joints are fitted, right ones mirrored.

Reference: Mancewicz et al., "Delta Mush: smoothing deformations while preserving detail", 2014.
"""

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from isp_assets.conventions import JOINT_NAMES, JOINT_PARENTS, NUM_JOINTS
from isp_assets.train.default_body.rig import FLIP, MIRROR
from isp_assets.train.default_body.shape_space import ShapeSpace, mesh_adjacency
from isp_assets.train.default_body.topology import Topology

_SEED = 0
_DRAWS = 90
_RIDGE = 3e-3
_SMALLEST = 5e-5  # entries below this [m] are dropped: most of the array is then zero, and the file small
_MUSH_STEPS = 8
# Fitted coefficients are smoothed over the surface where joints crease: collar, hip and, above all, armpit.
_SMOOTHING = {"left_shoulder": 3, "left_collar": 1, "left_hip": 1}
# Mean, standard deviation, lower and upper limit of each rotation component [degrees].
_MOTION_RANGE = {
    "left_hip": ((-35, 0, 5), (45, 18, 18), (-125, -45, -35), (35, 45, 55)),
    "left_knee": ((55, 0, 0), (45, 8, 5), (-5, -20, -15), (140, 20, 15)),
    "left_ankle": ((0, 0, 0), (22, 15, 15), (-45, -35, -35), (50, 35, 35)),
    "left_foot": ((-10, 0, 0), (20, 3, 3), (-50, -8, -8), (25, 8, 8)),
    "spine1": ((8, 0, 0), (14, 12, 12), (-25, -30, -30), (45, 30, 30)),
    "spine2": ((4, 0, 0), (12, 12, 10), (-25, -30, -25), (35, 30, 25)),
    "spine3": ((2, 0, 0), (12, 12, 10), (-25, -30, -25), (30, 30, 25)),
    "neck": ((5, 0, 0), (18, 20, 15), (-45, -50, -40), (45, 50, 40)),
    "head": ((0, 0, 0), (18, 25, 15), (-45, -60, -40), (45, 60, 40)),
    "left_collar": ((0, -4, -3), (6, 12, 12), (-20, -35, -30), (20, 30, 30)),
    "left_shoulder": ((0, -12, -35), (30, 35, 40), (-75, -115, -95), (75, 60, 85)),
    "left_elbow": ((0, -55, 0), (28, 45, 10), (-80, -140, -25), (80, 8, 25)),
    "left_wrist": ((0, 0, 0), (38, 20, 30), (-85, -45, -70), (85, 45, 70)),
    "left_hand": ((0, 0, 0), (3, 8, 30), (-10, -20, -80), (10, 20, 25)),
}
_FLIP_FEATURES = np.outer(FLIP, FLIP).ravel()  # what mirroring does to R - I, row-major


def fit_pose_dirs(
    space: ShapeSpace, topology: Topology, *, log: Callable[[str], None]
) -> Float[np.ndarray, "V 3 207"]:
    """Fit all joints; symmetric."""
    mush = DeltaMush(space.template, topology.faces)
    generator = np.random.default_rng(_SEED)
    fitted = np.zeros((len(space.template), 3, NUM_JOINTS - 1, 9))
    for name in _MOTION_RANGE:
        joint = JOINT_NAMES.index(name)
        rotations = _draw_rotations(name, generator)
        own = _fit_joint(space, mush, joint, rotations)
        mirrored = own[topology.mirror] * FLIP[:, None] * _FLIP_FEATURES
        if MIRROR[joint] == joint:
            fitted[:, :, joint - 1] = 0.5 * (own + mirrored)
        else:
            fitted[:, :, joint - 1], fitted[:, :, MIRROR[joint] - 1] = own, mirrored
        log(f"pose directions of {name}: {int(own.any((1, 2)).sum())} vertices")
    fitted[np.abs(fitted) < _SMALLEST] = 0
    return fitted.reshape(len(space.template), 3, 9 * (NUM_JOINTS - 1))


class DeltaMush:
    """Smooth a posed surface, then put the rest surface's detail back, turned with it."""

    def __init__(self, rest: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> None:
        adjacency = mesh_adjacency(faces, len(rest))
        average = sp.diags(1 / np.asarray(adjacency.sum(1)).ravel()) @ adjacency
        self.step = (sp.eye(len(rest)) * 0.5 + average * 0.5).tocsr()
        self._faces = faces
        self._neighbour = adjacency.indices[adjacency.indptr[:-1]]
        smooth = self.smooth(rest)
        self._detail = np.einsum("vab,va->vb", self._frames(smooth), rest - smooth)

    def __call__(self, posed: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3"]:
        smooth = self.smooth(posed)
        return smooth + np.einsum("vab,vb->va", self._frames(smooth), self._detail)

    def smooth(self, values: Float[np.ndarray, "V *C"]) -> Float[np.ndarray, "V *C"]:
        """Average with the neighbours, a few times."""
        for _ in range(_MUSH_STEPS):
            values = self.step @ values
        return values

    def _frames(self, points: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3 3"]:
        """Normal, a tangent towards one neighbour, and their cross product, as columns."""
        a, b, c = points[self._faces].transpose(1, 0, 2)
        normal = np.zeros_like(points)
        for corner in range(3):
            np.add.at(normal, self._faces[:, corner], np.cross(b - a, c - a))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-15
        tangent = points[self._neighbour] - points
        tangent -= normal * (tangent * normal).sum(1, keepdims=True)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True) + 1e-15
        return np.stack([normal, tangent, np.cross(normal, tangent)], axis=2)


def _draw_rotations(name: str, generator: np.random.Generator) -> Float[np.ndarray, "K 3"]:
    """Axis-angle samples of a joint's range of motion [rad], its extremes among them."""
    mean, deviation, low, high = (np.array(values, dtype=float) for values in _MOTION_RANGE[name])
    drawn = np.clip(generator.normal(mean, deviation, (_DRAWS, 3)), low, high)
    extremes = 0.9 * np.concatenate([np.diag(low), np.diag(high)])
    rotations = np.radians(np.concatenate([drawn, extremes]))
    joint = JOINT_NAMES.index(name)
    return np.concatenate([rotations, rotations * [1, -1, -1]]) if MIRROR[joint] == joint else rotations


def _fit_joint(
    space: ShapeSpace, mush: DeltaMush, joint: int, rotations: Float[np.ndarray, "K 3"]
) -> Float[np.ndarray, "V 3 9"]:
    """Ridge regression of the skinning error on the features; the correction itself is skinned."""
    weight = space.weights[:, _subtree(joint)].sum(1)
    arm = space.template - space.joints[joint]
    active = np.nonzero(mush.smooth((weight * (1 - weight) > 1e-4).astype(float)) > 0.02)[0]
    matrices = Rotation.from_rotvec(rotations).as_matrix()
    share = weight[active, None, None]
    skins = share * matrices[:, None] + (1 - share) * np.eye(3)
    errors = np.empty((len(rotations), len(active), 3))
    for k, rotation in enumerate(rotations):
        turned = Rotation.from_rotvec(weight[:, None] * rotation).apply(arm)
        target = mush(turned + space.joints[joint]) - space.joints[joint]
        errors[k] = target[active] - np.einsum("vab,vb->va", skins[k], arm[active])
    features = (matrices - np.eye(3)).reshape(-1, 9)
    squares = np.einsum("kvab,kvac->kvbc", skins, skins)
    system = np.einsum("kf,kg,kvbc->vfbgc", features, features, squares, optimize=True).reshape(-1, 27, 27)
    goal = np.einsum("kf,kvab,kva->vfb", features, skins, errors, optimize=True).reshape(-1, 27, 1)
    solved = np.linalg.solve(system + _RIDGE * len(rotations) * np.eye(27), goal)
    full = np.zeros((len(weight), 27))
    full[active] = solved.reshape(-1, 9, 3).transpose(0, 2, 1).reshape(-1, 27)
    for _ in range(_SMOOTHING.get(JOINT_NAMES[joint], 0)):
        full = mush.step @ full
    outside = np.setdiff1d(np.arange(len(full)), active)
    full[outside] = 0
    return full.reshape(-1, 3, 9)


def _subtree(joint: int) -> list[int]:
    """A joint and all joints below it."""
    below = [joint]
    for child in range(joint + 1, NUM_JOINTS):
        if JOINT_PARENTS[child] in below:
            below.append(child)
    return below
