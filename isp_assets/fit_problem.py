"""One smooth problem of a fit: the energy of a code while the topology of its garment is held.

The border follows the code to first order (Eq. 5). Energies are sums of squares, so that
the Jacobian of the residuals gives gradient and curvature at once (Gauss-Newton).
"""

import numpy as np
import torch
from jaxtyping import Float

from isp_assets.decode import SLIVER, border_slopes, cut_panels, lift_points, weld_points
from isp_assets.errors import DecodeError, GeometryError
from isp_assets.fit_jacobian import vertex_jacobian
from isp_assets.fit_objective import Distance, Target
from isp_assets.fit_options import CodeSpace, FitOptions
from isp_assets.fit_residuals import Residuals
from isp_assets.garment_model import GarmentModel
from isp_assets.geometry.sewing import SewnPanels, sew_panels

SHIFT_UNIT = 0.02  # of the variables that stand for a shift [m]

Variables = Float[np.ndarray, " n"]
"""A whitened code, and three numbers more if the garment may be shifted as a whole."""


class FitProblem:
    """Energy, gradient and curvature of codes, with the topology of one of them.

    Args:
        model: The category's networks.
        space: Of its codes.
        target: What to come close to.
        options: Resolution, samples and weights.
        cut_at: Whitened code that the panels are cut at.

    Raises:
        DecodeError: If the panels of that code cannot be cut.
    """

    def __init__(
        self, model: GarmentModel, space: CodeSpace, target: Target, options: FitOptions,
        cut_at: Float[np.ndarray, " Z"],
    ) -> None:  # fmt: skip
        self.evaluations = 0
        self._model, self._space, self._prior = model, space, options.weights.prior / len(cut_at)
        code = space.code(cut_at).astype(np.float32)
        self._sewn = _sew(model, code, options.resolution)
        self._border = border_slopes(model, self._sewn, torch.from_numpy(code))
        areas = _flat_areas(self._sewn)
        self._distance = Distance(
            target, self._sewn.faces, areas, samples=options.samples, weights=options.weights
        )
        self._at: Variables = np.zeros(0)
        self._residuals: Residuals | None = None
        self._slope: Float[np.ndarray, "R n"] | None = None

    def energy(self, variables: Variables) -> float:
        """Distances and prior [mm^2]."""
        white = variables[: len(self._space.mean)]
        return self._residuals_at(variables).energy + self._prior * float(white @ white)

    def gradient(self, variables: Variables) -> Float[np.ndarray, " n"]:
        """Of the energy."""
        found = 2 * self._slope_at(variables).T @ self._residuals_at(variables).values
        size = len(self._space.mean)
        found[:size] += 2 * self._prior * variables[:size]
        return found

    def curvature(self, variables: Variables) -> Float[np.ndarray, "n n"]:
        """Second derivatives of the energy, but for those of the residuals."""
        slope = self._slope_at(variables)
        found, size = 2 * slope.T @ slope, len(self._space.mean)
        found[range(size), range(size)] += 2 * self._prior
        return found

    def _residuals_at(self, variables: Variables) -> Residuals:
        if self._residuals is None or not np.array_equal(variables, self._at):
            self.evaluations += 1
            with torch.no_grad():
                lifted = lift_points(self._model, self._sewn, self._code(variables), border=self._border)
                vertices = weld_points(self._sewn, lifted).double().numpy()
            shift = SHIFT_UNIT * variables[len(self._space.mean) :]
            self._residuals = self._distance(vertices + shift if len(shift) else vertices)
            self._at, self._slope = variables.copy(), None
        return self._residuals

    def _slope_at(self, variables: Variables) -> Float[np.ndarray, "R n"]:
        residuals = self._residuals_at(variables)
        if self._slope is None:
            by_code = vertex_jacobian(self._model, self._sewn, self._code(variables), self._border)
            columns = by_code.double().numpy().reshape(-1, by_code.shape[-1]) @ self._space.from_white
            if len(variables) > columns.shape[1]:
                shifts = np.tile(SHIFT_UNIT * np.eye(3), (len(columns) // 3, 1))
                columns = np.concatenate([columns, shifts], axis=1)
            self._slope = residuals.slope @ columns
        return self._slope

    def _code(self, variables: Variables) -> torch.Tensor:
        return torch.from_numpy(self._space.code(variables[: len(self._space.mean)])).float()


def _sew(model: GarmentModel, code: Float[np.ndarray, " Z"], resolution: int) -> SewnPanels:
    try:
        cut = cut_panels(model, code, resolution=resolution)
        return sew_panels(cut.outlines, model.seam_pairs, spacing=2 / resolution, sliver=SLIVER)
    except GeometryError as error:
        raise DecodeError(str(error)) from error


def _flat_areas(sewn: SewnPanels) -> Float[np.ndarray, " F"]:
    areas = []
    for panel in sewn.panels.values():
        corner = panel.points[panel.faces]
        side, other = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
        areas.append(0.5 * np.abs(side[:, 0] * other[:, 1] - side[:, 1] * other[:, 0]))
    return np.concatenate(areas)
