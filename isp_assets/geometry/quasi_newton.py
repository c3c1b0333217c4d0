"""Minimise an energy of positions by L-BFGS, around a matrix that is factored once.

The first guess of the inverse Hessian is that matrix, scaled by the curvature last met: stiff parts
that the matrix knows nothing of (contact, limits of strain) would otherwise make every step too long.
What was learned of the curvature is kept from call to call, also where the energy changed a little
in between, as contact does.

NumPy; positions in metres, energies in joules.

References: Liu, Bouaziz and Kavan, "Quasi-Newton Methods for Real-Time Simulation of Hyperelastic
Materials", ACM Transactions on Graphics 36(3), 2017; Nocedal and Wright, "Numerical Optimization",
2nd edition, chapter 7.2.
"""

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

Energy = Callable[[Float[np.ndarray, "V 3"]], tuple[float, Float[np.ndarray, "V 3"]]]
"""Energy [J] of positions, and its gradient [N]."""

_MEMORY = 10  # steps remembered
_SHORTENINGS = 12  # halvings of a step that does not lower the energy
_DESCENT = 1e-4  # share of the promised decrease that a step must bring
_LONGEST = 0.02  # no step moves a vertex further than about this [m]: flat energies promise too much
_SETTLED = 1e-7  # decrease [J] below which nothing more happens


class _Pair(NamedTuple):
    """A step, how it changed the gradient, and one over the product of both."""

    step: Float[np.ndarray, "V 3"]
    change: Float[np.ndarray, "V 3"]
    weight: float


class QuasiNewton:
    """What is known of an energy's curvature; it grows with every step."""

    def __init__(self, solve: Callable[[Float[np.ndarray, "V 3"]], Float[np.ndarray, "V 3"]]) -> None:
        """Start with nothing but a matrix.

        Args:
            solve: Applies the inverse of a positive definite matrix that is much like the Hessian.
        """
        self._solve = solve
        self._pairs: deque[_Pair] = deque(maxlen=_MEMORY)
        self._scale = 1.0

    def descend(
        self, position: Float[np.ndarray, "V 3"], energy: Energy, *, steps: int
    ) -> Float[np.ndarray, "V 3"]:
        """Some steps downhill, each shortened until it lowers the energy.

        Args:
            position: The start [m].
            energy: What is to be lowered; much like that of the last call.
            steps: Steps at most.
        """
        value, gradient = energy(position)
        rescaled = False
        for _ in range(steps):
            direction = self._direction(gradient)
            slope = float((gradient * direction).sum())
            if slope >= 0:
                break
            for halving in range(_SHORTENINGS):
                step = 0.5**halving * direction
                reached, turned = energy(position + step)
                if reached <= value + _DESCENT * 0.5**halving * slope:
                    break
            else:
                break
            change = turned - gradient
            curvature = float((step * change).sum())
            if curvature > 0:
                self._pairs.append(_Pair(step, change, 1 / curvature))
                if not rescaled:
                    self._scale = curvature / float((change * self._solve(change)).sum())
                    rescaled = True
            gain, position, value, gradient = value - reached, position + step, reached, turned
            if gain < _SETTLED:
                break
        return position

    def _direction(self, gradient: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3"]:
        """The two-loop recursion."""
        left, shares = gradient.copy(), []
        for step, change, weight in reversed(self._pairs):
            shares.append(weight * float((step * left).sum()))
            left -= shares[-1] * change
        direction = self._scale * self._solve(left)
        for (step, change, weight), share in zip(self._pairs, reversed(shares), strict=True):
            direction += (share - weight * float((change * direction).sum())) * step
        longest = float(np.abs(direction).max(initial=0))
        return -min(1.0, _LONGEST / max(longest, 1e-30)) * direction
