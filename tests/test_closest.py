"""Closest points and signed heights against shapes whose answer is known."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from isp_assets.errors import GeometryError
from isp_assets.geometry.closest import ClosestQuery, SurfacePart, SurfaceTopology, signed_heights


def _query(mesh: trimesh.Trimesh) -> ClosestQuery:
    faces = np.asarray(mesh.faces, np.int64)
    return ClosestQuery(np.asarray(mesh.vertices), SurfaceTopology.build(faces, len(mesh.vertices)))


def _box_height(points: np.ndarray) -> np.ndarray:
    """Exact signed distance to the cube [-.5, .5]^3."""
    q = np.abs(points) - 0.5
    return np.linalg.norm(q.clip(0), axis=1) + q.max(axis=1).clip(max=0)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10_000))
def test_cube_height_is_exact_at_faces_edges_and_corners(seed: int) -> None:
    points = np.random.default_rng(seed).uniform(-1, 1, (64, 3))
    found = _query(trimesh.creation.box())(points)
    np.testing.assert_allclose(found.height, _box_height(points), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(points - found.point, axis=1), np.abs(found.height), atol=1e-12)
    assert not found.on_border.any()


def test_pseudonormal_at_cube_corner_is_the_diagonal_whatever_the_triangulation() -> None:
    points = np.array([[0.9, 0.9, 0.9], [-0.8, 0.8, 0.8]])
    found = _query(trimesh.creation.box())(points)
    np.testing.assert_allclose(found.normal, np.sign(points) / np.sqrt(3), atol=1e-12)


def test_sphere_height_converges_with_refinement() -> None:
    points = np.random.default_rng(0).normal(size=(200, 3))
    exact = np.linalg.norm(points, axis=1) - 1
    spheres = [_query(trimesh.creation.icosphere(subdivisions=n)) for n in (2, 3, 4)]
    coarse, middle, fine = (np.abs(sphere(points).height - exact).max() for sphere in spheres)
    assert coarse / middle > 3  # second order
    assert middle / fine > 3


def test_sign_does_not_flip_at_a_sharp_ridge() -> None:
    """A thin wedge: the nearest face alone would give the wrong side beyond the ridge."""
    vertices = np.array([[0, 0, -1], [0, 0, 1], [1, 0.05, 0], [1, -0.05, 0]], float)
    wedge = trimesh.convex.convex_hull(vertices)
    points = np.array([[-0.1, 0.02, 0.1], [-0.1, -0.02, -0.2], [0.7, 0, 0]])
    assert (np.sign(_query(wedge)(points).height) == [1, 1, -1]).all()


def test_border_is_reported_on_an_open_sheet() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]], float)
    faces = np.array([[0, 2, 1], [0, 3, 2]])
    query = ClosestQuery(vertices, SurfaceTopology.build(faces, 4))
    found = query(np.array([[0.5, 0.2, 0.5], [0.3, -0.1, 0.2], [1.5, 0.1, 0.5], [-1, 0, -1]]))
    assert found.on_border.tolist() == [False, False, True, True]
    np.testing.assert_allclose(found.height[:2], [0.2, -0.1], atol=1e-12)
    heights = signed_heights(np.array([[[1.5, 0.1, 0.5], [0.5, 0.2, 0.5]]]), vertices[None], query.topology)
    assert np.isnan(heights[0, 0])
    assert heights[0, 1] == pytest.approx(0.2)


def test_heights_do_not_change_under_rigid_motion() -> None:
    rng = np.random.default_rng(1)
    mesh = trimesh.creation.icosphere(subdivisions=2)
    points = rng.normal(size=(50, 3))
    before = _query(mesh)(points)
    turn = trimesh.transformations.random_rotation_matrix(rng.random(3))
    moved = mesh.copy().apply_transform(turn)
    after = _query(moved)(points @ turn[:3, :3].T)
    np.testing.assert_allclose(after.height, before.height, atol=1e-12)
    np.testing.assert_allclose(after.normal, before.normal @ turn[:3, :3].T, atol=1e-9)


@pytest.mark.parametrize(
    ("faces", "count", "words"),
    [
        (np.zeros((0, 3), np.int64), 3, "no faces"),
        (np.array([[0, 1, 3]]), 3, "0..2"),
        (np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]), 5, "3 faces"),
    ],
)
def test_bad_surfaces_are_refused(faces: np.ndarray, count: int, words: str) -> None:
    with pytest.raises(GeometryError, match=words):
        SurfaceTopology.build(faces, count)


def test_bad_positions_are_refused() -> None:
    topology = SurfaceTopology.build(np.array([[0, 1, 2]]), 3)
    with pytest.raises(GeometryError, match="3 vertices, got 4"):
        ClosestQuery(np.zeros((4, 3)), topology)
    with pytest.raises(GeometryError, match="NaN"):
        ClosestQuery(np.full((3, 3), np.nan), topology)
    with pytest.raises(GeometryError, match="frames"):
        signed_heights(np.zeros((2, 1, 3)), np.zeros((1, 3, 3)), topology)


def test_no_points_give_no_answers() -> None:
    assert len(_query(trimesh.creation.box())(np.zeros((0, 3))).height) == 0


def test_a_part_knows_where_it_was_cut_out() -> None:
    """Half of a ball: above its inside the closest point lies on the cut, where no side is known."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64)
    topology = SurfaceTopology.build(faces, len(vertices))
    lower = np.flatnonzero(vertices[faces].mean(1)[:, 1] < 0)
    query = ClosestQuery(vertices, topology, part=SurfacePart.build(topology, lower))
    found = query(np.array([[0.0, 0.06, 0.0], [0.0, -0.15, 0.0], [0.0, -0.06, 0.0], [0.13, 0.04, 0.0]]))
    assert found.on_cut.tolist() == [True, False, False, True]
    assert not found.on_border.any()
    np.testing.assert_allclose(found.height[1:3], [0.05, -0.04], atol=2e-3)


def test_the_whole_surface_has_no_cut() -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    faces = np.asarray(mesh.faces, np.int64)
    topology = SurfaceTopology.build(faces, len(mesh.vertices))
    whole = SurfacePart.build(topology, np.arange(len(faces)))
    assert not whole.cut_edge.any()
    assert not whole.cut_vertex.any()
