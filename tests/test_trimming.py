"""Cutting off tucked cloth: clean borders, whole garments, and what stays."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from collision_shapes import grid
from hypothesis import given, settings
from hypothesis import strategies as st

from isp_assets.body import Body
from isp_assets.collection import Collection
from isp_assets.conventions import FrameRange
from isp_assets.drape import DrapeOptions, drape
from isp_assets.dressing import WornGarment, dress
from isp_assets.errors import DrapeError, GarmentError
from isp_assets.geometry.cutting import faces_without
from isp_assets.geometry.geodesic import distance_along
from isp_assets.geometry.topology import boundary_loops, edges
from isp_assets.motion import Motion
from isp_assets.shot import Shot
from isp_assets.synthetic import synthetic_garment

ROWS, COLUMNS = 7, 9
SHEET = grid(ROWS, COLUMNS)
RESOLUTION = 48


def _at(*places: tuple[int, int]) -> np.ndarray:
    gone = np.zeros(ROWS * COLUMNS, bool)
    gone[[row * COLUMNS + column for row, column in places]] = True
    return gone


def _row(row: int) -> list[tuple[int, int]]:
    return [(row, column) for column in range(COLUMNS)]


def test_a_row_that_goes_takes_its_faces_and_the_smaller_piece() -> None:
    stay = faces_without(SHEET, _at(*_row(2)))
    assert set(SHEET[stay].ravel() // COLUMNS) == {3, 4, 5, 6}
    assert stay.sum() == 3 * (COLUMNS - 1) * 2
    assert faces_without(SHEET, _at()).all()
    assert not faces_without(SHEET, ~_at()).any()


def test_borders_that_would_touch_in_a_vertex_are_drawn_apart() -> None:
    """Without the neighbours on either side a vertex would join two corners; it goes as well."""
    gone = _at((3, 3), (3, 5))
    assert _touching(SHEET[~gone[SHEET].any(1)])
    left = SHEET[faces_without(SHEET, gone)]
    assert not _touching(left)
    boundary_loops(left)


def _touching(faces: np.ndarray) -> bool:
    mesh = edges(faces)
    return bool((np.bincount(mesh.vertices[mesh.num_faces == 1].ravel()) > 2).any())


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, ROWS * COLUMNS - 1), max_size=25))
def test_whatever_goes_the_rest_has_clean_borders(indices: list[int]) -> None:
    gone = np.zeros(ROWS * COLUMNS, bool)
    gone[indices] = True
    left = SHEET[faces_without(SHEET, gone)]
    assert not gone[left].any()
    if len(left):
        assert not _touching(left)
        reached = distance_along(np.zeros((ROWS * COLUMNS, 3)), left, left[0, :1])
        assert np.isfinite(reached[left]).all()


def test_ways_along_a_sheet_are_those_over_its_edges() -> None:
    y, x = np.divmod(np.arange(ROWS * COLUMNS), COLUMNS)
    flat = np.stack([x, y, 0 * x], 1).astype(float)
    far = distance_along(flat, SHEET, np.array([0]))
    np.testing.assert_allclose(far[:COLUMNS], np.arange(COLUMNS))
    diagonal = np.minimum(x, y)
    np.testing.assert_allclose(far, np.abs(x - y) + np.sqrt(2) * diagonal)
    assert np.isinf(distance_along(flat, SHEET, np.array([0]), limit=3.5)[COLUMNS - 1])
    assert np.isinf(distance_along(flat, SHEET, np.array([], int))).all()


def test_a_garment_keeps_its_flat_shape_texture_seams_and_anchors() -> None:
    whole = synthetic_garment("vest", radius=0.24)
    kept = (whole.rest_vertices[whole.faces][..., 1] > 1.05).all(1)
    part, vertices = whole.with_faces(kept)
    np.testing.assert_array_equal(part.rest_vertices, whole.rest_vertices[vertices])
    np.testing.assert_array_equal(vertices[part.faces], whole.faces[kept])
    np.testing.assert_array_equal(part.corner_xy, whole.corner_xy[kept])
    np.testing.assert_array_equal(part.st[part.corner_st_index], whole.st[whole.corner_st_index[kept]])
    np.testing.assert_array_equal(vertices[part.anchors], whole.anchors)
    assert [seam.labels for seam in part.seams] == [seam.labels for seam in whole.seams]
    assert {len(seam.front) for seam in part.seams} == {5}
    assert len(boundary_loops(part.faces)) == 2


def test_a_seam_that_is_cut_in_the_middle_becomes_two() -> None:
    whole = synthetic_garment("vest", radius=0.24)
    seam = whole.seams[0]
    middle = whole.panels["front"].vertex_index[seam.front[3]]
    part, _ = whole.with_faces(~(whole.faces == middle).any(1))
    assert [len(s.front) for s in part.seams if s.labels == seam.labels] == [3, 3]


def test_a_garment_without_faces_is_refused() -> None:
    whole = synthetic_garment("vest", radius=0.24)
    with pytest.raises(GarmentError, match="no face is left"):
        whole.with_faces(np.zeros(len(whole.faces), bool))


def _dressed(*names: str, depth: float | None) -> tuple[WornGarment, ...]:
    outfit = Collection.load().outfit(list(names))
    return dress(outfit, Body.load("default"), torch.zeros(10), resolution=RESOLUTION, tuck_depth=depth)


def test_a_tucked_hem_is_kept_down_to_its_depth() -> None:
    whole, trousers = _dressed("long_sleeved_shirt", "trousers", depth=None)
    waist = trousers.rest[trousers.layer.garment.anchors][:, 1]
    sizes = []
    for depth in (0.03, 0.08):
        shirt, cover = _dressed("long_sleeved_shirt", "trousers", depth=depth)
        np.testing.assert_array_equal(cover.rest, trousers.rest)
        low = shirt.rest[:, 1].min()
        assert waist.min() - depth - 0.03 < low < waist.min() - 0.9 * depth
        assert 0.02 < shirt.layer.trimmed < 0.3
        # What is left is the same cloth: skinning, networks and rest metric know no cut.
        np.testing.assert_allclose(shirt.rest, whole.rest[_same(shirt, whole)], atol=1e-6)
        sizes.append(len(shirt.rest))
    assert sizes[0] < sizes[1] < len(whole.rest)
    assert whole.layer.trimmed == trousers.layer.trimmed == 0


def _same(part: WornGarment, whole: WornGarment) -> np.ndarray:
    rows = {tuple(p): k for k, p in enumerate(whole.layer.garment.rest_vertices.tolist())}
    return np.array([rows[tuple(p)] for p in part.layer.garment.rest_vertices.tolist()])


@pytest.mark.parametrize(
    "names", [("trousers", "tee"), ("tee", "open_jacket"), ("slim_trousers", "midi_skirt")]
)
def test_what_hangs_outside_or_is_held_or_not_covered_stays_whole(names: tuple[str, str]) -> None:
    assert [worn.layer.trimmed for worn in _dressed(*names, depth=0.05)] == [0, 0]


def test_a_trimmed_shirt_is_draped_like_the_whole_one_where_both_are_seen() -> None:
    outfit, body = Collection.load().outfit(["tee", "trousers"]), Body.load("default")
    shot = Shot("walk", body, Motion.load("walk").select(FrameRange(50, 50)))
    options = DrapeOptions(resolution=RESOLUTION, tuck_depth=0.05)
    (short,), (long,) = (list(drape(outfit, shot, replace(options, tuck_depth=d))) for d in (0.05, None))
    assert len(short.layers[0][0]) < len(long.layers[0][0])
    worn = [_dressed("tee", "trousers", depth=d)[0] for d in (0.05, None)]
    rows = _same(*worn)
    seen = worn[0].rest[:, 1] > worn[0].rest[:, 1].min() + 0.1
    off = np.linalg.norm(short.layers[0][0] - long.layers[0][0][rows], axis=1)[seen]
    assert np.percentile(off, 99) < 0.005


def test_a_negative_depth_is_refused() -> None:
    with pytest.raises(DrapeError, match="tuck_depth must be at least 0 m"):
        DrapeOptions(tuck_depth=-0.01)
