"""What a fit searches in, and how thoroughly."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from isp_assets.decode import RESOLUTIONS
from isp_assets.errors import InputError
from isp_assets.fit_objective import FitWeights

_FLOOR = 0.02  # smallest spread of the codes that counts, relative to the largest


@dataclass(frozen=True)
class FitOptions:
    """How thoroughly to fit."""

    neighbours: int = 3
    """Garments to start from, besides the mean."""
    trial_rounds: int = 2
    """How often the panels are cut anew from every start."""
    trial_iterations: int = 2
    """Gauss-Newton steps a round from every start: a start is far off, and its cut soon out of date."""
    finalists: int = 2
    """Starts to go on from, the best ones: the best in the beginning is not always the best in the end."""
    rounds: int = 12
    """How often the panels are cut anew from each of these, at the most."""
    iterations: int = 4
    """Gauss-Newton steps a round, at the most."""
    resolution: int = 64
    """Grid cells across a panel's square while fitting."""
    samples: int = 3000
    """Points on the target, and on the garment."""
    weights: FitWeights = field(default_factory=FitWeights)

    def __post_init__(self) -> None:
        low, high = RESOLUTIONS
        counts = min(self.trial_rounds, self.trial_iterations, self.finalists, self.rounds, self.iterations)
        if not low <= self.resolution <= high or self.samples < 100 or self.neighbours < 0 or counts < 1:
            raise InputError(
                f"fit: expected a resolution in {low}..{high} cells, 100 samples or more, no fewer than 0 "
                f"neighbours, and at least 1 finalist, round and iteration; got {self}"
            )


@dataclass(frozen=True, eq=False)
class CodeSpace:
    """Codes in units of their spread over the garments: zero is the mean, one is usual."""

    mean: Float[np.ndarray, " Z"]
    from_white: Float[np.ndarray, "Z Z"]

    @classmethod
    def of(cls, codes: Float[np.ndarray, "G Z"]) -> "CodeSpace":
        mean = codes.mean(axis=0, dtype=np.float64)
        # The spread of few codes says nothing about the directions that none of them takes.
        _, spread, axes = np.linalg.svd(codes - mean, full_matrices=False)
        spread = spread / np.sqrt(max(len(codes) - 1, 1))
        full = np.full(codes.shape[1], _FLOOR * max(float(spread.max(initial=0)), 1e-3))
        full[: len(spread)] = np.maximum(spread, full[: len(spread)])
        complete, _ = np.linalg.qr(np.concatenate([axes, np.eye(codes.shape[1])]).T)
        return cls(mean, complete[:, : codes.shape[1]] * full)

    def code(self, position: Float[np.ndarray, " Z"]) -> Float[np.ndarray, " Z"]:
        return self.mean + self.from_white @ position

    def position(self, code: Float[np.ndarray, " Z"]) -> Float[np.ndarray, " Z"]:
        return np.linalg.solve(self.from_white, code.astype(np.float64) - self.mean)
