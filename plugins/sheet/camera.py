"""Where a picture is taken from: a turntable camera that frames what it is given."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

_FIELD_OF_VIEW = np.radians(18.0)  # a long lens: bodies keep their proportions
_BACKDROP = ((0.86, 0.87, 0.89), (0.70, 0.71, 0.74))  # linear light, top and bottom
_LIGHT = np.array([-0.55, 1.05, 0.75])  # over the camera's left shoulder: right, up, towards the camera
_LIGHT_RADIUS = 0.12


@dataclass(frozen=True)
class Camera:
    """A camera on a turntable round ``target``."""

    yaw: float = 0.0
    """Degrees round Y: 0 sees the front, 90 the body's left, 180 the back."""
    pitch: float = 8.0
    """Degrees above the horizon."""
    target: tuple[float, float, float] | None = None
    """Point in the middle of the picture [m]; ``None`` for the middle of what is drawn."""
    height: float | None = None
    """World height that the picture spans at the target [m]; ``None`` to fit what is drawn."""


@dataclass(frozen=True, eq=False)
class View:
    """A camera placed in the world, for one picture size."""

    eye: Float[np.ndarray, " 3"]
    target: Float[np.ndarray, " 3"]
    axes: Float[np.ndarray, "3 3"]
    """Rows: right, up, back (towards the camera)."""
    height: float
    """World height in the picture at the target [m]."""
    size: tuple[int, int]

    @classmethod
    def place(cls, camera: Camera, points: Float[np.ndarray, "n 3"], size: tuple[int, int]) -> "View":
        """The camera for a picture of ``points`` [m]."""
        yaw, pitch = np.radians([camera.yaw, camera.pitch])
        back = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
        right = np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
        axes = np.stack([right, np.cross(back, right), back])
        target = (
            (points.min(0) + points.max(0)) / 2 if camera.target is None else np.array(camera.target, float)
        )
        height = _fit(points - target, axes, size) if camera.height is None else camera.height
        distance = height / 2 / np.tan(_FIELD_OF_VIEW / 2)
        return cls(target + distance * back, target, axes, height, size)

    @property
    def metres_per_pixel(self) -> float:
        return self.height / self.size[1]

    def rays(self, jitter: tuple[float, float]) -> Float[np.ndarray, "n 3"]:
        """Directions from the eye through one point of every pixel, row by row from the top left."""
        width, height = self.size
        x = (np.arange(width) + jitter[0] - width / 2) * self.metres_per_pixel
        y = (height / 2 - np.arange(height) - jitter[1]) * self.metres_per_pixel
        right, up, _ = self.axes
        across = (x[:, None] * right + (self.target - self.eye)).astype(np.float32)
        down = (y[:, None] * up).astype(np.float32)
        return (down[:, None] + across[None]).reshape(-1, 3)

    def light(self, step: int, steps: int) -> Float[np.ndarray, " 3"]:
        """Unit direction to one point of the lamp; all steps together spread evenly over its disc."""
        radius, angle = _LIGHT_RADIUS * np.sqrt((step + 0.5) / steps), step * np.pi * (3 - np.sqrt(5))
        direction = _LIGHT / np.linalg.norm(_LIGHT) + radius * np.array([np.cos(angle), np.sin(angle), 0.0])
        return (direction / np.linalg.norm(direction)) @ self.axes

    def backdrop(self) -> Float[np.ndarray, "H W 3"]:
        """The empty picture in linear light: a soft vertical ramp."""
        width, height = self.size
        mix = np.linspace(0.0, 1.0, height)[:, None, None]
        return np.repeat((1 - mix) * np.array(_BACKDROP[0]) + mix * np.array(_BACKDROP[1]), width, axis=1)


def _fit(offsets: Float[np.ndarray, "n 3"], axes: Float[np.ndarray, "3 3"], size: tuple[int, int]) -> float:
    """Height that shows all points with a small margin, nearer points counted larger."""
    across, up, back = np.abs(offsets @ axes[0]), np.abs(offsets @ axes[1]), offsets @ axes[2]
    need = 2.0 * np.maximum(up, across * size[1] / size[0])
    return float((1.04 * need + 2.0 * np.maximum(back, 0.0) * np.tan(_FIELD_OF_VIEW / 2)).max()) or 1.0
