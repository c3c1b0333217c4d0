"""Panel triangulation: what it keeps, what it covers, what it refuses."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from isp_assets.errors import GeometryError
from isp_assets.geometry.topology import boundary_loops
from isp_assets.geometry.triangulate import points_in_polygon, triangulate_panel


def polygon(corners, spacing):
    corners = np.asarray(corners, dtype=float)
    sides = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        n = max(1, round(np.linalg.norm(b - a) / spacing))
        sides.append(a + np.arange(n)[:, None] / n * (b - a))
    return np.concatenate(sides)


def area(points, faces):
    a, b, c = (points[faces[:, k]] for k in range(3))
    return 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])


U_SHAPE = [(-0.2, 0), (-0.03, 0), (-0.01, 0.3), (0.01, 0.3), (0.03, 0), (0.2, 0), (0.2, 0.5), (-0.2, 0.5)]


def check(loops, spacing):
    points, faces = triangulate_panel(loops, spacing)
    border = np.concatenate(loops)
    assert np.array_equal(points[: len(border)], border)
    assert np.array_equal(np.unique(faces), np.arange(len(points)))
    assert area(points, faces).min() > 0
    start, found = 0, {tuple(sorted(loop.tolist())) for loop in boundary_loops(faces)}
    for loop in loops:
        rows = tuple(range(start, start + len(loop)))
        assert rows in found
        start += len(loop)
    assert len(found) == len(loops)
    shoelace = sum(abs(area_of(loop)) for loop in loops)
    assert area(points, faces).sum() == pytest.approx(shoelace, rel=1e-9)
    for point in points[len(border) :]:
        for loop in loops:
            assert distance_to(point, loop) >= 0.6 * spacing
    return points, faces


def area_of(loop):
    x, y = loop.T
    return 0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum()


def distance_to(point, loop):
    a, b = loop, np.roll(loop, -1, axis=0)
    t = np.clip(((point - a) * (b - a)).sum(1) / ((b - a) ** 2).sum(1), 0, 1)[:, None]
    return np.linalg.norm(a + t * (b - a) - point, axis=1).min()


@pytest.mark.parametrize("spacing", [0.012, 0.018, 0.04])
def test_a_concave_outline_is_kept_and_covered(spacing):
    check([polygon(U_SHAPE, spacing)], spacing)


def test_clockwise_outlines_still_give_counter_clockwise_faces():
    loop = polygon(U_SHAPE, 0.02)[::-1].copy()
    points, faces = triangulate_panel([loop], 0.02)
    assert area(points, faces).min() > 0


def test_pieces_closer_than_the_spacing_do_not_join():
    left = polygon([(-0.3, 0), (-0.004, 0), (-0.004, 0.4), (-0.3, 0.4)], 0.018)
    right = polygon([(0.004, 0), (0.3, 0), (0.3, 0.4), (0.004, 0.4)], 0.018)
    _, faces = check([left, right], 0.018)
    assert (faces < len(left)).any()


def test_the_lattice_is_mirror_symmetric_and_regular():
    loop = polygon(U_SHAPE, 0.02)
    points, faces = triangulate_panel([loop], 0.02)
    inner = points[len(loop) :]
    mirror = {(round(-x, 9) + 0.0, round(y, 9)) for x, y in inner}
    assert mirror == {(round(x, 9) + 0.0, round(y, 9)) for x, y in inner}
    inside = (faces >= len(loop)).all(axis=1)
    regular = np.sqrt(3) / 4 * 0.02**2
    assert np.allclose(area(points, faces)[inside], regular)


def test_edges_that_delaunay_misses_are_recovered():
    """Two long edges on a strip far thinner than their length: points of the far side lie in every circle."""
    top = [(x, 0.004 + 0.002 * (i % 2)) for i, x in enumerate(np.linspace(0.2, 0, 21))]
    loop = np.array([(0.0, 0.0), (0.1, 0.0), (0.2, 0.0), *top])
    points, faces = triangulate_panel([loop], 0.1)
    assert len(faces) == len(loop) - 2
    assert area(points, faces).sum() == pytest.approx(abs(area_of(loop)))


@settings(max_examples=25, deadline=None)
@given(st.lists(st.floats(0.15, 0.5), min_size=5, max_size=14), st.floats(0.015, 0.05))
def test_star_shaped_outlines_are_filled_exactly(radii, spacing):
    angle = np.linspace(0, 2 * np.pi, len(radii), endpoint=False)
    corners = np.array(radii)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    loop = polygon(corners, spacing)
    points, faces = triangulate_panel([loop], spacing)
    assert area(points, faces).min() > 0
    assert area(points, faces).sum() == pytest.approx(area_of(loop), rel=1e-9)
    assert {tuple(sorted(b.tolist())) for b in boundary_loops(faces)} == {tuple(range(len(loop)))}


def test_points_in_polygon_follows_the_even_odd_rule():
    loop = np.array([(0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (1.0, 0.5), (0.0, 2.0)])
    points = np.array([(0.2, 0.2), (1.0, 1.5), (1.0, 0.4), (3.0, 1.0), (-0.1, 0.0)])
    assert points_in_polygon(points, loop).tolist() == [True, False, True, False, False]


@pytest.mark.parametrize(
    ("loops", "spacing", "match"),
    [
        ([], 0.1, "at least one outline"),
        ([np.zeros((2, 2))], 0.1, "at least 3 finite points"),
        ([np.array([(0.0, 0.0), (1.0, np.nan), (0.0, 1.0)])], 0.1, "at least 3 finite points"),
        ([np.array([(0.0, 0.0), (1.0, 1.0), (1.0, 0.0), (0.0, 1.2)])], 0.5, "cross itself"),
        ([np.eye(3)[:, :2]], -1.0, "positive length"),
    ],
)
def test_bad_outlines_are_named(loops, spacing, match):
    with pytest.raises(GeometryError, match=match):
        triangulate_panel(loops, spacing)


def test_an_outline_on_the_axes_is_filled_while_torch_flushes_denormals():
    """Exact zeros and flushed denormals once sent the neighbour search into endless recursion."""
    torch.set_flush_denormal(True)
    check([polygon([(0, 0), (0.2, 0), (0.2, 0.2), (0, 0.2)], 0.02)], 0.02)
