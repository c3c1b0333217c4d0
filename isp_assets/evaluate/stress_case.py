"""One stress case: an outfit, a motion whose frames sweep one parameter, and how to drape it."""

import hashlib
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float

from isp_assets.drape import DrapeOptions, drape
from isp_assets.errors import InputError
from isp_assets.frames import Scene
from isp_assets.outfit import Outfit
from isp_assets.shot import Shot

BEFORE = "layering"
"""The rung after which only projecting and relaxing are left."""


@dataclass(frozen=True, eq=False)
class StressRun:
    """T draped frames of a case."""

    scene: Scene
    body: Float[np.ndarray, "T N 3"]
    layers: tuple[Float[np.ndarray, "T _ 3"], ...]
    """World space [m], innermost first."""
    before: tuple[Float[np.ndarray, "T _ 3"], ...] | None
    """The same before projection."""
    seconds: float
    """Time that draping took, for all frames, without decoding and binding."""
    placed: int = 0
    """So many of the innermost layers are put in the way by the test, and are not judged."""
    difference: Float[np.ndarray, " T"] | None = None
    """Largest distance of any vertex from a reference run [m], where the case has one."""
    difference_before: Float[np.ndarray, " T"] | None = None
    """The same before projection [m]."""


@dataclass(frozen=True, eq=False)
class StressCase:
    """What to drape, and what the frames sweep."""

    test: str
    """``T4``"""
    label: str
    """Cases of one test and label are one sweep."""
    parameter: str
    """What is swept, with its unit."""
    values: tuple[float, ...]
    """Value of the parameter in every frame, from harmless to hard."""
    outfit: Outfit
    shot: Shot
    options: DrapeOptions = field(default_factory=lambda: DrapeOptions(resolution=64))
    measures: tuple[str, ...] = ()
    """Further figures, by name; see `isp_assets.evaluate.stress_measures`."""
    measure_every: int = 1
    """Contact and strain are measured in every n-th frame."""
    run: Callable[..., StressRun] | None = None
    """How to drape it, if not simply by `drape_case`."""

    def __post_init__(self) -> None:
        if len(self.values) != len(self.shot.motion):
            raise InputError(
                f"stress case {self.test} {self.label}: expected a value for each of "
                f"{len(self.shot.motion)} frames, got {len(self.values)}"
            )

    @property
    def key(self) -> str:
        """A file name that no other case of a run has."""
        text = f"{self.test}_{self.label}_{self.values[0]:g}"
        return re.sub(r"[^A-Za-z0-9.+-]+", "_", text)

    def fingerprint(self, networks: str) -> str:
        """Digest of everything the case's figures depend on.

        Args:
            networks: Digest of the collection's files.
        """
        motion, digest = self.shot.motion, hashlib.sha256()
        parts: list[object] = [
            networks, self.test, self.label, self.parameter, self.values, self.options, self.measures,
            self.measure_every, motion.fps, self.shot.body.sha256, [item.name for item in self.outfit],
        ]  # fmt: skip
        digest.update(repr(parts).encode())
        arrays = [motion.poses, motion.translation, self.shot.betas, *(item.code for item in self.outfit)]
        for array in arrays:
            digest.update(np.ascontiguousarray(array, np.float64).tobytes())
        return digest.hexdigest()

    def part(self, rows: Bool[np.ndarray, " T"]) -> "StressCase":
        """The case with some of its frames only."""
        motion = self.shot.motion
        frames = replace(motion, poses=motion.poses[rows], translation=motion.translation[rows])
        values = tuple(value for value, kept in zip(self.values, rows, strict=True) if kept)
        return replace(self, values=values, shot=replace(self.shot, motion=frames))

    def drape(self) -> StressRun:
        """Drape it in its own way."""
        return drape_case(self) if self.run is None else self.run(self)


def drape_case(case: StressCase) -> StressRun:
    """Drape a case and keep all its frames.

    Raises:
        IspAssetsError: As `isp_assets.drape.drape`.
    """
    draped = drape(case.outfit, case.shot, replace(case.options, keep_stages=True))
    start = time.perf_counter()
    chunks = list(draped)
    seconds = time.perf_counter() - start
    count = len(draped.scene.layers)
    return StressRun(
        scene=draped.scene,
        body=np.concatenate([chunk.body for chunk in chunks]),
        layers=tuple(np.concatenate([chunk.layers[k] for chunk in chunks]) for k in range(count)),
        before=tuple(np.concatenate([chunk.stages[BEFORE][k] for chunk in chunks]) for k in range(count)),
        seconds=seconds,
    )
