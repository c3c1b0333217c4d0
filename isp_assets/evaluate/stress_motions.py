"""Motions that are hard on clothes: formulas and inverse kinematics, one sample for every value of a sweep.

Angles in degrees at the interface, metres, Y up, facing +Z. Bodies stand or hang
at the origin: what matters is how limbs press on cloth, not where the feet are.
"""

from collections.abc import Callable, Sequence

import numpy as np
import torch

from isp_assets.conventions import JOINT_NAMES
from isp_assets.geometry.rotations import slerp
from isp_assets.motion import Motion
from isp_assets.train.leg_ik import LEGS, Figure, Matrix, Point, Pose, sign, turn, vector
from isp_assets.train.procedural_motion import squat

FPS = 30.0
_HANGING = 15.0  # degrees between a hanging arm and straight down
_ELBOW = 12.0  # degrees that a hanging elbow is bent
_WAIST_AHEAD = np.array([0.0, -0.02, 0.03])  # from the lowest spine joint to where a hand rests [m]

Sweep = Sequence[float]


def arms_swept(figure: Figure, angles: Sweep) -> Motion:
    """Straight upper arms in the frontal plane; the angle from straight down, negative into the torso."""

    def pose_of(pose: Pose, angle: float) -> None:
        hang_arms(figure, pose, angle)

    return _motion("arms", angles, pose_of)


def wrists_turned(figure: Figure, angles: Sweep, axis: str) -> Motion:
    """Hanging arms with both wrists turned about the rest pose's x (twist), y or z axis, mirrored."""
    mirror = np.array([1.0, -1.0, -1.0])

    def pose_of(pose: Pose, angle: float) -> None:
        hang_arms(figure, pose, _HANGING)
        turned = np.radians(angle) * np.eye(3)["xyz".index(axis)]
        pose[_joint("left_wrist")], pose[_joint("right_wrist")] = turned, turned * mirror

    return _motion(f"wrists_{axis}", angles, pose_of)


def hands_on_hips(figure: Figure, distances: Sweep) -> Motion:
    """Both wrists at the waist, this far to the side of the body's middle [cm]; elbows out."""

    def pose_of(pose: Pose, distance: float) -> None:
        for side in LEGS:
            out = sign(side)
            wrist = figure.joints[_joint("spine1")] + _WAIST_AHEAD + [out * distance / 100, 0.0, 0.0]
            reach_with_arm(figure, side, pose, wrist, np.array([out, 0.0, -0.4]))

    return _motion("hands_on_hips", distances, pose_of)


