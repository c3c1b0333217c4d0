"""Depth map and distance grid of bodies whose distance is known."""

import numpy as np
import pytest
import trimesh

from isp_assets.errors import BodyError
from isp_assets.train.body_field import depth_map, distance_grid
from isp_assets.train.landmarks import RestBody


@pytest.fixture(scope="module")
def box():
    mesh = trimesh.creation.box(extents=(0.2, 0.3, 0.1)).subdivide().subdivide()
    return np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces, dtype=np.int64)


@pytest.fixture(scope="module")
def ball():
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.15)
    return np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces, dtype=np.int64)


def test_depth_of_a_box(box):
    depth = depth_map(*box, cell=0.01)
    assert np.allclose(depth.front[depth.mask], 0.05)
    assert np.allclose(depth.back[depth.mask], -0.05)
    assert depth.mask.sum() == pytest.approx(0.2 * 0.3 / 0.01**2, rel=0.1)
    assert depth.runs_in_row(0.0) == pytest.approx(np.array([[-0.1, 0.1]]), abs=0.01)
    assert depth.runs_in_column(0.0) == pytest.approx(np.array([[-0.15, 0.15]]), abs=0.01)


def test_depth_of_a_ball_is_its_height(ball):
    depth = depth_map(*ball, cell=0.005)
    y, x = (
        index * 0.005 + start for index, start in zip(np.nonzero(depth.mask), depth.origin[::-1], strict=True)
    )
    inner = np.hypot(x, y) < 0.14
    expected = np.sqrt(0.15**2 - x[inner] ** 2 - y[inner] ** 2)
    assert np.abs(depth.front[depth.mask][inner] - expected).max() < 1e-3


def test_distance_is_exact_in_the_band_and_clamped_beyond(ball):
    grid = distance_grid(*ball, cell=0.01, band=0.03)
    points = np.random.default_rng(0).uniform(-0.19, 0.19, (2000, 3))
    exact = np.linalg.norm(points, axis=1) - 0.15
    found = grid.sample(points)
    near = np.abs(exact) < 0.015
    assert np.abs(found[near] - exact[near]).max() < 1e-3  # facets and trilinear cells
    assert found[exact < -0.05] == pytest.approx(-0.03)
    assert found[exact > 0.06] == pytest.approx(0.03)


def test_a_body_that_penetrates_itself_keeps_its_inside(ball):
    vertices, faces = ball
    both = (
        np.concatenate([vertices, np.add(vertices, (0.1, 0, 0))]),
        np.concatenate([faces, faces + len(vertices)]),
    )
    grid = distance_grid(*both, cell=0.01, band=0.03)
    assert (grid.sample(np.array([[0.05, 0.0, 0.0], [-0.1, 0, 0], [0.2, 0, 0]])) < 0).all()


def test_an_inside_out_body_is_refused(ball):
    vertices, faces = ball
    with pytest.raises(BodyError, match="no inside"):
        distance_grid(vertices, faces[:, ::-1].copy(), cell=0.02)


def test_girth_is_the_length_of_the_nearest_loop(ball):
    vertices, faces = ball
    two = np.concatenate([vertices, np.add(0.5 * vertices, (0.5, 0, 0))])
    body = RestBody(vertices=two, faces=np.concatenate([faces, faces + len(vertices)]))
    up = np.array([0.0, 1.0, 0.0])
    assert body.girth(np.zeros(3), up) == pytest.approx(2 * np.pi * 0.15, rel=2e-3)
    assert body.girth(np.array([0.5, 0.0, 0.0]), up) == pytest.approx(np.pi * 0.15, rel=2e-3)
    assert body.girth(np.zeros(3), np.array([1.0, 1.0, 0.3])) == pytest.approx(2 * np.pi * 0.15, rel=2e-3)
    with pytest.raises(BodyError, match="does not cut"):
        body.level_girth(0.4)
