"""Jerk, noise and jumps against motions whose answers are known."""

import numpy as np
import pytest

from isp_assets.errors import GeometryError
from isp_assets.evaluate.temporal import jerk, jerk_ratio, jump_ratios, noise_gain, skin_beneath


@pytest.fixture
def times() -> np.ndarray:
    return np.arange(12) / 24


def test_jerk_of_a_cubic_is_exact(times):
    rng = np.random.default_rng(0)
    a, b, c, d = rng.normal(size=(4, 5, 3))
    t = times[:, None, None]
    found = jerk(a * t**3 + b * t**2 + c * t + d, fps=24)
    np.testing.assert_allclose(found, np.broadcast_to(6 * a, found.shape), rtol=1e-8, atol=1e-8)


def test_a_rigid_copy_has_ratio_one_and_a_larger_swing_its_size(times):
    rng = np.random.default_rng(1)
    way = rng.normal(size=(12, 1, 3))
    skin = rng.normal(size=(7, 3)) + way
    assert jerk_ratio(skin + np.array([0.0, 0.1, 0.0]), skin, 24) == pytest.approx(1)
    assert jerk_ratio(rng.normal(size=(7, 3)) + 3 * way, skin, 24) == pytest.approx(3)
    assert jerk_ratio(skin, skin, 24) == jerk_ratio(skin, skin, 120), "no matter the frame rate"


def test_jerk_ratio_of_a_still_body_is_finite():
    still = np.zeros((5, 4, 3))
    assert jerk_ratio(still, still, 30) == 0
    assert np.isfinite(jerk_ratio(np.random.default_rng(0).normal(size=(5, 4, 3)), still, 30))


def test_noise_gain_is_the_ratio_of_the_scatters():
    rng = np.random.default_rng(2)
    noise = rng.normal(size=(9, 6, 3))
    assert noise_gain(5 + 2 * noise, noise - 7) == pytest.approx(2)


def test_jumps_are_compared_frame_by_frame():
    body = np.zeros((4, 2, 3))
    body[:, 0, 1] = [0.0, 0.1, 0.2, 0.2]
    garment = np.zeros((4, 3, 3))
    garment[:, 1, 0] = [0.0, 0.1, 0.5, 0.5]
    np.testing.assert_allclose(jump_ratios(garment, body), [0, 1, 4, 0])
    garment[3, 2, 2] = 0.001
    assert jump_ratios(garment, body)[3] == pytest.approx(10), "a body at rest counts as moving .1 mm"


def test_skin_beneath_is_the_nearest_vertex():
    body = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    np.testing.assert_array_equal(skin_beneath(body[[2, 0]] + 0.1, body), [2, 0])


def test_too_few_frames_are_refused():
    with pytest.raises(GeometryError, match="at least 4 consecutive frames, got 3"):
        jerk(np.zeros((3, 1, 3)), 30)
