"""Draped frames: what `drape` yields and what plugins write. NumPy only from here on.

A shot is one static `Scene` and a stream of `FrameChunk`s; memory does not
grow with the number of frames.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int, UInt8

from isp_assets.conventions import FrameRange
from isp_assets.garment import Garment


@dataclass(frozen=True, eq=False)
class Layer:
    """One garment of the outfit, as every frame shares it."""

    name: str
    """``L00_tank_top``: index from the inside out, then the garment's name."""
    garment: Garment
    texture: UInt8[np.ndarray, "H W 3"]
    """sRGB image over `Garment.st`; row 0 is the top (t = 1)."""
    color: tuple[float, float, float]
    """Display colour, sRGB in 0..1."""
    graded_lengths: Float[np.ndarray, "F 3"] | None = None
    """Flat lengths of every face's edges, from each corner to the next, once its pattern is graded to the
    wearer [m]; None if it is worn as drawn."""

    @property
    def flat_lengths(self) -> Float[np.ndarray, "F 3"]:
        """The same, as drawn where nothing was graded [m]."""
        if self.graded_lengths is not None:
            return self.graded_lengths
        corner = self.garment.corner_xy
        return np.linalg.norm(np.roll(corner, -1, axis=1) - corner, axis=-1)


@dataclass(frozen=True, eq=False)
class Scene:
    """What does not change over a shot."""

    name: str
    body_faces: Int[np.ndarray, "Fb 3"]
    layers: tuple[Layer, ...]
    """Innermost first."""
    frames: FrameRange
    fps: float


@dataclass(frozen=True)
class StageTimes:
    """Seconds spent on one chunk, by stage."""

    seconds: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class FrameChunk:
    """A few consecutive frames."""

    frames: Int[np.ndarray, " T"]
    """Frame numbers."""
    body: Float[np.ndarray, "T N 3"]
    """Body vertices, world space [m]."""
    layers: tuple[Float[np.ndarray, "T _ 3"], ...]
    """Garment vertices per layer, world space [m], innermost first."""
    times: StageTimes
    stages: dict[str, tuple[Float[np.ndarray, "T _ 3"], ...]] = field(default_factory=dict)
    """Positions after earlier rungs of the ladder ("skin", "displace", "layering"), kept only on request."""
    steps: tuple[tuple[tuple[str, ...], ...], ...] = ()
    """Names of the steps that ran, per frame and layer."""
    metrics: tuple[dict[str, float], ...] = ()
    """Per frame: measured figures such as ``final/L01_trousers/body_area_percent``."""


@dataclass(frozen=True, eq=False)
class DrapedFrames:
    """A lazily draped shot: the scene, and chunks of frames made while iterating."""

    scene: Scene
    chunks: Iterator[FrameChunk]

    def __iter__(self) -> Iterator[FrameChunk]:
        return iter(self.chunks)
