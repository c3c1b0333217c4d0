"""Edges, hinges, border loops and welding on meshes whose answers are known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from isp_assets.errors import GeometryError
from isp_assets.geometry.topology import boundary_loops, edges, hinges, weld

TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
RING = np.array(
    [[i, (i + 1) % 6, i + 6] for i in range(6)] + [[(i + 1) % 6, (i + 1) % 6 + 6, i + 6] for i in range(6)]
)


def test_edges_of_a_closed_mesh_have_two_faces():
    mesh = edges(TETRAHEDRON)
    assert mesh.vertices.tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]
    assert mesh.num_faces.tolist() == [2] * 6
    directed = np.stack([TETRAHEDRON, np.roll(TETRAHEDRON, -1, 1)], -1)
    assert np.array_equal(mesh.vertices[mesh.face_edge], np.sort(directed, -1))


def test_hinges_name_the_edge_and_both_opposite_corners():
    found = hinges(TETRAHEDRON)
    assert len(found.vertices) == 6
    for vertices, faces, corners in zip(found.vertices, found.faces, found.corners, strict=True):
        assert sorted(vertices.tolist()) == [0, 1, 2, 3]
        for k in (0, 1):
            assert TETRAHEDRON[faces[k]][corners[k]].tolist() == [vertices[0], vertices[1], vertices[2 + k]]


def test_hinges_of_faces_wound_both_ways_start_at_the_same_vertex():
    found = hinges(np.array([[0, 1, 2], [0, 1, 3]]))
    assert found.vertices.tolist() == [[0, 1, 2, 3]]


def test_three_faces_at_an_edge_are_refused():
    with pytest.raises(GeometryError, match=r"edge \[0, 1\] has 3 faces"):
        hinges(np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]))


def test_a_ring_has_two_border_loops_with_the_surface_on_the_left():
    first, second = boundary_loops(RING)
    assert first.tolist() == [0, 1, 2, 3, 4, 5]
    assert second.tolist() == [6, 11, 10, 9, 8, 7]
    assert boundary_loops(TETRAHEDRON) == []


def test_touching_loops_are_refused():
    with pytest.raises(GeometryError, match="loops touch"):
        boundary_loops(np.array([[0, 1, 2], [0, 3, 4]]))


@given(st.integers(1, 30), st.lists(st.tuples(st.integers(0, 29), st.integers(0, 29)), max_size=40))
def test_weld_is_the_finest_merge_that_joins_all_pairs(count, pairs):
    pairs = np.array([(a % count, b % count) for a, b in pairs], dtype=np.int64).reshape(-1, 2)
    vertex, total = weld(count, pairs)
    assert np.array_equal(vertex[pairs[:, 0]], vertex[pairs[:, 1]])
    leader = list(range(count))  # union by exhaustive relabelling
    for a, b in pairs.tolist():
        leader = [leader[a] if x == leader[b] else x for x in leader]
    assert total == len(set(leader))
    order = list(dict.fromkeys(vertex.tolist()))
    assert order == list(range(total))  # numbered by first appearance


def test_weld_refuses_points_that_do_not_exist():
    with pytest.raises(GeometryError, match=r"0\.\.3, got 0\.\.4"):
        weld(4, np.array([[0, 4]]))
