"""The search of a fit: rounds of cutting the panels and descending by Gauss-Newton in a trust region.

Reference: More and Sorensen, "Computing a Trust Region Step", 1983, as SciPy has it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from isp_assets.errors import DecodeError
from isp_assets.fit_objective import Target
from isp_assets.fit_options import CodeSpace, FitOptions
from isp_assets.fit_problem import SHIFT_UNIT, FitProblem, Variables
from isp_assets.garment_model import GarmentModel

_STEP = 1.5  # longest first step of a round, in usual spreads of the codes
_REACH = 3.0  # longest step
_SETTLED = 1e-3  # share of the energy that a step must gain for the round to go on
_RETREATS = 5
_STALLED = 0.995  # a round that leaves more than this of the energy is the last


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

    def begin(self, code: Float[np.ndarray, " Z"], name: str) -> SearchState:
        """A state at a code, not yet evaluated."""
        return SearchState(self.space.position(code), np.zeros(3), np.inf, name)

    def round(self, state: SearchState, iterations: int) -> SearchState:
        """Cut the panels at a state and optimise with that topology.

        The energy of the result is that of a new cut: steps that do not survive cutting are halved.

        Raises:
            DecodeError: If the panels of ``state`` cannot be cut.
        """
        problem, start = self._cut(state), self._variables(state)
        if not np.isfinite(state.energy):
            state = replace(state, energy=problem.energy(start))
        found = _descend(problem, start, iterations)
        self.evaluations += problem.evaluations
        for halvings in range(_RETREATS):
            tried = self._moved(state, start + 0.5**halvings * (found - start))
            try:
                problem = self._cut(tried)
            except DecodeError:
                continue
            energy = problem.energy(self._variables(tried))
            self.evaluations += problem.evaluations
            if energy < state.energy:
                return replace(tried, energy=energy)
        return state

    def settle(
        self, state: SearchState, progress: Callable[[float, str], None] = lambda share, text: None
    ) -> SearchState:
        """Rounds until one gains no more.

        Args:
            state: Where to begin.
            progress: Called with the share of the rounds (0 to 1) and a line of text before each.
        """
        rounds = self.options.rounds
        for number in range(rounds):
            left = f"{state.energy:.3g} mm^2 left"
            progress(number / rounds, f"from {state.start}, round {number + 1}, {left}")
            following = self.round(state, self.options.iterations)
            stalled, state = following.energy > _STALLED * state.energy, following
            if stalled:
                break
        return state

    def _cut(self, state: SearchState) -> FitProblem:
        return FitProblem(self.model, self.space, self.target, self.options, state.position)

    def _variables(self, state: SearchState) -> Variables:
        return np.concatenate(
            [state.position, state.shift / SHIFT_UNIT] if self._movable else [state.position]
        )

    def _moved(self, state: SearchState, variables: Variables) -> SearchState:
        size = len(state.position)
        shift = SHIFT_UNIT * variables[size:] if self._movable else state.shift
        return replace(state, position=variables[:size], shift=shift)


def _descend(problem: FitProblem, start: Variables, iterations: int) -> Variables:
    """Where the energy is lower, by no more than so many steps, each at new closest points."""
    last = problem.energy(start)

    def settled(intermediate_result) -> None:
        nonlocal last
        gained, last = last - intermediate_result.fun, intermediate_result.fun
        if 0 < gained < _SETTLED * last:
            raise StopIteration

    options = {
        "initial_trust_radius": _STEP, "max_trust_radius": _REACH, "maxiter": iterations, "gtol": 1e-6,
    }  # fmt: skip
    return minimize(
        problem.energy, start, jac=problem.gradient, hess=problem.curvature, method="trust-exact",
        options=options, callback=settled,
    ).x  # fmt: skip