def arms_crossed(shares: Sweep) -> Motion:
    """From hanging (0) to crossed in front of the chest (1), and beyond; legs as in the built-in clip."""
    clip = torch.from_numpy(Motion.load("arms_crossed").poses)
    start, end = clip[0], clip[len(clip) // 2]
    amount = torch.tensor(list(shares), dtype=clip.dtype)[:, None].expand(-1, len(JOINT_NAMES))
    shape = (len(amount), *start.shape)
    poses = slerp(start.expand(shape), end.expand(shape), amount)
    return Motion(poses.numpy(), np.zeros((len(poses), 3)), fps=FPS, name="arms_crossed")


def deep_squat(figure: Figure, depths: Sweep) -> Motion:
    """Feet on the floor, the pelvis this much lower [cm], arms forward."""
    clips = [squat(figure, depth / 100) for depth in depths]
    lowest = [int(np.argmin(clip.translation[:, 1])) for clip in clips]
    poses = np.stack([clip.poses[k] for clip, k in zip(clips, lowest, strict=True)])
    translation = np.stack([clip.translation[k] for clip, k in zip(clips, lowest, strict=True)])
    return Motion(poses, translation, fps=FPS, name="deep_squat")


def stride(figure: Figure, angles: Sweep) -> Motion:
    """Straight legs, left forward and right back, with this angle between them in the sagittal plane."""

    def pose_of(pose: Pose, angle: float) -> None:
        _spread_legs(figure, pose, angle, forward=True)

    return _motion("stride", angles, pose_of)


def split(figure: Figure, angles: Sweep) -> Motion:
    """Straight legs to the sides, with this angle between them in the frontal plane."""

    def pose_of(pose: Pose, angle: float) -> None:
        _spread_legs(figure, pose, angle, forward=False)

    return _motion("split", angles, pose_of)


def rolled(figure: Figure, pitches: Sweep) -> Motion:
    """The whole body pitched about its pelvis: 90 lies face down, -90 on the back."""
    return _turned_whole(figure, pitches, "x")


def turned_on_the_spot(figure: Figure, headings: Sweep) -> Motion:
    """The whole body turned about the vertical axis."""
    return _turned_whole(figure, headings, "y")


def noisy(motion: Motion, *, frame: int, amplitudes: Sweep, seed: int) -> Motion:
    """One pose held still, each sample disturbed in every joint by up to an amplitude [degrees]."""
    rng = np.random.default_rng(seed)
    scale = np.radians(np.asarray(amplitudes, float))[:, None, None]
    poses = motion.poses[frame] + scale * rng.uniform(-1, 1, (len(scale), len(JOINT_NAMES), 3))
    poses[:, -2:] = motion.poses[frame, -2:]
    return Motion(
        poses, np.repeat(motion.translation[frame][None], len(scale), 0), fps=motion.fps, name="noisy"
    )


def hang_arms(figure: Figure, pose: Pose, angle: float) -> None:
    """Both upper arms at an angle from straight down, in the frontal plane; elbows a little bent forward."""
    for side in LEGS:
        out = sign(side)
        down = np.array([out * np.sin(np.radians(angle)), -np.cos(np.radians(angle)), 0.0])
        pose[_joint(f"{side}_collar")] = [0.0, 0.0, -out * np.radians(8)]
        _aim_upper_arm(figure, side, pose, down)
        pose[_joint(f"{side}_elbow")] = [0.0, -out * np.radians(_ELBOW), 0.0]


def reach_with_arm(figure: Figure, side: str, pose: Pose, wrist: Point, elbow_towards: Point) -> None:
    """Bring a wrist joint to a point of rest space [m], the elbow bent towards a direction.

    The collar is left as it is in ``pose``. A point out of reach is approached as far as the arm goes.
    """
    shoulder, elbow, hand = (_joint(f"{side}_{name}") for name in ("shoulder", "elbow", "wrist"))
    joints = figure.joints
    collar = turn_of(pose[_joint(f"{side}_collar")])
    root = joints[_joint(f"{side}_collar")]
    start = root + collar @ (joints[shoulder] - root)
    upper = float(np.linalg.norm(joints[elbow] - joints[shoulder]))
    lower = float(np.linalg.norm(joints[hand] - joints[elbow]))
    way = wrist - start
    distance = float(np.clip(np.linalg.norm(way), abs(upper - lower) + 1e-4, 0.9995 * (upper + lower)))
    along = way / np.linalg.norm(way)
    across = elbow_towards - (elbow_towards @ along) * along
    across /= np.linalg.norm(across)
    cosine = (upper**2 + distance**2 - lower**2) / (2 * upper * distance)
    bent = upper * (cosine * along + np.sqrt(max(0.0, 1 - cosine**2)) * across)
    world = _aim_upper_arm(figure, side, pose, bent)
    forearm = world.T @ (distance * along - bent)
    pose[elbow] = vector(_shortest_turn(joints[hand] - joints[elbow], forearm))


def turn_of(rotation: Point) -> Matrix:
    """Rotation matrix of an axis-angle vector [rad]."""
    angle = float(np.linalg.norm(rotation))
    return np.eye(3) if angle < 1e-12 else _about(rotation / angle, angle)


def _aim_upper_arm(figure: Figure, side: str, pose: Pose, direction: Point) -> Matrix:
    """Set the shoulder so that the upper arm points along a direction; the arm's rotation in the world."""
    shoulder, elbow = _joint(f"{side}_shoulder"), _joint(f"{side}_elbow")
    collar = turn_of(pose[_joint(f"{side}_collar")])
    bone = figure.joints[elbow] - figure.joints[shoulder]
    world = _shortest_turn(collar @ bone, direction) @ collar
    pose[shoulder] = vector(collar.T @ world)
    return world


def _spread_legs(figure: Figure, pose: Pose, angle: float, *, forward: bool) -> None:
    hang_arms(figure, pose, _HANGING)
    for side, (hip, _, ankle, _) in LEGS.items():
        leg = figure.joints[ankle] - figure.joints[hip]
        half = sign(side) * np.radians(angle) / 2
        if forward:  # about x, a turn by t takes straight down to t behind it
            pose[hip] = [-half - np.arctan2(-leg[2], -leg[1]), 0.0, 0.0]
        else:
            pose[hip] = [0.0, 0.0, half - np.arctan2(leg[0], -leg[1])]


def _turned_whole(figure: Figure, angles: Sweep, axis: str) -> Motion:
    def pose_of(pose: Pose, angle: float) -> None:
        hang_arms(figure, pose, _HANGING)
        pose[0] = vector(turn(axis, np.radians(angle)))

    return _motion(f"turned_{axis}", angles, pose_of)


def _motion(name: str, values: Sweep, pose_of: Callable[[Pose, float], None]) -> Motion:
    poses = np.zeros((len(values), len(JOINT_NAMES), 3))
    for pose, value in zip(poses, values, strict=True):
        pose_of(pose, value)
    return Motion(poses, np.zeros((len(values), 3)), fps=FPS, name=name)


def _shortest_turn(start: Point, end: Point) -> Matrix:
    """Smallest rotation that takes one direction to another."""
    start, end = start / np.linalg.norm(start), end / np.linalg.norm(end)
    axis = np.cross(start, end)
    sine = float(np.linalg.norm(axis))
    return np.eye(3) if sine < 1e-12 else _about(axis / sine, float(np.arctan2(sine, start @ end)))


def _about(axis: Point, angle: float) -> Matrix:
    """Rotation by an angle [rad] about a unit axis (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def _joint(name: str) -> int:
    return JOINT_NAMES.index(name)
