"""The inside of a panel follows its seams, less and less with distance."""

import numpy as np

from isp_assets.geometry.seam_fade import seam_fade

LINE = np.stack([np.linspace(0, 1, 21), np.zeros(21)], axis=1)
SEWN = np.arange(21)


def _panel(heights):
    inside = np.array([[0.5, h] for h in heights])
    return np.concatenate([LINE, inside])


def test_weights_fall_from_one_to_zero():
    heights = [1e-6, 0.02, 0.05, 0.1, 0.149, 0.16]
    fade = seam_fade(_panel(heights), SEWN, reach=0.15)
    np.testing.assert_array_equal(fade.points, 21 + np.arange(5))
    total = fade.weights.sum(axis=1)
    np.testing.assert_allclose(total, (1 - np.array(heights[:5]) / 0.15) ** 2, atol=1e-9)
    assert (fade.weights >= 0).all()


def test_points_next_to_the_seam_follow_the_nearest_point():
    fade = seam_fade(_panel([1e-7]), SEWN, reach=0.15)
    assert fade.sources[0, 0] == 10
    assert fade.weights[0, 0] > 0.999


def test_a_seam_that_moves_as_one_takes_its_surroundings_along():
    rng = np.random.default_rng(0)
    points = np.concatenate([LINE, rng.uniform(0, 1, (200, 2)) * (1, 0.14)])
    fade = seam_fade(points, SEWN, reach=0.15)
    assert len(fade.points) == 200
    height = points[fade.points, 1]
    follow = fade.weights.sum(axis=1)
    order = np.argsort(height)
    middle = order[(points[fade.points][order, 0] > 0.1) & (points[fade.points][order, 0] < 0.9)]
    assert (np.diff(follow[middle]) < 0.1).all()
    assert follow[middle[0]] > 0.9
    assert follow[middle[-1]] < 0.05


def test_seam_points_follow_nobody():
    fade = seam_fade(_panel([0.01]), SEWN)
    assert not np.isin(fade.points, SEWN).any()
    assert np.isin(fade.sources, SEWN).all()


def test_a_panel_without_seams_follows_nothing():
    fade = seam_fade(LINE, np.empty(0, dtype=np.int64))
    assert len(fade.points) == len(fade.weights) == 0


def test_few_seam_points_are_enough():
    fade = seam_fade(np.array([[0.0, 0.0], [0.01, 0.0], [0.0, 0.05]]), np.array([0, 1]), reach=0.15)
    np.testing.assert_array_equal(fade.points, [2])
    assert fade.weights.shape == (1, 2)
