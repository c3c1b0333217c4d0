"""The search of a fit: whitened codes, and rounds of cutting the panels and optimising.

Between cuts the border follows the code to first order (Eq. 5), so that each round is a
smooth problem of few variables.

Reference: Li, Guillard and Fua, "ISP: Multi-Layered Garment Draping with
Implicit Sewing Patterns", NeurIPS 2023, Eq. 5.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import minimize
from torch import Tensor

from isp_assets.decode import RESOLUTIONS, SLIVER, border_slopes, cut_panels, lift_points, weld_points
from isp_assets.errors import DecodeError, GeometryError, InputError
from isp_assets.fit_objective import Distance, FitWeights, Target
from isp_assets.garment_model import GarmentModel
from isp_assets.geometry.sewing import SewnPanels, sew_panels

_REACH = 1.5  # farthest that one round may move a whitened code, and a shift in its units
_FLOOR = 0.02  # smallest spread of the codes that counts, relative to the largest
_SHIFT_UNIT = 0.02  # of the variables that stand for a shift [m]
_RETREATS = 5

Objective = Callable[[Float[np.ndarray, " n"]], tuple[float, Float[np.ndarray, " n"]]]


@dataclass(frozen=True)
class FitOptions:
    """How thoroughly to fit."""

    neighbours: int = 3
    """Garments to start from, besides the mean."""
    trial_iterations: int = 8
    """Of L-BFGS from every start."""
    rounds: int = 8
    """How often the panels are cut anew, from the best start on."""
    iterations: int = 50
    """Of L-BFGS a round, at the most."""
    resolution: int = 64
    """Grid cells across a panel's square while fitting."""
    samples: int = 3000
    """Points on the target, and on the garment."""
    weights: FitWeights = field(default_factory=FitWeights)

    def __post_init__(self) -> None:
        low, high = RESOLUTIONS
        if not low <= self.resolution <= high or self.samples < 100 or self.neighbours < 0:
            raise InputError(
                f"fit: expected a resolution in {low}..{high} cells, 100 samples or more and no fewer than 0 "
                f"neighbours; got {self}"
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


@dataclass(frozen=True, eq=False)
class SearchState:
    """Where a search stands."""

    position: Float[np.ndarray, " Z"]
    """Whitened code."""
    shift: Float[np.ndarray, " 3"]
    """Added to the garment to meet the target [m]; zero unless the target's place is open."""
    energy: float
    start: str
    """Where the search began."""


class Search:
    """Rounds of cutting and optimising towards one target.

    Args:
        model: The category's networks.
        space: Of its codes.
        target: What to come close to.
        options: How thoroughly.
        movable: Whether the target's place is open, as that of a mesh that had to be moved.
    """

    def __init__(
        self, model: GarmentModel, space: CodeSpace, target: Target, options: FitOptions, *, movable: bool
    ) -> None:
        self.model, self.space, self.target, self.options = model, space, target, options
        self.evaluations = 0
        self._movable = movable
        self._basis = torch.from_numpy(space.from_white).float()
        self._mean = torch.from_numpy(space.mean).float()

    def begin(self, code: Float[np.ndarray, " Z"], name: str) -> SearchState:
        """A state at a code, not yet evaluated."""
        return SearchState(self.space.position(code), np.zeros(3), np.inf, name)

    def round(self, state: SearchState, iterations: int) -> SearchState:
        """Cut the panels at a state and optimise with that topology.

        The energy of the result is that of a new cut: steps that do not survive cutting are halved.

        Raises:
            DecodeError: If the panels of ``state`` cannot be cut.
        """
        objective = self._objective(state.position)
        start = np.concatenate([state.position, state.shift / _SHIFT_UNIT])
        if not np.isfinite(state.energy):
            state = replace(state, energy=objective(start)[0])
        reach = np.repeat([_REACH, _REACH if self._movable else 0.0], [len(state.position), 3])
        bounds = list(zip(start - reach, start + reach, strict=True))
        options = {"maxiter": iterations, "maxfun": 2 * iterations}
        found = minimize(objective, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        for halvings in range(_RETREATS):
            variables = start + 0.5**halvings * (found.x - start)
            try:
                energy = self._objective(variables[:-3])(variables)[0]
            except DecodeError:
                continue
            if energy < state.energy:
                return SearchState(variables[:-3], _SHIFT_UNIT * variables[-3:], energy, state.start)
        return state

    def _objective(self, cut_at: Float[np.ndarray, " Z"]) -> Objective:
        """Energy and gradient of (whitened code, shift), for the topology of one code."""
        options = self.options
        cut_code = self._tensor_code(torch.from_numpy(cut_at).float())
        sewn = self._sew(cut_code.numpy())
        border = border_slopes(self.model, sewn, cut_code)
        distance = Distance(
            self.target, sewn.faces, _flat_areas(sewn), samples=options.samples, weights=options.weights
        )

        def evaluate(variables: Float[np.ndarray, " n"]) -> tuple[float, Float[np.ndarray, " n"]]:
            self.evaluations += 1
            variable = torch.from_numpy(variables).float().requires_grad_()
            white, shift = variable[:-3], _SHIFT_UNIT * variable[-3:]
            code = self._tensor_code(white)
            vertices = weld_points(sewn, lift_points(self.model, sewn, code, border=border))
            energy = distance(vertices + shift) + options.weights.prior * white.square().mean()
            (gradient,) = torch.autograd.grad(energy, variable)
            return energy.item(), gradient.double().numpy()

        return evaluate

    def _tensor_code(self, white: Float[Tensor, " Z"]) -> Float[Tensor, " Z"]:
        return self._mean + self._basis @ white

    def _sew(self, code: Float[np.ndarray, " Z"]) -> SewnPanels:
        resolution = self.options.resolution
        try:
            cut = cut_panels(self.model, code, resolution=resolution)
            return sew_panels(cut.outlines, self.model.seam_pairs, spacing=2 / resolution, sliver=SLIVER)
        except GeometryError as error:
            raise DecodeError(str(error)) from error


def _flat_areas(sewn: SewnPanels) -> Float[np.ndarray, " F"]:
    areas = []
    for panel in sewn.panels.values():
        corner = panel.points[panel.faces]
        side, other = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
        areas.append(0.5 * np.abs(side[:, 0] * other[:, 1] - side[:, 1] * other[:, 0]))
    return np.concatenate(areas)
