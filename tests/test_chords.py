"""Halving the inner edges between seam points."""

import numpy as np
import pytest

from isp_assets.geometry.chords import split_chords
from isp_assets.geometry.topology import edges


def test_splitting_chords_keeps_area_and_winding():
    points = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [2.0, 0.5]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [1, 4, 2]])
    for sewn in np.array(np.meshgrid(*[[False, True]] * 5)).reshape(5, -1).T:
        new_points, new_faces = split_chords(points, faces, sewn)
        a, b, c = (new_points[new_faces[:, k]] for k in range(3))
        area = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
        assert (area > 0).all()
        assert area.sum() == pytest.approx(1.5)
        mesh = edges(new_faces)
        inner = mesh.vertices[mesh.num_faces == 2]
        full = np.concatenate([sewn, np.zeros(len(new_points) - 5, bool)])
        assert not full[inner].all(axis=1).any()
        assert len(new_points) == 5 + int(sewn[0] and sewn[2]) + int(sewn[1] and sewn[2])


def test_without_chords_nothing_changes():
    points, faces = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), np.array([[0, 1, 2]])
    same_points, same_faces = split_chords(points, faces, np.ones(3, dtype=bool))
    assert same_points is points
    assert same_faces is faces
