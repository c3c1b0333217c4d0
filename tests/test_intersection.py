"""Intersection figures where they are known: spheres, planes, boxes."""

import numpy as np
import pytest
import trimesh
from collision_shapes import beside_fold, folded_tube

from isp_assets.errors import GeometryError
from isp_assets.geometry.closest import SurfaceTopology
from isp_assets.geometry.crossing import crossing_pairs
from isp_assets.geometry.intersection import INNER_REACH, Beneath, measure_intersection


def _beneath(mesh: trimesh.Trimesh, *, closed: bool = True) -> Beneath:
    faces = np.asarray(mesh.faces, np.int64)
    return Beneath(np.asarray(mesh.vertices), SurfaceTopology.build(faces, len(mesh.vertices)), closed=closed)


def _sheet(count: int, *, size: float = 1.0, height: float = 0.0, tilt: float = 0.0) -> trimesh.Trimesh:
    """A square sheet over the xz plane, facing up."""
    axis = np.linspace(-size / 2, size / 2, count + 1)
    x, z = np.meshgrid(axis, axis, indexing="ij")
    vertices = np.stack([x, height + tilt * x, z], -1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(count), np.arange(count), indexing="ij")
    a = (i * (count + 1) + j).reshape(-1)
    faces = np.concatenate(
        [np.stack([a, a + 1, a + count + 1], 1), np.stack([a + 1, a + count + 2, a + count + 1], 1)]
    )
    return trimesh.Trimesh(vertices, faces, process=False)


BALL = trimesh.creation.icosphere(subdivisions=4, radius=0.1)


def test_a_sphere_inside_a_sphere_is_all_wrong_and_one_outside_all_right() -> None:
    inner = trimesh.creation.icosphere(subdivisions=3, radius=0.09)
    outer = trimesh.creation.icosphere(subdivisions=3, radius=0.12)
    wrong = measure_intersection(inner.vertices, inner.faces, _beneath(BALL))
    right = measure_intersection(outer.vertices, outer.faces, _beneath(BALL))
    assert (wrong.area_percent, wrong.crossing_pairs) == (pytest.approx(100), 0)
    assert wrong.deepest == pytest.approx(0.01, rel=0.05)
    assert (right.area_percent, right.crossing_pairs, right.deepest) == (0, 0, 0)


def test_shifted_spheres_have_the_share_of_the_cap() -> None:
    """Equal spheres a distance d apart: the cap of each within the other has the share (1 - d / 2r) / 2."""
    other = BALL.copy().apply_translation([0.06, 0, 0])
    found = measure_intersection(other.vertices, other.faces, _beneath(BALL))
    assert found.area_percent == pytest.approx(50 * (1 - 0.06 / 0.2), abs=0.3)
    assert found.deepest == pytest.approx(0.06, abs=0.001)
    assert found.crossing_pairs > 0


def test_area_converges_where_a_sheet_cuts_a_ball() -> None:
    exact = 100 * np.pi * 0.1**2 / 0.4**2
    errors = []
    for count in (8, 32):
        sheet = _sheet(count, size=0.4)
        errors.append(
            abs(measure_intersection(sheet.vertices, sheet.faces, _beneath(BALL)).area_percent - exact)
        )
    assert errors[0] < 2.5
    assert errors[1] < 0.2


def test_a_tilted_sheet_is_half_beneath_an_inner_sheet() -> None:
    inner = _beneath(_sheet(10, size=0.4), closed=False)
    outer = _sheet(13, size=0.2, tilt=0.1)
    found = measure_intersection(outer.vertices, outer.faces, inner)
    assert found.area_percent == pytest.approx(50, abs=0.5)
    assert found.deepest == pytest.approx(0.01, rel=0.05)
    assert found.crossing_pairs > 13


def test_depth_beyond_reach_and_beyond_the_border_do_not_count() -> None:
    inner = _beneath(_sheet(10, size=0.4), closed=False)
    for outer in (
        _sheet(5, size=0.2, height=-1.05 * INNER_REACH),
        _sheet(5, size=0.1, height=-0.01).apply_translation([0.26, 0, 0]),
    ):
        assert measure_intersection(outer.vertices, outer.faces, inner).area_percent == 0
    deep = _sheet(5, size=0.2, height=-0.95 * INNER_REACH)
    assert measure_intersection(deep.vertices, deep.faces, inner).area_percent == pytest.approx(100)


def test_what_lies_outside_a_fold_that_cuts_itself_is_not_beneath() -> None:
    layer, (points, within) = trimesh.Trimesh(*folded_tube(), process=False), beside_fold()
    beneath = _beneath(layer, closed=False)
    wrong = beneath.depth(points)[0] > 0
    assert (beneath.closest(points[~within]).height < 0).sum() > 300
    assert not wrong[~within].any()
    near = within & (points[:, 1] > 0.065) & (points[:, 2] > 0.085)
    assert near.sum() > 50
    assert wrong[near].all()


