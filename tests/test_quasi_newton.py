"""Descent with L-BFGS: exact cases, scale, what is remembered, and no step that is too long."""

import numpy as np
import pytest

from isp_assets.geometry.quasi_newton import Energy, QuasiNewton

RNG = np.random.default_rng(0)
SIZE = 6
START = 0.01 * RNG.normal(size=(SIZE, 3))
GOAL = START + 0.01 * RNG.normal(size=(SIZE, 3))
_FACTOR = RNG.normal(size=(SIZE, SIZE))
MATRIX = _FACTOR @ _FACTOR.T + np.eye(SIZE)


class Bowl:
    """Quadratic around the goal; counts how often it is asked."""

    def __init__(self, matrix: np.ndarray = MATRIX) -> None:
        self.matrix, self.asked = matrix, 0

    def __call__(self, place: np.ndarray) -> tuple[float, np.ndarray]:
        self.asked += 1
        gradient = self.matrix @ (place - GOAL)
        return 0.5 * float(((place - GOAL) * gradient).sum()), gradient


def _solver(scale: float = 1.0) -> QuasiNewton:
    return QuasiNewton(lambda right: np.linalg.solve(scale * MATRIX, right))


def test_with_the_exact_matrix_one_step_is_enough() -> None:
    np.testing.assert_allclose(_solver().descend(START, Bowl(), steps=1), GOAL, atol=1e-12)


def test_a_plain_matrix_gets_there_too() -> None:
    solver = QuasiNewton(lambda right: right)
    np.testing.assert_allclose(solver.descend(START, Bowl(1e6 * MATRIX), steps=60), GOAL, atol=1e-7)


def test_energies_only_fall() -> None:
    place, stiff = START, 1e5 * np.diag(np.arange(1.0, SIZE + 1))
    energies = [Bowl(stiff)(place)[0]]
    solver = _solver()
    for _ in range(8):
        place = solver.descend(place, Bowl(stiff), steps=1)
        energies.append(Bowl(stiff)(place)[0])
    assert (np.diff(energies) < 0).all()
    assert energies[-1] < 1e-2 * energies[0]


def test_a_matrix_that_is_far_too_soft_is_scaled_after_the_first_step() -> None:
    """Without that, each of the steps would have to be shortened ten times or so."""
    bowl = Bowl(1e4 * MATRIX)
    bowl.matrix = bowl.matrix + 1e3 * np.diag(np.arange(SIZE))
    reached = _solver().descend(START, bowl, steps=10)
    np.testing.assert_allclose(reached, GOAL, atol=1e-6)
    assert bowl.asked < 1 + 14 + 10


def test_what_was_learned_serves_the_next_call() -> None:
    stiff = MATRIX + 1e4 * np.diag(np.arange(1.0, SIZE + 1))

    def evaluations(solver: QuasiNewton) -> int:
        bowl = Bowl(stiff)
        solver.descend(START, bowl, steps=3)
        return bowl.asked

    solver = _solver()
    fresh = evaluations(solver)
    assert evaluations(solver) == 1 + 3 < fresh


def test_flat_energies_do_not_carry_vertices_away() -> None:
    """A fall without an end: no minimum, and no curvature to tell so."""

    def fall(place: np.ndarray) -> tuple[float, np.ndarray]:
        return float(place.sum()), np.ones_like(place)

    reached = QuasiNewton(lambda right: 1e6 * right).descend(START, fall, steps=5)
    moved = START - reached
    assert 0.015 * 5 < moved.min() <= moved.max() < 0.0201 * 5


@pytest.mark.parametrize("steps", [1, 20])
def test_at_the_minimum_nothing_moves(steps: int) -> None:
    energy: Energy = Bowl()
    np.testing.assert_array_equal(_solver().descend(GOAL, energy, steps=steps), GOAL)
