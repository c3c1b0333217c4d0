"""How physics solvers plug in: what they are given, what they give back, and how they are found.

A solver drapes the garments that the library drapes, on the same frames, so that the
library's result can be compared with a physical equilibrium. It is a class with the
attributes of `PhysicsSolver`, registered under the entry point group
``isp_assets.solvers``. Positions are in metres, Y up, in world space; NumPy only.
"""

from dataclasses import dataclass, field
from importlib.metadata import entry_points
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from isp_assets.errors import PluginError
from isp_assets.geometry.energy import Fabric

GROUP = "isp_assets.solvers"


@dataclass(frozen=True, eq=False)
class Cloth:
    """One sewn garment of V vertices over T frames."""

    name: str
    faces: Int[np.ndarray, "F 3"]
    flat_corners: Float[np.ndarray, "F 3 2"]
    """Flat positions of every face's corners [m]: the rest metric. Faces may be wound either way."""
    start: Float[np.ndarray, "T V 3"]
    """A guess of the positions in every frame [m]."""
    held: Int[np.ndarray, " A"]
    """Vertices that the body holds; they follow ``start``."""


@dataclass(frozen=True, eq=False)
class PhysicsScene:
    """Garments over a moving body of N vertices."""

    cloths: tuple[Cloth, ...]
    """Innermost first."""
    body_faces: Int[np.ndarray, "Fb 3"]
    body: Float[np.ndarray, "T N 3"]
    fps: float = 30.0
    """Frames of ``body`` per second."""
    fabric: Fabric = field(default_factory=Fabric)

    def __post_init__(self) -> None:
        if not self.cloths or len(self.body) == 0 or not self.fps > 0:
            raise PluginError(
                f"a physics scene needs a garment, a frame and a rate above 0; got {len(self.cloths)} "
                f"garments, {len(self.body)} frames, {self.fps:g} frames a second"
            )
        for cloth in self.cloths:
            if len(cloth.start) != len(self.body):
                raise PluginError(
                    f"garment {cloth.name!r} has positions for {len(cloth.start)} frames, "
                    f"the body for {len(self.body)}"
                )


@dataclass(frozen=True, eq=False)
class PhysicsResult:
    """Positions that a solver found, by state, such as ``moving`` and ``settled``."""

    states: dict[str, tuple[Float[np.ndarray, "T _ 3"], ...]]
    """Per garment, in world space [m]. The last state is the equilibrium to compare with."""
    seconds: dict[str, float]
    """Time per frame of every state, all garments together."""
    details: dict[str, Any] = field(default_factory=dict)
    """Settings and versions; plain JSON values."""


@dataclass(frozen=True, eq=False)
class HoldResult:
    """What became of a start while the pose was held."""

    positions: tuple[Float[np.ndarray, "_ 3"], ...]
    """Per garment, after the last step [m]."""
    fastest: float
    """Largest speed of a vertex in the first step [m/s]; infinite if a position is not finite."""
    finite: bool
    """Whether all positions are finite after the last step."""


@runtime_checkable
class Reference(Protocol):
    """Finds equilibria of garments on a moving body."""

    name: str
    """Short name, as in ``--reference newton``."""
    version: str

    def drape(self, scene: PhysicsScene) -> PhysicsResult: ...


@runtime_checkable
class PhysicsSolver(Reference, Protocol):
    """A reference that moves cloth through time, and so can say whether a start suits it."""

    def hold(
        self, scene: PhysicsScene, frame: int, start: tuple[Float[np.ndarray, "_ 3"], ...], steps: int
    ) -> HoldResult:
        """Take ``steps`` steps from rest at ``start``, the body standing as in row ``frame``."""
        ...


def make_solver(name: str) -> PhysicsSolver:
    """A fresh solver by name.

    Raises:
        PluginError: If no solver of that name is installed, or it is broken.
        MissingExtraError: If the solver is there, but not the package behind it.
    """
    found = {point.name: point for point in entry_points(group=GROUP)}
    if name not in found:
        raise PluginError(f"no physics solver named {name!r}; found: {', '.join(sorted(found)) or 'none'}")
    try:
        solver = found[name].load()()
    except PluginError:
        raise
    except Exception as error:  # a foreign plugin may fail in any way
        raise PluginError(f"physics solver {name!r} is broken: {type(error).__name__}: {error}") from error
    if not isinstance(solver, PhysicsSolver):
        raise PluginError(f"physics solver {name!r} lacks attributes of PhysicsSolver")
    return solver
