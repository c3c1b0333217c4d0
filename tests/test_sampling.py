"""Signed distances and labels of a panel's border are exact."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from isp_assets.errors import DatasetError
from isp_assets.train.sampling import Outline, SamplingOptions, sample_panel

SQUARE = np.array([[0.5, -0.5], [0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5]])


def square() -> Outline:
    return Outline.from_loops(SQUARE, np.zeros(4, int), np.array([1, 2, 3, 4]))


def frame() -> Outline:
    points = np.concatenate([SQUARE, 0.4 * SQUARE])
    return Outline.from_loops(points, np.repeat([0, 1], 4), np.array([1, 2, 3, 4, 5, 5, 5, 5]))


coordinates = st.integers(-1000, 1000).map(lambda n: n / 1000)


@given(coordinates, coordinates)
def test_the_distance_to_a_square_is_exact(x, y):
    distance, label = square().distance(np.array([[x, y]]))
    over = np.abs([x, y]) - 0.5
    expected = np.linalg.norm(np.maximum(over, 0)) + min(over.max(), 0)
    assert distance[0] == pytest.approx(expected, abs=1e-7)
    gaps = {1: abs(x - 0.5), 2: abs(y - 0.5), 3: abs(x + 0.5), 4: abs(y + 0.5)}
    if over.max() < 0:
        assert gaps[label[0]] == pytest.approx(min(gaps.values()), abs=1e-7)


def test_a_hole_is_outside():
    distance, label = frame().distance(np.array([[0.0, 0.0], [0.35, 0.0], [0.21, 0.0], [0.9, 0.0]]))
    np.testing.assert_allclose(distance, [0.2, -0.15, -0.01, 0.4], atol=1e-7)
    np.testing.assert_array_equal(label[2:], [5, 1])


def test_two_pieces_are_both_inside():
    points = np.concatenate([0.5 * SQUARE - [0.5, 0], 0.5 * SQUARE + [0.5, 0]])
    outline = Outline.from_loops(points, np.repeat([0, 1], 4), np.tile([1, 2, 3, 4], 2))
    np.testing.assert_array_equal(
        outline.inside(np.array([[-0.5, 0], [0.5, 0], [0.0, 0]])), [True, True, False]
    )


def test_corners_are_where_labels_change():
    corners = frame().corners
    np.testing.assert_allclose(sorted(map(tuple, corners)), sorted(map(tuple, SQUARE)))


def test_samples_keep_to_their_bands():
    options = SamplingOptions(points=4000, border=0.5, bands=((0.25, 0.01),), corner=0.25, corner_radius=0.02)
    samples = sample_panel(square(), options, np.random.default_rng(0))
    assert samples.xy.shape == (4000, 2)
    assert (np.abs(samples.distance) < 1e-7).sum() >= 2000
    assert np.abs(samples.distance).max() < 0.02 * np.sqrt(2) + 1e-9
    assert set(samples.label) == {1, 2, 3, 4}
    again = sample_panel(square(), options, np.random.default_rng(0))
    np.testing.assert_array_equal(samples.xy, again.xy)


def test_points_on_the_border_are_uniform_in_length():
    points = frame().draw(20000, np.random.default_rng(0))
    outer = np.abs(points).max(1) > 0.3
    assert outer.mean() == pytest.approx(1 / 1.4, abs=0.02)


def test_broken_loops_are_refused():
    with pytest.raises(DatasetError, match="consecutive"):
        Outline.from_loops(SQUARE[[0, 1, 2, 0, 1, 2, 3]], np.array([0, 0, 0, 1, 1, 1, 0]), np.ones(7, int))
    with pytest.raises(DatasetError, match="three"):
        Outline.from_loops(SQUARE[:2], np.zeros(2, int), np.ones(2, int))
