"""The comparison with a physical equilibrium, for garments, a motion and a reference given by name."""

from collections.abc import Sequence
from dataclasses import dataclass

from isp_assets.body import Body
from isp_assets.collection import Collection
from isp_assets.conventions import FrameRange
from isp_assets.drape import DrapeOptions, drape
from isp_assets.evaluate.physics import PhysicsOptions, PhysicsReport, Progress, evaluate_physics, silent
from isp_assets.evaluate.physics_energy import EnergyReference
from isp_assets.motion import Motion
from isp_assets.physics import Reference, make_solver
from isp_assets.shot import Shot

_CHUNK = 4  # frames; the first chunk, which warms up, is left out of the times


@dataclass(frozen=True, eq=False)
class PhysicsTask:
    """A reference, a shot, and where garments come from."""

    reference: Reference
    shot: Shot
    collection: Collection
    resolution: int

    @classmethod
    def load(
        cls, reference: str, motion: str, frames: str, *, collection: str, resolution: int
    ) -> "PhysicsTask":
        """Look everything up by name; ``reference`` is ``energy`` or an installed solver.

        Raises:
            PluginError: If there is no such solver, or the package behind it is missing.
            MotionError, CollectionError: If motion, frames or collection are wrong.
        """
        found = EnergyReference() if reference == EnergyReference.name else make_solver(reference)
        moving = Motion.load(motion).select(FrameRange.parse(frames))
        shot = Shot(moving.name, Body.load("default"), moving)
        return cls(found, shot, Collection.load(collection), resolution)

    def evaluate(
        self, names: Sequence[str], options: PhysicsOptions | None = None, *, progress: Progress = silent
    ) -> PhysicsReport:
        """Drape an outfit by its garments' names and compare it; see `evaluate_physics`."""
        wanted = DrapeOptions(keep_stages=True, resolution=self.resolution, chunk=_CHUNK)
        frames = drape(self.collection.outfit(names), self.shot, wanted)
        return evaluate_physics(frames, self.reference, options, progress=progress)
