"""The solver ``newton``."""

import time
from dataclasses import asdict, replace

import numpy as np
from jaxtyping import Float

from isp_assets.physics import HoldResult, PhysicsResult, PhysicsScene

from .options import NewtonOptions
from .simulation import Simulation, import_newton

_SETTLE_STEP = 1 / 120  # time of a step while the pose is held and damped [s]


class NewtonSolver:
    """Drapes all garments of a scene together with `newton.solvers.SolverStyle3D`.

    The cloth moves with the body, from the first frame's start settled. In every frame a copy of it
    is brought to rest with the pose held, which gives the equilibrium; the motion goes on from the
    state before that. The body does not travel: its mean horizontal position is held still.

    Raises:
        MissingExtraError: If newton is not installed.
    """

    name = "newton"

    def __init__(self, options: NewtonOptions | None = None) -> None:
        newton, warp = import_newton()
        self.options = options or NewtonOptions()
        self.version = f"newton {newton.__version__}, warp {warp.__version__}"

    def drape(self, scene: PhysicsScene) -> PhysicsResult:
        """Simulate all frames: states ``moving`` and ``settled``.

        Frame 0 of ``moving`` is at rest; times leave out building the model and compiling its kernels.
        """
        options, travel = self.options, _travel(scene.body)
        still = _without(scene, travel)
        simulation = Simulation(still, options)
        held = [_held(still, t) for t in range(len(still.body))]
        simulation.place(np.concatenate([cloth.start[0] for cloth in still.cloths]))
        self._settle(simulation, still.body[0], held[0], options.first_settle)
        moving, settled, spent, steps = [], [], {"moving": [], "settled": []}, []
        for t in range(len(still.body)):
            if t:
                began = time.perf_counter()
                for part in np.arange(1, options.substeps + 1) / options.substeps:
                    body = still.body[t - 1] + part * (still.body[t] - still.body[t - 1])
                    pins = held[t - 1] + part * (held[t] - held[t - 1])
                    simulation.step(body, pins, 1 / (still.fps * options.substeps))
                spent["moving"].append(time.perf_counter() - began)
            state = simulation.save()
            moving.append(simulation.split(state[0] + travel[t]))
            began = time.perf_counter()
            steps.append(self._settle(simulation, still.body[t], held[t], options.settle))
            spent["settled"].append(time.perf_counter() - began)
            settled.append(simulation.split(simulation.save()[0] + travel[t]))
            simulation.restore(state)
        return PhysicsResult(
            states={"moving": _by_garment(moving), "settled": _by_garment(settled)},
            seconds={name: float(np.mean(values or [0.0])) for name, values in spent.items()},
            details={"version": self.version, "settling_steps": steps, **asdict(options)},
        )

    def hold(
        self, scene: PhysicsScene, frame: int, start: tuple[Float[np.ndarray, "_ 3"], ...], steps: int
    ) -> HoldResult:
        """Take undamped substeps from rest at ``start``, the body standing as in row ``frame``."""
        row = slice(frame, frame + 1)
        cloths = tuple(
            replace(cloth, start=positions[None].astype(np.float64))
            for cloth, positions in zip(scene.cloths, start, strict=True)
        )
        one = replace(scene, cloths=cloths, body=scene.body[row])
        travel = _travel(one.body)
        one = _without(one, travel)
        simulation, held = Simulation(one, self.options), _held(one, 0)
        fastest = 0.0
        for step in range(steps):
            speed = simulation.step(one.body[0], held, 1 / (one.fps * self.options.substeps))
            if step == 0:
                fastest = float(speed.max()) if np.isfinite(speed).all() else float("inf")
        positions = simulation.save()[0]
        return HoldResult(
            simulation.split(positions + travel[0]), fastest, bool(np.isfinite(positions).all())
        )

    def _settle(self, simulation: Simulation, body: np.ndarray, held: np.ndarray, steps: int) -> int:
        """Damped steps until the cloth is at rest; returns how many were taken."""
        options = self.options
        for step in range(steps):
            speed = simulation.step(body, held, _SETTLE_STEP)
            simulation.damp(options.damping, options.speed_limit)
            if step >= 10 and float(np.sqrt((speed**2).mean())) < options.still:
                return step + 1
        return steps


def _travel(body: Float[np.ndarray, "T N 3"]) -> Float[np.ndarray, "T 1 3"]:
    """The body's mean position in every frame, heights left alone [m]."""
    return body.mean(1, keepdims=True, dtype=np.float64) * (1.0, 0.0, 1.0)


def _without(scene: PhysicsScene, travel: Float[np.ndarray, "T 1 3"]) -> PhysicsScene:
    cloths = tuple(replace(cloth, start=cloth.start - travel) for cloth in scene.cloths)
    return replace(scene, body=scene.body - travel, cloths=cloths)


def _held(scene: PhysicsScene, frame: int) -> Float[np.ndarray, "A 3"]:
    return np.concatenate([cloth.start[frame][cloth.held] for cloth in scene.cloths])


def _by_garment(frames: list[tuple[np.ndarray, ...]]) -> tuple[Float[np.ndarray, "T _ 3"], ...]:
    return tuple(np.stack(rows) for rows in zip(*frames, strict=True))
