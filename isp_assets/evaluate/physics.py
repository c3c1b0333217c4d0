"""How far is each rung of the draping ladder from a physical equilibrium?

The same garments are draped on the same frames by the library and by a reference: a
physics solver, or the minimum of the training energy. Per garment and rung: energies,
stretch, contact, distance to the reference's equilibrium, and time, in one run. The
rungs are then given to the solver as a start, to see whether it can go on from them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from isp_assets.errors import InputError
from isp_assets.evaluate.frames import FINAL, FrameMeter
from isp_assets.frames import DrapedFrames, FrameChunk, Layer, Scene, StageTimes
from isp_assets.geometry.energy import (
    ClothRest,
    Fabric,
    bending_energy,
    cloth_rest,
    gravity_energy,
    membrane_energy,
)
from isp_assets.physics import Cloth, PhysicsResult, PhysicsScene, PhysicsSolver, Reference

FIGURES: dict[str, str] = {
    "garment": "layer of the outfit",
    "state": "rung of the ladder, or state of the reference; the last row is the equilibrium",
    "membrane_mj": "StVK energy of stretch and shear against the flat panels [mJ]",
    "bending_mj": "energy of bending [mJ]",
    "above_mj": "membrane, bending and gravity together, above those of the equilibrium [mJ]",
    "strain_p99": "99th percentile of the relative change of edge lengths against the flat panels",
    "distance_mean_mm": "distance of vertices to the equilibrium, mean [mm]",
    "distance_p95_mm": "the same, 95th percentile [mm]",
    "body_area_percent": "share of the garment's area inside the body, where room was left for it [%]",
    "crossing_pairs": "pairs of triangles that cross the body or a layer beneath",
    "ms_per_frame": "time of a frame up to this rung, all garments together [ms]",
}
"""What each figure of a row means; all are means over the frames."""

HOLD_FIGURES: dict[str, str] = {
    "frame": "frame whose pose is held",
    "start": "rung that the solver starts from, at rest",
    "garment": "layer of the outfit",
    "steps": "undamped steps with the pose held",
    "finite": "whether all positions stay finite",
    "crossing_before": "pairs of triangles that cross the body or a layer beneath, at the start",
    "crossing_after": "the same, after the last step",
    "fastest_mps": "largest speed of a vertex of any garment in the first step [m/s]",
    "moved_mean_mm": "distance of vertices from the start after the last step, mean [mm]",
}
"""What each figure of a held start means."""

_LADDER = ("skin", "displace", "tuck", "layering", "project", "relax")
_DISTANCES = ("strain_p99", "body_area_percent", "crossing_pairs")

Progress = Callable[[int, int, str], None]


def silent(done: int, total: int, text: str) -> None:
    """Reports nothing."""


@dataclass(frozen=True)
class PhysicsOptions:
    """What to do besides comparing."""

    hold_frames: int = 2
    """Frames whose rungs are given to the solver as a start; spread over the range. 0 leaves this out."""
    hold_steps: int = 60
    """Steps with the pose held."""

    def __post_init__(self) -> None:
        if self.hold_frames < 0 or self.hold_steps < 1:
            raise InputError(f"evaluation: hold 0 frames or more, for 1 step or more; got {self}")


@dataclass(frozen=True, eq=False)
class PhysicsReport:
    """What came of the comparison."""

    rows: list[dict[str, Any]]
    """A row a garment and state; see `FIGURES`."""
    holds: list[dict[str, Any]] = field(default_factory=list)
    """A row a held start and garment; see `HOLD_FIGURES`."""
    details: dict[str, Any] = field(default_factory=dict)
    """Settings of the reference."""
    ladder: FrameChunk | None = None
    """All frames of the ladder with their stages, to look at."""
    result: PhysicsResult | None = None


def evaluate_physics(
    frames: DrapedFrames,
    reference: Reference,
    options: PhysicsOptions | None = None,
    *,
    fabric: Fabric | None = None,
    progress: Progress = silent,
) -> PhysicsReport:
    """Drape, simulate, compare.

    Args:
        frames: A draped shot of the mean body that keeps its stages. All frames are held in memory.
        reference: What gives the equilibrium.
        options: How many starts to hold.
        fabric: Material constants of both.
        progress: Called with (finished, total, what).

    Raises:
        InputError: If the frames keep no stages.
    """
    options, fabric = options or PhysicsOptions(), fabric or Fabric()
    progress(0, 3, "ladder")
    ladder = _join(list(frames))
    scene = _physics_scene(frames.scene, ladder, fabric)
    progress(1, 3, reference.name)
    result = reference.drape(scene)
    states, times = _states(ladder, reference.name, result)
    meter = _Meter(frames.scene, ladder, fabric)
    rows = meter.rows(states, times)
    progress(2, 3, "held starts")
    holds = []
    if isinstance(reference, PhysicsSolver) and options.hold_frames:
        rungs = {name: states[name] for name in states if name in _LADDER}
        holds = _hold(meter, scene, reference, rungs, options)
    progress(3, 3, "done")
    return PhysicsReport(rows, holds, result.details, ladder, result)


Positions = tuple[Float[np.ndarray, "T _ 3"], ...]


def _join(chunks: Sequence[FrameChunk]) -> FrameChunk:
    """All frames as one chunk. Times are per frame, without the first chunk where there are several."""
    if not chunks or not all(chunk.stages for chunk in chunks):
        raise InputError("evaluation: the frames keep no stages; drape with keep_stages=True")
    warm = chunks[1:] or chunks
    count = sum(len(chunk.frames) for chunk in warm)
    seconds = {
        stage: sum(chunk.times.seconds.get(stage, 0.0) for chunk in warm) / count
        for stage in chunks[0].times.seconds
    }
    return FrameChunk(
        frames=np.concatenate([chunk.frames for chunk in chunks]),
        body=np.concatenate([chunk.body for chunk in chunks]),
        layers=_stack([chunk.layers for chunk in chunks]),
        times=StageTimes(seconds),
        stages={stage: _stack([chunk.stages[stage] for chunk in chunks]) for stage in chunks[0].stages},
    )


def _stack(parts: Sequence[tuple[np.ndarray, ...]]) -> Positions:
    return tuple(np.concatenate(layer) for layer in zip(*parts, strict=True))


def _physics_scene(scene: Scene, ladder: FrameChunk, fabric: Fabric) -> PhysicsScene:
    cloths = tuple(
        Cloth(
            layer.name, layer.garment.faces, layer.garment.corner_xy.astype(np.float64),
            positions.astype(np.float64), layer.garment.anchors.astype(np.int64),
        )
        for layer, positions in zip(scene.layers, ladder.layers, strict=True)
    )  # fmt: skip
    rate = scene.fps / scene.frames.step
    return PhysicsScene(cloths, scene.body_faces, ladder.body.astype(np.float64), rate, fabric)


def _states(
    ladder: FrameChunk, name: str, result: PhysicsResult
) -> tuple[dict[str, Positions], dict[str, float]]:
    """Positions by state, and time per frame [s]; rungs that changed nothing are left out."""
    rungs = {**ladder.stages, "relax": ladder.layers}
    seconds = ladder.times.seconds
    spent, states, times = seconds.get("body", 0.0), {}, {}
    before: Positions | None = None
    for rung in _LADDER:
        spent += seconds.get(rung, 0.0)
        positions = rungs.get(rung)
        if positions is None or (before is not None and all(map(np.array_equal, before, positions))):
            continue
        before = states[rung] = positions
        times[rung] = spent
    for state, positions in result.states.items():
        states[f"{name} {state}"] = positions
        times[f"{name} {state}"] = result.seconds[state]
    return states, times


class _Meter:
    """Measures the states of one outfit."""

    def __init__(self, scene: Scene, ladder: FrameChunk, fabric: Fabric) -> None:
        self.scene, self.ladder, self.fabric = scene, ladder, fabric
        self._frames = FrameMeter(scene)
        self._rests = [_rest(layer, fabric) for layer in scene.layers]

    def contact(self, positions: Positions, index: int) -> list[dict[str, float]]:
        """Figures of every layer in one frame."""
        chunk = replace(self.ladder, layers=positions, stages={})
        found = self._frames.measure(chunk, index)
        names = [f"{FINAL}/{layer.name}/" for layer in self.scene.layers]
        return [{figure: found[name + figure] for figure in _DISTANCES} for name in names]

    def rows(self, states: dict[str, Positions], times: dict[str, float]) -> list[dict[str, Any]]:
        """A row a garment and state; the last state is the equilibrium."""
        goal = list(states.values())[-1]
        contact = {
            state: [self.contact(positions, t) for t in range(len(self.ladder.frames))]
            for state, positions in states.items()
        }
        rows = []
        for index, layer in enumerate(self.scene.layers):
            lowest = sum(self._energies(index, goal[index]).values())
            for state, positions in states.items():
                energies = self._energies(index, positions[index])
                figures = {
                    name: float(np.mean([frame[index][name] for frame in contact[state]]))
                    for name in _DISTANCES
                }
                distance = 1e3 * np.linalg.norm(positions[index] - goal[index], axis=-1)
                rows.append({
                    "garment": layer.name, "state": state,
                    "membrane_mj": energies["membrane"], "bending_mj": energies["bending"],
                    "above_mj": sum(energies.values()) - lowest,
                    "strain_p99": figures["strain_p99"],
                    "distance_mean_mm": float(distance.mean()),
                    "distance_p95_mm": float(np.percentile(distance, 95, axis=1).mean()),
                    "body_area_percent": figures["body_area_percent"],
                    "crossing_pairs": figures["crossing_pairs"],
                    "ms_per_frame": 1e3 * times[state],
                })  # fmt: skip
        return rows

    def _energies(self, index: int, positions: Float[np.ndarray, "T V 3"]) -> dict[str, float]:
        """Means over the frames [mJ]."""
        vertices, rest = torch.from_numpy(positions.astype(np.float64)), self._rests[index]
        terms = {
            "membrane": membrane_energy(vertices, rest, self.fabric),
            "bending": bending_energy(vertices, rest, self.fabric),
            "gravity": gravity_energy(vertices, rest),
        }
        return {name: 1e3 * float(value.mean()) for name, value in terms.items()}


def _rest(layer: Layer, fabric: Fabric) -> ClothRest:
    garment = layer.garment
    rest = cloth_rest(garment.faces, garment.corner_xy, garment.num_vertices, fabric)
    return rest.to(dtype=torch.float64)


def _hold(
    meter: _Meter,
    scene: PhysicsScene,
    solver: PhysicsSolver,
    rungs: dict[str, Positions],
    options: PhysicsOptions,
) -> list[dict[str, Any]]:
    """Give every rung to the solver as a start, in a few frames."""
    count = len(scene.body)
    rows = []
    for index in np.unique(np.linspace(0, count - 1, options.hold_frames).astype(int)).tolist():
        for rung, positions in rungs.items():
            start = tuple(layer[index] for layer in positions)
            held = solver.hold(scene, index, start, options.hold_steps)
            before = meter.contact(positions, index)
            after = None
            if held.finite:
                later = tuple(np.broadcast_to(p, (count, *p.shape)) for p in held.positions)
                after = meter.contact(later, index)
            for k, layer in enumerate(meter.scene.layers):
                moved = np.linalg.norm(held.positions[k] - start[k], axis=-1).mean()
                rows.append({
                    "frame": int(meter.ladder.frames[index]), "start": rung, "garment": layer.name,
                    "steps": options.hold_steps, "finite": held.finite,
                    "crossing_before": int(before[k]["crossing_pairs"]),
                    "crossing_after": int(after[k]["crossing_pairs"]) if after else None,
                    "fastest_mps": held.fastest if np.isfinite(held.fastest) else None,
                    "moved_mean_mm": 1e3 * float(moved) if held.finite else None,
                })  # fmt: skip
    return rows