def test_cloth_on_the_outer_side_of_buried_skin_is_excused_up_to_three_centimetres() -> None:
    """A sleeve about an arm inside the torso, and one so wide that it has nothing to do with the arm."""
    arm = trimesh.creation.icosphere(subdivisions=3, radius=0.02)
    body = _beneath(trimesh.util.concatenate([BALL, arm]))
    for radius, excused in ((0.04, 100), (0.065, 0)):
        sleeve = trimesh.creation.icosphere(subdivisions=3, radius=radius)
        found = measure_intersection(sleeve.vertices, sleeve.faces, body)
        assert found.unavoidable_percent == pytest.approx(excused)
        assert found.area_percent == pytest.approx(100 - excused)


def test_more_layers_need_more_room() -> None:
    """Slabs 14 mm apart: a second layer (11 mm) has room between them, a third one (16 mm) has none."""
    slabs = [trimesh.creation.box((0.3, 0.1, 0.3)).subdivide_to_size(0.05) for _ in range(2)]
    for slab, side in zip(slabs, (-1, 1), strict=True):
        slab.apply_translation([0, side * 0.057, 0])
    body = _beneath(trimesh.util.concatenate(slabs))
    inner = _sheet(10, size=0.1, height=0.001)
    outer = _sheet(10, size=0.08, height=-0.001)
    faces = np.asarray(inner.faces, np.int64)
    topology = SurfaceTopology.build(faces, len(inner.vertices))
    beneath = Beneath(np.asarray(inner.vertices), topology, closed=False, body=body)
    for layers, excused in ((1, 0), (2, 100)):
        found = measure_intersection(outer.vertices, outer.faces, beneath, layers=layers)
        assert found.unavoidable_percent == pytest.approx(excused)
        assert found.area_percent == pytest.approx(100 - excused)


def test_a_body_that_cuts_itself_still_has_one_inside_and_its_seam_is_excused() -> None:
    twin = trimesh.util.concatenate([BALL, BALL.copy().apply_translation([0.15, 0, 0])])
    body = _beneath(twin)
    centre = trimesh.creation.icosphere(subdivisions=2, radius=0.005).apply_translation([0.075, 0, 0])
    deep = measure_intersection(centre.vertices, centre.faces, body)
    assert deep.area_percent + deep.unavoidable_percent == pytest.approx(100)
    lens = (np.abs(twin.vertices[:, 0] - 0.075) < 0.01) & (
        np.linalg.norm(twin.vertices[:, 1:], axis=1) < 0.06
    )
    assert body.without_room[lens].all()
    assert not body.without_room[np.abs(twin.vertices[:, 0] - 0.075) > 0.06].any()
    # Cloth stretched across the seam between the balls: it must cut there, and is excused.
    collar = trimesh.creation.cylinder(radius=0.062, height=0.01, sections=60)
    collar.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0])).apply_translation(
        [0.075, 0, 0]
    )
    side = np.abs(collar.face_normals[:, 0]) < 0.5
    found = measure_intersection(collar.vertices, collar.faces[side], body)
    assert found.area_percent < 0.01 * max(found.unavoidable_percent, 1)


def test_crossing_pairs_of_two_triangles() -> None:
    flat = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    face = np.array([[0, 1, 2]])
    upright = np.array([[0.2, 0.2, -1], [0.2, 0.2, 1], [0.2, 2, 1]], float)
    assert crossing_pairs(flat, face, upright, face).tolist() == [[0, 0]]
    assert len(crossing_pairs(flat, face, np.add(upright, [0, 0, 1.001]), face)) == 0
    assert len(crossing_pairs(flat, face, np.add(upright, [5, 0, 0]), face)) == 0


def test_pairs_are_numbered_in_the_meshes_given() -> None:
    """Faces put aside by their boxes must not shift the numbers."""
    sheet, ball = _sheet(8, size=0.4), BALL
    pairs = crossing_pairs(sheet.vertices, sheet.faces, ball.vertices, ball.faces)
    a, b = sheet.triangles[pairs[:, 0]], ball.triangles[pairs[:, 1]]
    assert len(pairs) > 20
    assert ((a.max(1) >= b.min(1)) & (b.max(1) >= a.min(1))).all()


def test_bad_input_is_refused() -> None:
    sheet = _sheet(2)
    with pytest.raises(GeometryError, match="closed surface"):
        _beneath(sheet, closed=True)
    with pytest.raises(GeometryError, match="NaN"):
        measure_intersection(np.full((3, 3), np.nan), np.array([[0, 1, 2]]), _beneath(BALL))


def test_crossing_pairs_come_in_one_order() -> None:
    """They are found by several threads; what lifts them must not depend on which was first."""
    rng = np.random.default_rng(0)
    faces = np.arange(900).reshape(-1, 3)
    first, second = (rng.uniform(size=(300, 1, 3)) + 0.1 * rng.normal(size=(300, 3, 3)) for _ in range(2))
    found = [crossing_pairs(first.reshape(-1, 3), faces, second.reshape(-1, 3), faces) for _ in range(5)]
    assert len(found[0]) > 100
    assert all(np.array_equal(found[0], again) for again in found[1:])
    np.testing.assert_array_equal(found[0], np.unique(found[0], axis=0))
