"""The energy of cloth in NumPy: that of training, its limit of strain, and their gradients."""

import numpy as np
import pytest
import torch
from elastic_tube import FABRIC, SHAPE, elastic_cloth, flat_rest

from isp_assets.geometry.energy import bending_energy, gravity_energy, membrane_energy


def test_energy_and_gradient_are_those_of_the_training_energy() -> None:
    rng = np.random.default_rng(0)
    vertices = SHAPE[0] + 0.004 * rng.normal(size=SHAPE[0].shape)
    value, gradient = elastic_cloth().energy(vertices)
    place = torch.from_numpy(vertices).requires_grad_(True)
    rest = flat_rest()
    wanted = (
        membrane_energy(place, rest, FABRIC)
        + bending_energy(place, rest, FABRIC)
        + gravity_energy(place, rest)
    )
    wanted.backward()
    assert value == pytest.approx(wanted.item(), rel=1e-10)
    np.testing.assert_allclose(gradient, place.grad.numpy(), rtol=1e-8, atol=1e-12)


def test_flat_lengths_give_the_strain_of_uniform_stretch() -> None:
    assert elastic_cloth().strain_p99(SHAPE[0]) < 1e-9
    assert elastic_cloth().strain_p99(1.2 * SHAPE[0]) == pytest.approx(0.2)


def test_strain_within_the_limit_costs_nothing_more() -> None:
    for stretch in (0.8, 1.0, 1.2):
        value, gradient = elastic_cloth().limit_energy(stretch * SHAPE[0], 0.25, stiffness=150.0)
        assert value == 0
        assert not gradient.any()


@pytest.mark.parametrize("stretch", [0.5, 1.5])
@pytest.mark.parametrize("stiffness", [150.0, 1000.0])
def test_uniform_strain_beyond_the_limit_costs_its_square(stretch: float, stiffness: float) -> None:
    """So many times as stiff as the membrane along an edge, beyond a strain of a quarter."""
    cloth = elastic_cloth()
    value, _ = cloth.limit_energy(stretch * SHAPE[0], 0.25, stiffness=stiffness)
    wanted = 0.5 * stiffness * (2 * FABRIC.mu + FABRIC.lam) * cloth.area.sum() * 0.25**2
    assert value == pytest.approx(wanted, rel=1e-6)


def test_sides_may_resist_being_pressed_less_than_being_stretched() -> None:
    cloth = elastic_cloth()
    share = np.full(len(cloth.flat_lengths) * 3, 0.1)
    for stretch, wanted in ((0.5, 0.1), (1.5, 1.0)):
        whole, gradient = cloth.limit_energy(stretch * SHAPE[0], 0.25, stiffness=150.0)
        value, less = cloth.limit_energy(stretch * SHAPE[0], 0.25, stiffness=150.0, pressed=share)
        assert value == pytest.approx(wanted * whole)
        np.testing.assert_allclose(less, wanted * gradient, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("pressed", [1.0, 0.03])
def test_the_gradient_of_the_limit_is_that_of_its_energy(pressed: float) -> None:
    cloth, rng = elastic_cloth(), np.random.default_rng(1)
    place = SHAPE[0] * [1.4, 0.7, 1.4] + 0.002 * rng.normal(size=SHAPE[0].shape)
    way = rng.normal(size=place.shape)
    step = 1e-7

    def limited(place: np.ndarray) -> tuple[float, np.ndarray]:
        return cloth.limit_energy(place, 0.25, stiffness=150.0, pressed=pressed)

    difference = limited(place + step * way)[0] - limited(place - step * way)[0]
    assert difference / (2 * step) == pytest.approx((limited(place)[1] * way).sum(), rel=1e-5)
