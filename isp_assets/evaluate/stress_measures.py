"""Figures of a stress case, sweep value by sweep value: rows of the draping table."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from isp_assets.displacement import anchor_ramp
from isp_assets.evaluate.criteria import failures, severity
from isp_assets.evaluate.frames import FINAL, FrameMeter
from isp_assets.evaluate.stress_case import BEFORE, StressCase, StressRun
from isp_assets.evaluate.temporal import jerk_ratio, jump_ratios, noise_gain, skin_beneath
from isp_assets.frames import FrameChunk, StageTimes

FIGURES: dict[str, str] = {
    "parameter": "what is swept",
    "value": "its value in the frames of this row",
    "frames": "frames of this row",
    "layers": "garments worn",
    "body_area_mean": "area inside the body, where room was left for cloth, of the worst layer: mean [%]",
    "body_area_max": "the same in the worst frame [%]",
    "body_unavoidable_max": "area inside the body where the body leaves no room for cloth, worst frame [%]",
    "inner_area_mean": "area inside a layer beneath, of the worst layer: mean [%]",
    "inner_area_max": "the same in the worst frame [%]",
    "inner_unavoidable_max": "the same where the body leaves no room for so many layers [%]",
    "before_body_area_max": "inside the body before projection, worst frame [%]",
    "before_inner_area_max": "inside a layer beneath before projection, worst frame [%]",
    "crossing_pairs": "pairs of triangles that cross, with anything beneath: worst layer and frame",
    "deepest_mm": "largest avoidable depth on the wrong side [mm]",
    "strain_p99_mean": "99th percentile of the strain, worst layer: mean",
    "strain_p99_max": "the same in the worst frame",
    "flipped_percent": "faces folded over, worst layer and frame [%]",
    "jump_ratio": "longest way of a garment vertex from frame to frame over the longest of the body, largest",
    "before_jump_ratio": "the same before projection",
    "anchor_jump_ratio": "the same for cloth within 3 cm of a waistband, after projection",
    "jerk_ratio": "jerk of a garment over that of the skin beneath it, worst layer",
    "before_jerk_ratio": "the same before projection",
    "noise_gain": "scatter of a garment under noise in the pose over that of the skin beneath, worst layer",
    "before_noise_gain": "the same before projection",
    "far_percent": "vertices more than 15 cm off the body, worst layer and frame [%]",
    "corrected_3cm": "vertices that projection moved by more than 3 cm, worst layer and frame",
    "corrected_mm": "longest way of a vertex in projection [mm]",
    "difference_mm": "largest distance from the reference run [mm]",
    "before_difference_mm": "the same before projection",
    "non_finite": "positions that are NaN or infinite",
    "seconds": "time that a frame took [s]",
    "passed": "whether every criterion holds",
    "failed": "which do not",
}
"""What each column means, after ``test`` and ``case``."""

_FAR = 0.15  # [m]
_LONG = 0.03  # [m]


@dataclass(frozen=True, eq=False)
class Measured:
    """What came of one case."""

    rows: list[dict[str, Any]]
    """One for every value of the sweep."""
    worst: int
    """The frame with the worst figures."""
    severity: float
    """How bad that is, in multiples of a criterion's limit."""


def measure(case: StressCase, run: StressRun) -> Measured:
    """Measure the frames of a case and sum them up by sweep value."""
    frames = _frame_figures(case, run)
    values = np.array(case.values, float)
    rows = []
    for value in dict.fromkeys(case.values):
        of_value = values == value
        chosen = [frames[t] for t in np.flatnonzero(of_value)]
        row: dict[str, Any] = {
            "test": case.test, "case": case.label, "parameter": case.parameter, "value": float(value),
            "frames": len(chosen), "layers": len(run.layers),
        }  # fmt: skip
        row |= _summed_up(chosen) | _over_time(case, run, of_value)
        row["seconds"] = run.seconds / len(case.values)
        failed = failures(row)
        rows.append(row | {"passed": not failed, "failed": "; ".join(failed)})
    bad = [severity(_summed_up([frame])) for frame in frames]
    return Measured(rows, int(np.argmax(bad)), float(max(bad)))


def _frame_figures(case: StressCase, run: StressRun) -> list[dict[str, float]]:
    """Figures of every frame, the worst layer each."""
    meter = FrameMeter(run.scene)
    faces = {layer.name: len(layer.garment.faces) for layer in run.scene.layers[run.placed :]}
    series = {name: SERIES[name](run) for name in case.measures if name in SERIES}
    frames = []
    for t in range(len(case.values)):
        bad = sum(int((~np.isfinite(layer[t])).sum()) for layer in run.layers)
        figures = {"non_finite": float(bad)}
        if t % case.measure_every == 0 and not bad:
            stages = {} if run.before is None else {BEFORE: tuple(p[t : t + 1] for p in run.before)}
            layers = tuple(p[t : t + 1] for p in run.layers)
            chunk = FrameChunk(np.array([t]), run.body[t : t + 1], layers, StageTimes(), stages)
            figures |= _worst_layer(meter.measure(chunk, 0, stages=True), faces)
        for columns in series.values():
            figures |= {name: float(v[t]) for name, v in columns.items() if np.isfinite(v[t])}
        if run.difference is not None:
            figures["difference_mm"] = 1e3 * float(run.difference[t])
        if run.difference_before is not None:
            figures["before_difference_mm"] = 1e3 * float(run.difference_before[t])
        frames.append(figures)
    return frames


