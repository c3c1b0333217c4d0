"""Pictures of single frames of stress cases, drawn by the writer plugin ``sheet``."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from isp_assets.conventions import FrameRange
from isp_assets.evaluate.stress_case import StressCase, StressRun
from isp_assets.frames import FrameChunk, Scene, StageTimes
from isp_assets.plugin import make_writer


@dataclass(frozen=True, eq=False)
class Picture:
    """One frame to draw."""

    scene: Scene
    chunk: FrameChunk

    @classmethod
    def of(cls, case: StressCase, run: StressRun, frame: int, severity: float) -> "Picture":
        """A frame of a run, titled with its test, the sweep's value and how bad it is."""
        text = (
            f"{case.test} {case.label}: {case.parameter} {case.values[frame]:g}, {severity:.2g} x the limit"
        )
        number = frame + 1
        scene = replace(run.scene, name=text, frames=FrameRange(number, number))
        layers = tuple(layer[frame : frame + 1] for layer in run.layers)
        return cls(scene, FrameChunk(np.array([number]), run.body[frame : frame + 1], layers, StageTimes()))


def draw(picture: Picture, path: Path) -> None:
    """Draw a frame from the front, the side and the back into a PNG.

    Raises:
        PluginError: If the plugin ``sheet`` is missing or fails.
    """
    writer = make_writer("sheet")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        writer.begin(path, picture.scene)
        writer.add(picture.chunk)
        writer.finish()
    except BaseException:
        writer.abort()
        raise
