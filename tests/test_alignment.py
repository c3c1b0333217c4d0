"""Units and axes: reading them, applying them, and their errors. Detection is tested with the fits."""

import numpy as np
import pytest

from isp_assets.alignment import Alignment
from isp_assets.errors import MeshError
from isp_assets.geometry.surface_distance import Surface

TRIANGLE = Surface(np.array([[1.0, 0, 0], [0, 2.0, 0], [0, 0, 3.0]]), np.array([[0, 1, 2]]))


def test_z_up_becomes_y_up():
    np.testing.assert_allclose(
        Alignment("m", "z").apply(TRIANGLE).vertices, [[1, 0, 0], [0, 0, -2], [0, 3, 0]]
    )


def test_a_turn_is_about_the_vertical():
    np.testing.assert_allclose(
        Alignment("cm", "y", 90).apply(TRIANGLE).vertices, [[0, 0, -0.01], [0, 0.02, 0], [0.03, 0, 0]]
    )


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("turn", [0, 90, 180, 270])
def test_rotations_are_rotations(up, turn):
    rotation = Alignment("m", up, turn).rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)


def test_text_forms():
    assert Alignment.parse("m") == Alignment()
    assert Alignment.parse("CM, z") == Alignment("cm", "z")
    assert Alignment.parse("inch,y,180") == Alignment("inch", "y", 180)


@pytest.mark.parametrize("text", ["", "cm;z", "cm,x", "mile", "m,y,45", "m,y,z"])
def test_bad_text_is_refused(text):
    with pytest.raises(MeshError, match="alignment"):
        Alignment.parse(text)