def _worst_layer(figures: Mapping[str, float], faces: Mapping[str, int]) -> dict[str, float]:
    """The largest of every figure over the layers that ``faces`` counts the faces of."""
    found: dict[str, float] = {}
    for key, value in figures.items():
        stage, layer, figure = key.split("/")
        if layer not in faces:
            continue
        if figure == "flipped_faces":
            figure, value = "flipped_percent", 100 * value / faces[layer]
        elif figure.endswith("_unavoidable_percent"):
            figure = figure.replace("percent", "max")
        name = figure if stage == FINAL else f"before_{figure}"
        found[name] = max(found.get(name, 0.0), value)
    return found


_MEAN_AND_MAX = {
    "body_area_percent": "body_area",
    "inner_area_percent": "inner_area",
    "strain_p99": "strain_p99",
}
_MAX = (
    "body_unavoidable_max", "inner_unavoidable_max", "crossing_pairs", "deepest_mm",
    "flipped_percent", "jump_ratio", "before_jump_ratio",
    "anchor_jump_ratio", "far_percent",
    "corrected_3cm", "corrected_mm", "difference_mm", "before_difference_mm",
)  # fmt: skip


def _summed_up(frames: list[dict[str, float]]) -> dict[str, float]:
    row: dict[str, float] = {}
    for figure, name in _MEAN_AND_MAX.items():
        if values := [frame[figure] for frame in frames if figure in frame]:
            row[f"{name}_mean"], row[f"{name}_max"] = float(np.mean(values)), float(np.max(values))
        if values := [frame[f"before_{figure}"] for frame in frames if f"before_{figure}" in frame]:
            row[f"before_{name}_max"] = float(np.max(values))
    row.pop("before_strain_p99_max", None)
    for figure in _MAX:
        if values := [frame[figure] for frame in frames if figure in frame]:
            row[figure] = float(np.max(values))
    row["non_finite"] = float(sum(frame["non_finite"] for frame in frames))
    return row


def _over_time(case: StressCase, run: StressRun, rows: Bool[np.ndarray, " T"]) -> dict[str, float]:
    """Figures that take all frames of a value together."""
    found: dict[str, float] = {}
    for name, figure in (("jerk_ratio", jerk_ratio), ("noise_gain", noise_gain)):
        if name in case.measures and rows.sum() >= 4:
            for prefix, layers in (("", run.layers), ("before_", run.before or ())):
                ratios = [_against_skin(run, layer, rows, name, figure) for layer in layers]
                found |= {f"{prefix}{name}": max(ratios)} if ratios else {}
    return {name: value for name, value in found.items() if np.isfinite(value)}


def _against_skin(
    run: StressRun,
    layer: Float[np.ndarray, "T V 3"],
    rows: Bool[np.ndarray, " T"],
    name: str,
    figure: Callable[..., float],
) -> float:
    nearest = skin_beneath(layer[0], run.body[0])
    garment, skin = layer[rows], run.body[rows][:, nearest]
    return figure(garment, skin, run.scene.fps) if name == "jerk_ratio" else figure(garment, skin)


def _jumps(run: StressRun) -> dict[str, Float[np.ndarray, " T"]]:
    states = {"jump_ratio": run.layers, "before_jump_ratio": run.before or ()}
    return {
        name: np.max([jump_ratios(layer, run.body) for layer in layers], axis=0)
        for name, layers in states.items()
        if layers
    }


def _anchor_jumps(run: StressRun) -> dict[str, Float[np.ndarray, " T"]]:
    ratios = [
        jump_ratios(positions[:, held], run.body)
        for layer, positions in zip(run.scene.layers, run.layers, strict=True)
        if (held := _held(anchor_ramp(layer.garment))).size
    ]
    return {"anchor_jump_ratio": np.max(ratios, axis=0)} if ratios else {}


def _held(ramp: Float[np.ndarray, " V"]) -> Int[np.ndarray, " n"]:
    return np.flatnonzero(ramp < 1)


def _far(run: StressRun) -> dict[str, Float[np.ndarray, " T"]]:
    trees = [cKDTree(body, balanced_tree=False) for body in run.body]
    shares = [
        [
            100 * float((tree.query(points)[0] > _FAR).mean())
            for tree, points in zip(trees, layer, strict=True)
        ]
        for layer in run.layers
    ]
    return {"far_percent": np.max(shares, axis=0)}


def _corrections(run: StressRun) -> dict[str, Float[np.ndarray, " T"]]:
    if run.before is None:
        return {}
    ways = [np.linalg.norm(p - q, axis=2) for p, q in zip(run.layers, run.before, strict=True)]
    return {
        "corrected_3cm": np.max([(way > _LONG).sum(1) for way in ways], axis=0).astype(float),
        "corrected_mm": 1e3 * np.max([way.max(1) for way in ways], axis=0),
    }


SERIES: dict[str, Callable[[StressRun], dict[str, Float[np.ndarray, " T"]]]] = {
    "jumps": _jumps, "anchor_jumps": _anchor_jumps, "far": _far, "corrections": _corrections,
}  # fmt: skip
"""Figures frame by frame that a case may ask for; besides ``jerk_ratio`` and ``noise_gain``."""
