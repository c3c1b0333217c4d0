"""Make the motions that ship with the package: formulas for the body, inverse kinematics for the legs.

Y up, metres, floor at ``y = 0``, walking along +Z. The feet are planted: each
footprint is fixed first, and the leg is bent to reach it, so nothing slides.

Run: ``python -m isp_assets.train.procedural_motion --out DIR``.
"""

import argparse
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from isp_assets.body import Body
from isp_assets.conventions import JOINT_NAMES
from isp_assets.motion import Motion
from isp_assets.train.leg_ik import (
    LEGS,
    Figure,
    FootPlacement,
    Point,
    Pose,
    ankle_of,
    bend_leg,
    sign,
    turn,
    vector,
)

FPS = 30
_HOLD = 3.0  # seconds that a motion on the spot lasts: there and back
_STANCE = 0.62  # part of a step cycle that a foot stays on the floor
_TOE_UP, _HEEL_UP = 0.30, -0.85  # pitch of the foot at touch-down and at toe-off [rad]


@dataclass(frozen=True)
class Gait:
    """How a figure walks."""

    seconds: float = 4.0
    speed: float = 1.05
    """[m/s]"""
    cadence: float = 0.92
    """Cycles of two steps per second."""
    turn: float = 0.0
    """Change of heading [rad/s]."""
    width: float = 0.09
    """Distance of each footprint from the path [m]."""

    def path(self, time: float) -> tuple[Point, float]:
        """Point on the floor and heading at a time: a line, or an arc of a circle."""
        if self.turn == 0:
            return np.array([0.0, 0.0, self.speed * time]), 0.0
        radius, heading = self.speed / self.turn, self.turn * time
        return np.array([radius * (1 - np.cos(heading)), 0.0, radius * np.sin(heading)]), heading

    def footprint(self, side: str, step: float) -> tuple[Point, float]:
        """Where a foot stands in its ``step``-th stance: beside the body at the middle of that stance."""
        middle = (step + _STANCE / 2 - _phase_lag(side)) / self.cadence
        centre, heading = self.path(middle)
        return centre + turn("y", heading) @ [sign(side) * self.width, 0.0, 0.0], heading


def walk(figure: Figure, gait: Gait) -> Motion:
    """Walk along the gait's path, arms swinging against the legs."""
    count = round(gait.seconds * FPS)
    poses, positions = np.zeros((count, 24, 3)), np.zeros((count, 3))
    for frame in range(count):
        phase = frame / FPS * gait.cadence
        centre, heading = gait.path(frame / FPS)
        bob = -0.050 + 0.020 * np.cos(4 * np.pi * (phase - 0.31))
        sway = np.cos(2 * np.pi * (phase - 0.31))
        twist = np.cos(2 * np.pi * (phase - 0.03))
        facing = turn("y", heading)
        pelvis = centre + facing @ [0.018 * sway, figure.standing[1] + bob, 0.0]
        root = facing @ turn("y", -0.10 * twist) @ turn("z", -0.035 * sway) @ turn("x", 0.03)
        pose = poses[frame]
        for side in LEGS:
            foot = _foot_at(gait, side, phase + _phase_lag(side))
            ankle, rotation = ankle_of(figure, side, foot)
            bend_leg(figure, side, pose, (pelvis, root), (ankle, rotation))
            pose[LEGS[side][3], 0] = foot.toe_bend
        swing = 0.42 * np.cos(2 * np.pi * (phase - 0.05))
        _lower_arms(pose, left=-swing, right=swing)
        for joint in ("spine1", "spine2", "spine3"):
            pose[_joint(joint), 1] = 0.06 * twist
        pose[_joint("head"), 1] = -0.05 * twist
        pose[0], positions[frame] = vector(root), pelvis - figure.joints[0]
    return Motion(poses, positions, fps=FPS)


def arm_raise(figure: Figure) -> Motion:
    """Lift both arms sideways overhead, and lower them."""
    top = np.zeros((24, 3))
    _set_pair(top, "shoulder", (0.0, 0.0, np.radians(58)))
    _set_pair(top, "collar", (0.0, 0.0, np.radians(22)))
    base = np.zeros((24, 3))
    _lower_arms(base)

    def upper(pose: Pose, amount: float) -> None:
        pose[:] = _blend(base, top, amount)

    return _on_the_spot(figure, upper, sink=0.004)


