"""What is known of a chunk of frames while its layers are draped, one after the other."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from jaxtyping import Float
from torch import Tensor

from isp_assets.geometry.buried import BodyObstacle
from isp_assets.geometry.contact import Surface
from isp_assets.geometry.obstacle import Obstacle


class ChunkState:
    """What the layers of one chunk hand on to the next layer."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.beneath: list[Surface] = []
        self.skinned: list[Float[Tensor, "T V 3"]] = []
        """Every layer before it was displaced."""
        self.bodies: list[BodyObstacle] = []
        """Per frame: what lies beneath all layers."""
        self.finished: list[list[Obstacle]] = []
        """Per finished layer and frame."""
        self.stages: dict[str, list[np.ndarray]] = {}
        self.steps: list[list[list[str]]] = []
        """Per layer and frame: names of the rungs that ran."""

    @property
    def obstacles(self) -> list[list[Obstacle]]:
        """Per frame: the body, then every finished layer."""
        return [list(frame) for frame in zip(self.bodies, *self.finished, strict=True)]

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start

    def keep(self, stage: str, vertices: Float[Tensor, "T V 3"], wanted: bool) -> None:
        if wanted:
            self.stages.setdefault(stage, []).append(vertices.cpu().numpy())


def note(ran: list[list[str]], step: str, where: np.ndarray | None = None) -> None:
    """Add a rung to those that ran, in every frame or in some."""
    for t, steps in enumerate(ran):
        if where is None or where[t]:
            steps.append(step)
