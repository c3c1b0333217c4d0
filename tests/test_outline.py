"""The zero level of a field: exactness on polygons, second order on a disc, cost of the band, bad fields."""

import numpy as np
import pytest

from isp_assets.errors import GeometryError
from isp_assets.geometry.outline import (
    PlaneField,
    _grid_points,
    _sample_band,
    resample_closed,
    resample_open,
    signed_area,
    trace_outline,
)


def _plane_field(distance) -> PlaneField:
    """A field from its distance alone: central differences, no labels."""

    def border(xy):
        h = 1e-6
        gradient = [(distance(xy + d) - distance(xy - d)) / (2 * h) for d in h * np.eye(2)]
        return distance(xy), np.stack(gradient, axis=1), np.zeros((len(xy), 2))

    return PlaneField(distance, border)


def _disc(radius=0.5, center=(0.0, 0.0), scale=1.0):
    return lambda xy: scale * (np.linalg.norm(xy - np.array(center), axis=1) - radius)


def _box(half, center=(0.0, 0.0)):
    def distance(xy):
        q = np.abs(xy - np.array(center)) - np.array(half)
        return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)

    return distance


def _union(*parts):
    return lambda xy: np.min([part(xy) for part in parts], axis=0)


def test_disc_area_converges_with_second_order():
    errors = []
    for cells in (32, 64, 128, 256):
        (loop,) = trace_outline(_plane_field(_disc()), cells=cells).loops
        errors.append(abs(signed_area(loop) - np.pi / 4))
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (rates > 1.8).all(), rates
    assert errors[-1] < 1e-4


def test_points_lie_on_the_zero_level_and_are_evenly_spaced():
    (loop,) = trace_outline(_plane_field(_disc(0.37, (0.2, -0.1))), cells=128).loops
    assert np.abs(_disc(0.37, (0.2, -0.1))(loop)).max() < 1e-9
    steps = np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1)
    assert steps.max() / steps.min() < 1.02


@pytest.mark.parametrize("scale", [0.6, 1.4])
def test_a_field_of_another_slope_has_the_same_outline(scale):
    """A learnt distance is only roughly one; the Newton step divides by its slope."""
    (loop,) = trace_outline(_plane_field(_disc(scale=scale)), cells=128).loops
    assert np.abs(_disc()(loop)).max() < 1e-9


def test_box_keeps_its_area_but_for_the_corners():
    (loop,) = trace_outline(_plane_field(_box((0.41, 0.63))), cells=256).loops
    assert signed_area(loop) == pytest.approx(4 * 0.41 * 0.63, abs=4 * (2 / 256) ** 2)


def test_band_equals_the_full_grid_near_the_border_and_in_sign_everywhere():
    field = _union(_box((0.3, 0.6), (-0.42, 0.0)), _disc(0.25, (0.4, 0.3)))
    values, evaluations = _sample_band(field, 256)
    full = field(_grid_points(256)).reshape(257, 257)
    near = np.abs(full) < 2 / 256
    np.testing.assert_allclose(values[near], full[near], atol=1e-12)
    assert ((values < 0) == (full < 0)).all()
    assert evaluations < 0.12 * full.size


def test_band_grows_with_the_border_not_with_the_area():
    counts = [trace_outline(_plane_field(_disc()), cells=cells).num_evaluations for cells in (128, 256, 512)]
    assert counts[1] / counts[0] < 2.1
    assert counts[2] / counts[1] < 2.1


def test_pieces_are_counter_clockwise_from_left_to_right():
    field = _union(_box((0.2, 0.5), (0.4, 0.0)), _box((0.2, 0.4), (-0.4, 0.1)))
    outline = trace_outline(_plane_field(field), cells=128)
    assert [round(signed_area(loop), 2) for loop in outline.loops] == [0.32, 0.40]
    assert outline.loops[0][:, 0].max() < 0 < outline.loops[1][:, 0].min()


def test_a_gap_thinner_than_a_cell_stays_open_on_the_middle_line():
    gap = 0.1 * 2 / 128
    field = _union(_box((0.3, 0.5), (0.3 + gap, 0.0)), _box((0.3, 0.5), (-0.3 - gap, 0.0)))
    assert len(trace_outline(_plane_field(field), cells=128).loops) == 2


def test_specks_and_pinholes_are_dropped_and_counted():
    field = _union(_disc(0.5), _disc(0.03, (0.8, 0.8)))
    pinhole = lambda xy: np.maximum(field(xy), -_disc(0.03)(xy))  # noqa: E731
    outline = trace_outline(_plane_field(pinhole), cells=128)
    assert len(outline.loops) == 1
    assert outline.num_specks == 2


@pytest.mark.parametrize(
    ("distance", "message"),
    [
        (lambda xy: np.ones(len(xy)), "no inside"),
        (lambda xy: -np.ones(len(xy)), "whole square"),
        (lambda xy: np.full(len(xy), np.nan), "NaN"),
        (lambda xy: np.maximum(_disc(0.6)(xy), -_disc(0.3)(xy)), "1 hole"),
        (_disc(0.5, (0.8, 0.0)), "edge of its square"),
    ],
)
def test_fields_without_a_proper_panel_are_refused(distance, message):
    with pytest.raises(GeometryError, match=message):
        trace_outline(_plane_field(distance), cells=64)


@pytest.mark.parametrize("cells", [0, 8, 100])
def test_cells_must_be_a_power_of_two(cells):
    with pytest.raises(GeometryError, match="power of two"):
        trace_outline(_plane_field(_disc()), cells=cells)


def test_a_flat_field_does_not_throw_points_away():
    """Where the gradient vanishes, the step stays shorter than a cell."""
    field = PlaneField(_disc(), lambda xy: (np.ones(len(xy)), 1e-9 * xy, np.zeros((len(xy), 2))))
    (loop,) = trace_outline(field, cells=64).loops
    assert np.abs(_disc()(loop)).max() < 3 * 2 / 64


def test_resampling_keeps_ends_and_lengths():
    curve = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 1.0]])
    np.testing.assert_allclose(resample_open(curve, 5), [[0, 0], [1, 0], [2, 0], [3, 0], [3, 1]])
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    np.testing.assert_allclose(resample_closed(square, 8)[::2], square)
    assert signed_area(square) == 1.0 == -signed_area(square[::-1])