def arms_crossed(figure: Figure) -> Motion:
    """Cross the arms in front of the chest, and let them hang again."""
    crossed = np.zeros((24, 3))
    # Found by minimising the distance of wrists and elbows to points in front of the chest.
    for joint, degrees in {
        "left_collar": (2, -7, -6), "right_collar": (1, 3, 2),
        "left_shoulder": (17, -75, -55), "right_shoulder": (27, 80, 63.5),
        "left_elbow": (-1, -73, -2), "right_elbow": (-1, 75, 1),
        "left_wrist": (-4, -19.5, -14), "right_wrist": (-3, 14, 12),
    }.items():  # fmt: skip
        crossed[_joint(joint)] = np.radians(degrees)
    base = np.zeros((24, 3))
    _lower_arms(base)

    def upper(pose: Pose, amount: float) -> None:
        pose[:] = _blend(base, crossed, amount)

    return _on_the_spot(figure, upper, sink=0.004)


def squat(figure: Figure, depth: float = 0.48) -> Motion:
    """Sink by ``depth`` metres, knees over the toes and arms stretched forward, and rise again."""
    lean = 1.15 * depth

    def tilt(amount: float) -> float:
        """Low down the hips flex no further: the pelvis comes up, and the lower back rounds instead."""
        return lean * amount * (1 - _ease((depth * amount - 0.3) / 0.6))

    def upper(pose: Pose, amount: float) -> None:
        _lower_arms(pose, left=1.35 * amount, right=1.35 * amount, bend=0.25 * (1 - amount))
        rounding = (lean * amount - tilt(amount)) / 2
        pose[_joint("spine1"), 0] = pose[_joint("spine2"), 0] = 0.15 * amount + rounding
        pose[_joint("head"), 0] = -0.45 * amount

    return _on_the_spot(figure, upper, sink=0.005, depth=depth, tilt=tilt, stance=(0.08, 0.3))


def _on_the_spot(
    figure: Figure,
    upper: Callable[[Pose, float], None],
    *,
    sink: float,
    depth: float = 0.0,
    tilt: Callable[[float], float] = lambda _: 0.0,
    stance: tuple[float, float] = (0.0, 0.0),
) -> Motion:
    """There and back with planted feet.

    Args:
        upper: Sets the joints above the pelvis for an amount from 0 to 1 and back to 0.
        sink: How far the pelvis is held below full height, so that the knees can bend [m].
        depth: How far the pelvis goes down and, by a third of it, back [m].
        tilt: How far the pelvis leans forward for an amount [rad].
        stance: How far each foot is set outward [m] and turned outward [rad].
    """
    count = round(_HOLD * FPS)
    poses, positions = np.zeros((count, 24, 3)), np.zeros((count, 3))
    for frame in range(count):
        amount = _ease(1 - abs(2 * frame / (count - 1) - 1))
        pose = poses[frame]
        upper(pose, amount)
        pelvis = figure.standing - [0.0, sink + depth * amount, depth / 3 * amount]
        root = turn("x", tilt(amount))
        for side, (_, _, ankle, _) in LEGS.items():
            apart, toes_out = sign(side) * np.array(stance)
            target = figure.joints[ankle] + np.array([apart, -figure.floor, 0.0])
            foot = turn("y", toes_out)
            over_toes = target + foot @ [0.0, 0.4, 0.15] if depth else None
            bend_leg(figure, side, pose, (pelvis, root), (target, foot), knee_towards=over_toes)
        pose[0], positions[frame] = vector(root), pelvis - figure.joints[0]
    return Motion(poses, positions, fps=FPS)


