"""The conventions every module shares: units, axes, frame numbers, names.

Metres, seconds, radians. Y is up, a body at rest faces +Z, and its left is +X.
Frames are whole numbers, and ranges include both ends.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass

from isp_assets.errors import MotionError

UP_AXIS = "Y"
METRES_PER_UNIT = 1.0
GRAVITY = 9.81
"""Standard gravity [m/s^2], along -Y."""

PANELS = ("front", "back")
"""The two panels of every garment, in storage order."""

JOINT_NAMES = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle",
    "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head",
    "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
    "left_hand", "right_hand",
)  # fmt: skip
JOINT_PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
NUM_JOINTS = len(JOINT_NAMES)

_RANGE = re.compile(r"^(-?\d+)(?:-(-?\d+))?(?:x(\d+))?$")


@dataclass(frozen=True)
class FrameRange:
    """Frame numbers ``start``, ``start + step``, ... up to and including ``end``."""

    start: int
    end: int
    step: int = 1

    def __post_init__(self) -> None:
        if self.step < 1:
            raise MotionError(f"frame step must be at least 1, got {self.step}")
        if self.end < self.start:
            raise MotionError(
                f"frame range {self.start}-{self.end} ends before it starts; swap the two numbers"
            )

    @classmethod
    def parse(cls, text: str) -> "FrameRange":
        """Read ``"1001-1096"``, ``"1001-1096x2"`` or ``"1001"``.

        Raises:
            MotionError: If the text is no frame range.
        """
        match = _RANGE.match(text.strip())
        if match is None:
            raise MotionError(
                f"not a frame range: {text!r}; expected START-END or START-ENDxSTEP, as in 1001-1096x2"
            )
        start, end, step = match.groups()
        return cls(int(start), int(end if end is not None else start), int(step or 1))

    def __iter__(self) -> Iterator[int]:
        return iter(range(self.start, self.end + 1, self.step))

    def __len__(self) -> int:
        return (self.end - self.start) // self.step + 1

    def __contains__(self, frame: object) -> bool:
        return isinstance(frame, int) and frame in range(self.start, self.end + 1, self.step)

    def __str__(self) -> str:
        return f"{self.start}-{self.end}" + (f"x{self.step}" if self.step > 1 else "")
