"""Legs that reach for the floor: foot placement and analytic inverse kinematics.

Y up, metres, floor at ``y = 0``. A leg is two bones: the knee angle follows from
the distance of the ankle, and the hip from its direction.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from isp_assets.body import Body

LEGS = {"left": (1, 4, 7, 10), "right": (2, 5, 8, 11)}
"""Joint numbers of hip, knee, ankle and ball of the foot."""
_LEG_REACH = 0.9995  # a leg is never quite straight: there the knee's direction is undefined

Pose = Float[np.ndarray, "24 3"]
Matrix = Float[np.ndarray, "3 3"]
Point = Float[np.ndarray, "3"]


@dataclass(frozen=True)
class Figure:
    """What placing feet needs to know of a body at rest."""

    joints: Float[np.ndarray, "24 3"]
    floor: float
    """Height of the soles in rest space [m]."""
    heels: dict[str, Float[np.ndarray, "3"]]
    """The point of each heel that touches down first [m]."""

    @classmethod
    def of(cls, body: Body) -> "Figure":
        vertices = body.template.double().numpy()
        joints = (body.joint_regressor @ body.template).double().numpy()
        floor = float(vertices[:, 1].min())
        heels = {}
        for side, (_, _, ankle, _) in LEGS.items():
            sole = (vertices[:, 1] < floor + 0.02) & (np.sign(vertices[:, 0]) == sign(side))
            # 15 mm ahead of the rearmost point: the heel is round.
            heels[side] = np.array([joints[ankle, 0], floor, vertices[sole, 2].min() + 0.015])
        return cls(joints, floor, heels)

    @property
    def standing(self) -> Float[np.ndarray, "3"]:
        """Position of the pelvis joint when the soles rest on the floor [m]."""
        return self.joints[0] - [0.0, self.floor, 0.0]


@dataclass(frozen=True)
class FootPlacement:
    """A foot at one instant: its print, and how it is rolled over heel or ball."""

    position: Point
    heading: float
    pitch: float
    """Toe up is positive [rad]."""
    lift: float
    toe_bend: float


def ankle_of(figure: Figure, side: str, foot: FootPlacement) -> tuple[Point, Matrix]:
    """Ankle position and foot rotation: the foot turns about its heel (toe up) or its ball (heel up)."""
    _, _, ankle, ball_joint = LEGS[side]
    joints = figure.joints
    rotation = turn("y", foot.heading) @ turn("x", -foot.pitch)
    ball = np.array([joints[ball_joint, 0], figure.floor, joints[ball_joint, 2]])
    pivot = figure.heels[side] if foot.pitch > 0 else ball
    # The print lies 3 cm in front of the ankle; ball and heel follow from it, flat on the floor.
    ball_ahead = np.array([0.0, 0.0, joints[ball_joint, 2] - joints[ankle, 2] - 0.03])
    world_pivot = (
        foot.position + turn("y", foot.heading) @ (ball_ahead + pivot - ball) + [0.0, foot.lift, 0.0]
    )
    return world_pivot + rotation @ (joints[ankle] - pivot), rotation


def bend_leg(
    figure: Figure,
    side: str,
    pose: Pose,
    pelvis: tuple[Point, Matrix],
    ankle: tuple[Point, Matrix],
    *,
    knee_towards: Point | None = None,
) -> None:
    """Set hip, knee and ankle so that the ankle joint and the foot are where they should be.

    The knee turns about x alone, by the angle that gives the leg the right length
    ``|thigh + R_x shin|``; the hip then points the leg at the target by the smallest rotation,
    and turns it about the line from hip to ankle if the knee is to point somewhere.

    Args:
        figure: The body at rest.
        side: ``"left"`` or ``"right"``.
        pose: Takes the rotations.
        pelvis: Position [m] and rotation of the pelvis.
        ankle: Position [m] of the ankle and rotation of the foot.
        knee_towards: Point [m] at whose side of the line from hip to ankle the knee lies; without it the
            knee lies where the smallest rotation leaves it, which in a deep bend is at the other knee.
    """
    hip, knee, heel, _ = LEGS[side]
    joints = figure.joints
    position, root = pelvis
    target, foot = ankle
    thigh, shin = joints[knee] - joints[hip], joints[heel] - joints[knee]
    socket = position + root @ (joints[hip] - joints[0])
    reach = target - socket
    longest = np.hypot(np.linalg.norm(thigh[1:]) + np.linalg.norm(shin[1:]), thigh[0] + shin[0])
    length = min(float(np.linalg.norm(reach)), _LEG_REACH * longest)
    # |thigh + R_x(t) shin|² = length² is cosine cos(t) + sine sin(t) + rest = 0.
    cosine = 2 * (thigh[1] * shin[1] + thigh[2] * shin[2])
    sine = 2 * (thigh[2] * shin[1] - thigh[1] * shin[2])
    rest = thigh @ thigh + shin @ shin + 2 * thigh[0] * shin[0] - length**2
    middle, spread = np.arctan2(sine, cosine), np.arccos(np.clip(-rest / np.hypot(cosine, sine), -1, 1))
    bend = middle + spread  # of the two solutions the one in which the knee points forward
    hip_world = _shortest_turn(root @ (thigh + turn("x", bend) @ shin), reach) @ root
    if knee_towards is not None:
        axis = reach / np.linalg.norm(reach)
        hip_world = _turn_about(axis, hip_world @ thigh, knee_towards - socket) @ hip_world
    pose[hip] = vector(root.T @ hip_world)
    pose[knee] = [bend, 0.0, 0.0]
    pose[heel] = vector((hip_world @ turn("x", bend)).T @ foot)


def _shortest_turn(start: Point, end: Point) -> Matrix:
    axis = np.cross(start, end)
    sine = np.linalg.norm(axis)
    if sine < 1e-12:
        return np.eye(3)
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, start @ end)).as_matrix()


def _turn_about(axis: Point, start: Point, end: Point) -> Matrix:
    """Rotation about a unit axis after which both directions lie on the same side of it."""
    angle = np.arctan2(axis @ np.cross(start, end), start @ end - (axis @ start) * (axis @ end))
    return Rotation.from_rotvec(axis * angle).as_matrix()


def turn(axis: str, angle: float) -> Matrix:
    """Rotation matrix about a coordinate axis, ``"x"``, ``"y"`` or ``"z"`` [rad]."""
    return Rotation.from_euler(axis, angle).as_matrix()


def vector(matrix: Matrix) -> Point:
    """Axis-angle vector of a rotation matrix [rad]."""
    return Rotation.from_matrix(matrix).as_rotvec()


def sign(side: str) -> int:
    """+1 for the left side, which is +X, and -1 for the right."""
    return 1 if side == "left" else -1