def _foot_at(gait: Gait, side: str, cycle: float) -> FootPlacement:
    """The foot after ``cycle`` step cycles: flat, rolling, or swinging to the next print."""
    step, part = np.floor(cycle), cycle % 1
    position, heading = gait.footprint(side, step)
    if part < _STANCE:
        rolling = _ease((part - 0.38) / (_STANCE - 0.38)) ** 1.2
        pitch = _TOE_UP * (1 - _ease(part / 0.10)) + _HEEL_UP * rolling
        return FootPlacement(position, heading, pitch, lift=0.0, toe_bend=min(pitch, 0.0))
    swing = (part - _STANCE) / (1 - _STANCE)
    following, following_heading = gait.footprint(side, step + 1)
    along = _ease(swing)
    pitch = _HEEL_UP * (1 - _ease(swing / 0.55)) + _TOE_UP * _ease((swing - 0.45) / 0.55)
    return FootPlacement(
        position + along * (following - position),
        heading + along * (following_heading - heading),
        pitch,
        lift=0.05 * np.sin(np.pi * swing),
        toe_bend=min(pitch, 0.0) * (1 - _ease(swing / 0.4)),
    )


def _lower_arms(pose: Pose, *, left: float = 0.0, right: float = 0.0, bend: float = 0.25) -> None:
    """Let the arms hang, swung forward by an angle each; the elbow bends more when forward [rad]."""
    for side, swing in (("left", left), ("right", right)):
        outward = sign(side)
        pose[_joint(f"{side}_collar")] = [0.0, 0.0, -outward * np.radians(8)]
        pose[_joint(f"{side}_shoulder")] = vector(turn("x", -swing) @ turn("z", -outward * np.radians(66)))
        pose[_joint(f"{side}_elbow")] = [0.0, -outward * (bend + 0.5 * max(swing, 0.0)), 0.0]


def _set_pair(pose: Pose, joint: str, left: tuple[float, float, float]) -> None:
    """Set a left joint and its mirror image."""
    pose[_joint(f"left_{joint}")] = left
    pose[_joint(f"right_{joint}")] = np.array(left) * [1, -1, -1]


def _blend(start: Pose, end: Pose, amount: float) -> Pose:
    """Every joint turned from ``start`` towards ``end`` along the shortest arc."""
    first, last = Rotation.from_rotvec(start), Rotation.from_rotvec(end)
    return (first * Rotation.from_rotvec(amount * (first.inv() * last).as_rotvec())).as_rotvec()


def _ease(value: float) -> float:
    """0 below 0, 1 above 1, and a smooth step between."""
    clipped = min(max(value, 0.0), 1.0)
    return clipped * clipped * (3 - 2 * clipped)


def _joint(name: str) -> int:
    return JOINT_NAMES.index(name)


def _phase_lag(side: str) -> float:
    """The right foot steps half a cycle after the left."""
    return 0.0 if side == "left" else 0.5


def shipped_motions(body: Body) -> dict[str, Motion]:
    """All motions of the package, by name."""
    figure = Figure.of(body)
    return {
        "walk": walk(figure, Gait()),
        "turn": walk(figure, Gait(turn=0.9, speed=0.9, cadence=0.85)),
        "arm_raise": arm_raise(figure),
        "squat": squat(figure),
        "arms_crossed": arms_crossed(figure),
    }


def _write(motion: Motion, path: Path) -> None:
    poses = motion.poses.reshape(len(motion), 72).astype(np.float32)
    translation = motion.translation.astype(np.float32)
    unfinished = path.with_suffix(".npz.tmp")
    with unfinished.open("wb") as file:
        np.savez_compressed(file, poses=poses, trans=translation, mocap_framerate=motion.fps, up="y")
    os.replace(unfinished, path)


def main() -> None:
    """Write every shipped motion as an ``.npz`` with AMASS's keys."""
    parser = argparse.ArgumentParser(description="Make the motions that ship with the package.")
    parser.add_argument("--out", type=Path, required=True, help="folder to write the .npz files to")
    folder = parser.parse_args().out
    folder.mkdir(parents=True, exist_ok=True)
    for name, motion in shipped_motions(Body.load()).items():
        _write(motion, folder / f"{name}.npz")
        print(f"{name}: {len(motion)} frames at {motion.fps} fps")


if __name__ == "__main__":
    main()
