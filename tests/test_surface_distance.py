"""Distances between surfaces whose answer is known, and the errors."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isp_assets.errors import GeometryError
from isp_assets.geometry.surface_distance import Surface, distance_to_surface, surface_distance


def square(z: float = 0.0, cells: int = 4, size: float = 1.0) -> Surface:
    line = np.linspace(0, size, cells + 1)
    x, y = np.meshgrid(line, line)
    grid = np.arange(x.size).reshape(x.shape)
    a, b, c, d = grid[:-1, :-1].ravel(), grid[:-1, 1:].ravel(), grid[1:, 1:].ravel(), grid[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return Surface(np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)]), faces)


def test_parallel_squares_lie_exactly_as_far_apart_as_they_do():
    found = surface_distance(square(0.003), square(), samples=4000)
    for value in (found.mean, found.p95, found.max):
        assert value == pytest.approx(0.003, abs=1e-12)
    assert found.normal_consistency == found.signed_normal_consistency == pytest.approx(1)


def test_a_surface_on_itself_leaves_only_the_floor_of_sampling():
    found = surface_distance(square(), square(cells=7), samples=20_000)
    assert found.max < 1e-12
    # n random points in a unit square: the mean squared distance to the nearest of n others is 1 / (pi n).
    assert found.chamfer == pytest.approx(2 / (np.pi * 20_000), rel=0.1)
    assert found.chamfer_floor == pytest.approx(found.chamfer, rel=0.05)


def test_the_floor_falls_as_one_over_the_samples():
    floors = [surface_distance(square(), square(), samples=n).chamfer_floor for n in (1000, 4000, 16_000)]
    assert floors[0] / floors[1] == pytest.approx(4, rel=0.2)
    assert floors[1] / floors[2] == pytest.approx(4, rel=0.2)


def test_the_unit_scales_the_chamfer_distance_alone():
    one = surface_distance(square(0.1), square(), samples=1000)
    two = surface_distance(square(0.1), square(), samples=1000, unit=2.0)
    assert two.chamfer == pytest.approx(one.chamfer / 4)
    assert two.mean == one.mean


def test_both_directions_count():
    """A quarter of the square is on it, but three quarters of the square are not on the quarter."""
    small, large = square(size=0.5), square()
    found = surface_distance(small, large, samples=20_000)
    assert distance_to_surface(small.sample(500, np.random.default_rng(0))[0], large).max() < 1e-12
    assert found.max == pytest.approx(np.hypot(0.5, 0.5), rel=0.02)
    mirrored = surface_distance(large, small, samples=20_000)
    assert mirrored.mean == pytest.approx(found.mean, rel=0.02)


def test_faces_turned_over_show_in_the_signed_figure_alone():
    turned = square()
    found = surface_distance(Surface(turned.vertices, turned.faces[:, ::-1].copy()), square(), samples=1000)
    assert found.normal_consistency == pytest.approx(1)
    assert found.signed_normal_consistency == pytest.approx(-1)


def test_tilted_normals_agree_by_their_cosine():
    tilted = square()
    vertices = tilted.vertices @ np.array([[1, 0, 0], [0, np.cos(0.3), np.sin(0.3)], [0, 0, 0]])
    found = surface_distance(Surface(vertices, tilted.faces), square(), samples=1000)
    assert found.normal_consistency == pytest.approx(np.cos(0.3), abs=1e-9)


@given(
    st.integers(0, 2**31), st.floats(-3, 3, allow_subnormal=False), st.floats(-1, 1, allow_subnormal=False)
)
@settings(max_examples=10, deadline=None)
def test_rigid_motions_change_nothing(seed, angle, shift):
    rng = np.random.default_rng(seed)
    one = Surface(square().vertices + 0.01 * rng.normal(size=(25, 3)), square().faces)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    moved = [Surface(s.vertices @ turn.T + shift, s.faces) for s in (one, square())]
    before, after = surface_distance(one, square(), samples=300), surface_distance(*moved, samples=300)
    assert after.mean == pytest.approx(before.mean, abs=1e-9)
    assert after.chamfer == pytest.approx(before.chamfer, abs=1e-9)
    assert after.normal_consistency == pytest.approx(before.normal_consistency, abs=1e-9)


def test_samples_are_uniform_in_area():
    vertices = np.array([[0, 0, 0], [3.0, 0, 0], [0, 1, 0], [3, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]])
    surface = Surface(vertices, np.array([[0, 1, 2], [4, 5, 6]]))  # areas 3 to 1
    points, face = surface.sample(20_000, np.random.default_rng(0))
    assert (face == 0).mean() == pytest.approx(0.75, abs=0.02)
    np.testing.assert_allclose(points[face == 0].mean(axis=0), [1, 1 / 3, 0], atol=0.02)


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (np.zeros((3, 3)), np.zeros((0, 3), int), "no faces"),
        (np.full((3, 3), np.nan), np.array([[0, 1, 2]]), "NaN"),
        (np.zeros((3, 3)), np.array([[0, 1, 3]]), r"index 0\.\.2"),
    ],
)
def test_bad_surfaces_are_refused(vertices, faces, message):
    with pytest.raises(GeometryError, match=message):
        Surface(vertices, faces)


def test_a_surface_without_area_cannot_be_sampled():
    flat = Surface(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    with pytest.raises(GeometryError, match="no area"):
        surface_distance(flat, square(), samples=10)
