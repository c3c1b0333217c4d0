"""Invariants of a garment, and what it derives from its panels."""

from dataclasses import replace

import numpy as np
import pytest

from isp_assets.errors import GarmentError
from isp_assets.garment import Garment, Panel, Seam

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
FRONT_FACES = np.array([[0, 1, 2], [0, 2, 3]])


def _panel(vertex_index, faces, shift: float) -> Panel:
    st = SQUARE * (0.5, 1.0) + (shift, 0.0)
    return Panel(SQUARE, faces, np.array(vertex_index), st, np.array([1, 2, 3, 4]))


def _garment(**changes) -> Garment:
    """Two unit squares sewn along their left and right sides: a sleeve of one cell."""
    panels = {
        "front": _panel([0, 1, 2, 3], FRONT_FACES, 0.0),
        "back": _panel([0, 1, 2, 3], FRONT_FACES[:, ::-1].copy(), 0.5),
    }
    values = {
        "name": "tube",
        "category": "skirt",
        "code": np.zeros(2),
        "rest_vertices": np.concatenate([SQUARE, np.zeros((4, 1))], axis=1),
        "rest_pose": np.zeros((24, 3)),
        "panels": panels,
        "seams": (
            Seam((2, 2), np.array([1, 2]), np.array([1, 2])),
            Seam((4, 4), np.array([3, 0]), np.array([3, 0])),
        ),
        "anchors": np.array([2, 3]),
    }
    return Garment(**{**values, **changes})


def _with(side: str, **changes) -> dict[str, Panel]:
    panels = dict(_garment().panels)
    panels[side] = replace(panels[side], **changes)
    return panels


def test_faces_and_corners_list_the_front_first():
    garment = _garment()
    assert garment.num_vertices == 4
    np.testing.assert_array_equal(garment.faces, [[0, 1, 2], [0, 2, 3], [2, 1, 0], [3, 2, 0]])
    np.testing.assert_array_equal(garment.face_panel, [0, 0, 1, 1])
    np.testing.assert_array_equal(garment.corner_xy[2], SQUARE[[2, 1, 0]])


def test_texture_corners_point_into_the_joined_list():
    garment = _garment()
    assert garment.st.shape == (8, 2)
    corners = garment.st[garment.corner_st_index]
    assert corners.shape == (4, 3, 2)
    for face, panel in enumerate(garment.face_panel):
        side = ("front", "back")[panel]
        own = garment.panels[side]
        np.testing.assert_array_equal(corners[face], own.st[own.faces[face - 2 * panel]])


def test_a_vertex_may_have_two_flat_positions_but_one_place():
    wider = _with("back", panel_xy=2 * SQUARE)
    garment = _garment(panels=wider)
    np.testing.assert_array_equal(garment.corner_xy[2], 2 * garment.corner_xy[0][::-1])


@pytest.mark.parametrize("keys", [("back", "front"), ("front",), ("front", "back", "collar")])
def test_panels_are_front_and_back_in_order(keys):
    panels = {key: _garment().panels["front"] for key in keys}
    with pytest.raises(GarmentError, match=r"panels must be \('front', 'back'\) in this order"):
        _garment(panels=panels)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_positions_must_be_finite(bad):
    rest = _garment().rest_vertices.copy()
    rest[2, 1] = bad
    with pytest.raises(GarmentError, match="NaN or infinity"):
        _garment(rest_vertices=rest)


@pytest.mark.parametrize(
    ("side", "changes", "message"),
    [
        ("front", {"faces": np.array([[0, 1, 4]])}, r"front panel: faces must lie in 0\.\.3, got 0\.\.4"),
        ("back", {"faces": np.array([[0, 1, -1]])}, r"back panel: faces must lie in 0\.\.3, got -1\.\.1"),
        (
            "back",
            {"vertex_index": np.array([0, 1, 2, 9])},
            r"back panel: vertex_index must lie in 0\.\.3, got 0\.\.9",
        ),
        ("front", {"vertex_index": np.array([0, 1, 1, 3])}, "front panel: a face uses one vertex twice"),
    ],
)
def test_indices_are_checked(side, changes, message):
    with pytest.raises(GarmentError, match=message):
        _garment(panels=_with(side, **changes))


def test_every_vertex_belongs_to_a_face():
    lonely = np.concatenate([_garment().rest_vertices, np.zeros((2, 3))])
    with pytest.raises(GarmentError, match="2 vertices belong to no face"):
        _garment(rest_vertices=lonely)


def test_a_seam_joins_vertices():
    rest = np.concatenate([_garment().rest_vertices, [[0.0, 0.0, 1.0]]])
    loose = _with("back", vertex_index=np.array([0, 1, 4, 3]))
    with pytest.raises(GarmentError, match=r"seam \(2, 2\) is not sewn"):
        _garment(rest_vertices=rest, panels=loose)


def test_seams_in_opposite_directions_are_not_sewn():
    seams = (Seam((2, 2), np.array([1, 2]), np.array([2, 1])),)
    with pytest.raises(GarmentError, match="not sewn"):
        _garment(seams=seams)


def test_a_garment_without_seams_or_anchors_is_a_garment():
    garment = _garment(seams=(), anchors=np.empty(0, int))
    assert garment.anchors.shape == (0,)
