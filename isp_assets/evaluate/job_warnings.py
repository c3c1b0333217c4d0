"""What someone who ordered a job should look at: frames beyond the criteria, bodies beyond the training."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Int

from isp_assets.conventions import JOINT_NAMES
from isp_assets.evaluate.criteria import CRITERIA
from isp_assets.evaluate.frames import FINAL
from isp_assets.evaluate.trained_range import joint_angles, trained_angles
from isp_assets.frames import Layer
from isp_assets.shot import Shot
from isp_assets.train.poses import BETA_RANGE


def job_warnings(
    rows: Sequence[Mapping[str, Any]], layers: Sequence[Layer], shot: Shot
) -> list[dict[str, Any]]:
    """Warnings for the report of a job.

    Args:
        rows: Figures of every frame, as in the report, with its number under ``frame``.
        layers: The garments worn.
        shot: The body in motion.

    Returns:
        One for every layer and criterion, beta and joint: ``kind``, ``subject``, ``worst``,
        ``limit``, ``frames`` (where it concerns some frames only) and a ``message`` that says it all.
    """
    return [*_figures(rows, layers), *_betas(shot), *_poses(shot)]


def frame_list(frames: Int[np.ndarray, " n"]) -> str:
    """Frame numbers as people write them, ``"1-4, 9"``; a run is what follows in steps of one."""
    if len(frames) == 0:
        return ""
    runs = np.split(frames, np.flatnonzero(np.diff(frames) != 1) + 1)
    return ", ".join(f"{run[0]}" if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)


def _figures(rows: Sequence[Mapping[str, Any]], layers: Sequence[Layer]) -> list[dict[str, Any]]:
    found = []
    frames = np.array([row["frame"] for row in rows], int)
    for layer in layers:
        for criterion in CRITERIA:
            if criterion.figure is None:
                continue
            values = np.array([_value(row, layer, criterion.figure) for row in rows])
            bad = values > criterion.limit
            if bad.any():
                name = f"{layer.name}: {criterion.meaning}"
                found.append(_warning("figure", name, values[bad], criterion.limit, frames[bad]))
    return found


def _value(row: Mapping[str, Any], layer: Layer, figure: str) -> float:
    if figure == "flipped_percent":
        return 100 * float(row.get(f"{FINAL}/{layer.name}/flipped_faces", 0.0)) / len(layer.garment.faces)
    return float(row.get(f"{FINAL}/{layer.name}/{figure}", 0.0))


def _betas(shot: Shot) -> list[dict[str, Any]]:
    beyond = np.flatnonzero(np.abs(shot.betas) > BETA_RANGE)
    return [
        _warning("shape", f"beta {k} beyond training", np.abs(shot.betas[[k]]), BETA_RANGE) for k in beyond
    ]


def _poses(shot: Shot) -> list[dict[str, Any]]:
    angles, limits = joint_angles(shot.motion.poses), trained_angles()
    found = []
    for joint in np.flatnonzero((angles > limits).any(0)):
        bad = angles[:, joint] > limits[joint]
        what = "body leans" if joint == 0 else f"{JOINT_NAMES[joint]} turns"
        name = f"{what} beyond 99.9 % of training [degrees]"
        found.append(
            _warning("pose", name, angles[bad, joint], float(limits[joint]), shot.motion.frames[bad])
        )
    return found


def _warning(
    kind: str, subject: str, values: np.ndarray, limit: float, frames: Int[np.ndarray, " n"] | None = None
) -> dict[str, Any]:
    worst = float(values.max())
    message = f"{subject}: {worst:.3g}, limit {limit:.3g}"
    warning: dict[str, Any] = {"kind": kind, "subject": subject, "worst": worst, "limit": float(limit)}
    if frames is not None:
        warning["frames"] = frame_list(frames)
        message += f"; {len(frames)} frames: {warning['frames']}"
    return warning | {"message": message}
