"""From a code to a garment, on analytic panels: areas, seams, texture, lift and its gradient, errors."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_panels import (
    JACKET_FRONT,
    SHIRT,
    SHIRT_SEAMS,
    SKIRT,
    SKIRT_SEAMS,
    DiscField,
    PillowAtlas,
    PolygonField,
    pillow_model,
    polygon_model,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from isp_assets.decode import (
    border_slopes,
    cut_panels,
    decode_garment,
    decode_with_report,
    lift_points,
    texture_coordinates,
    weld_points,
)
from isp_assets.errors import DecodeError
from isp_assets.garment import Garment
from isp_assets.geometry.sewing import sew_panels
from isp_assets.geometry.topology import boundary_loops, edges
from isp_assets.networks.panel_field import PanelField, PanelFieldConfig

ZERO = np.zeros(2, np.float32)


def _flat_areas(garment: Garment, side: str) -> np.ndarray:
    panel = garment.panels[side]
    a, b, c = (panel.panel_xy[panel.faces[:, k]].astype(float) for k in range(3))
    return 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])


def _check_garment(garment: Garment, num_loops: int) -> None:
    faces = garment.faces
    directed = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    assert len(np.unique(directed, axis=0)) == len(directed)
    assert edges(faces).num_faces.max() == 2
    assert len(boundary_loops(faces)) == num_loops
    assert (_flat_areas(garment, "front") > 0).all()
    assert (_flat_areas(garment, "back") < 0).all()
    assert garment.st.min() >= 0
    assert garment.st.max() <= 1


@pytest.fixture(scope="module")
def skirt():
    return polygon_model([SKIRT], [SKIRT], SKIRT_SEAMS, anchor_labels=(3,))


@pytest.fixture(scope="module")
def shirt():
    return polygon_model([SHIRT], [SHIRT], SHIRT_SEAMS)


@pytest.mark.parametrize("resolution", [32, 50, 128])
def test_polygons_come_back_exactly(skirt, resolution):
    garment = decode_garment(skirt, ZERO, resolution=resolution, name="skirt")
    _check_garment(garment, 2)
    for side in ("front", "back"):
        assert np.abs(_flat_areas(garment, side)).sum() == pytest.approx(0.5 * (1.2 + 0.6) * 1.3, rel=1e-5)
    corners = np.array([points[0] for _, points in SKIRT])
    distance = np.linalg.norm(garment.panels["front"].panel_xy[:, None] - corners, axis=-1).min(axis=0)
    assert distance.max() < 1e-5


def test_the_garment_keeps_what_it_was_made_from(skirt):
    garment = decode_garment(skirt, ZERO, resolution=32, name="skirt")
    assert (garment.name, garment.category) == ("skirt", "pillow")
    assert garment.rest_vertices.dtype == np.float32
    np.testing.assert_array_equal(garment.code, ZERO)
    again = decode_garment(skirt, ZERO, resolution=32, name="skirt")
    np.testing.assert_array_equal(garment.rest_vertices, again.rest_vertices)
    np.testing.assert_array_equal(garment.faces, again.faces)


def test_disc_area_and_perimeter_converge_with_second_order():
    model = pillow_model({"front": DiscField(), "back": DiscField()}, ((1, 1),))
    areas, rims = [], []
    for resolution in (32, 64, 128):
        garment = decode_garment(model, ZERO, resolution=resolution)
        _check_garment(garment, 1)
        panel = garment.panels["front"]
        areas.append(abs(_flat_areas(garment, "front").sum() - np.pi / 4))
        (loop,) = boundary_loops(panel.faces)
        rim = panel.panel_xy[loop].astype(float)
        rims.append(abs(np.linalg.norm(rim - np.roll(rim, 1, axis=0), axis=1).sum() - np.pi))
    for errors in (areas, rims):
        assert (np.log2(np.array(errors[:-1]) / errors[1:]) > 1.55).all(), errors


def test_sleeves_cuffs_and_neckline(shirt):
    _check_garment(decode_garment(shirt, ZERO, resolution=64), 4)


def test_an_open_front_has_two_pieces():
    model = polygon_model(JACKET_FRONT, [SHIRT], SHIRT_SEAMS)
    garment = decode_garment(model, ZERO, resolution=64)
    _check_garment(garment, 3)
    front = garment.panels["front"]
    sides = np.sign(front.panel_xy[front.faces][..., 0])
    assert (np.abs(sides.sum(axis=1)) == 3).all(), "no face spans the opening"


def test_the_surface_faces_outwards(skirt):
    garment = decode_garment(skirt, ZERO, resolution=32)
    a, b, c = (garment.rest_vertices[garment.faces[:, k]] for k in range(3))
    normal_z = np.cross(b - a, c - a)[:, 2]
    assert (normal_z[garment.face_panel == 0] > 0).all()
    assert (normal_z[garment.face_panel == 1] < 0).all()


def test_seam_vertices_are_the_mean_of_both_lifts(skirt):
    garment, report = decode_with_report(skirt, ZERO, resolution=32)
    assert report.seam_gap_mean == pytest.approx(0.2)
    assert report.seam_gap_max == pytest.approx(0.2)
    sewn = np.unique(np.concatenate([garment.panels["front"].vertex_index[s.front] for s in garment.seams]))
    np.testing.assert_allclose(garment.rest_vertices[sewn, 2], 0, atol=1e-7)


def test_the_inside_follows_its_seams_and_is_free_far_from_them(skirt):
    garment = decode_garment(skirt, ZERO, resolution=64)
    front = garment.panels["front"]
    height = garment.rest_vertices[front.vertex_index, 2]
    # Distance from the slanting side seams of the skirt.
    across = (
        (0.3 + 0.3 * (0.6 - front.panel_xy[:, 1]) / 1.3 - np.abs(front.panel_xy[:, 0]))
        * 1.3
        / np.hypot(1.3, 0.3)
    )
    np.testing.assert_allclose(height[across > 0.16], 0.1, atol=1e-7)
    middle = np.abs(front.panel_xy[:, 1]) < 0.4
    expected = 0.1 * (1 - np.clip(1 - across / 0.15, 0, 1) ** 2)
    np.testing.assert_allclose(height[middle], expected[middle], atol=6e-3)


def test_the_band_is_a_small_share_of_the_grid(shirt):
    assert decode_with_report(shirt, ZERO, resolution=128)[1].evaluated_share < 0.13
    assert decode_with_report(shirt, ZERO, resolution=64)[1].evaluated_share < 0.13


def test_texture_halves_do_not_overlap_and_read_from_left_to_right(shirt):
    garment = decode_garment(shirt, ZERO, resolution=32)
    front, back = garment.panels["front"].st, garment.panels["back"].st
    assert front[:, 0].max() < 0.5 < back[:, 0].min()
    # Seen from outside, s grows to the right and t upwards: every face turns left in the texture.
    st_faces = garment.st[garment.corner_st_index]
    edge_a, edge_b = st_faces[:, 1] - st_faces[:, 0], st_faces[:, 2] - st_faces[:, 0]
    turn = edge_a[:, 0] * edge_b[:, 1] - edge_a[:, 1] * edge_b[:, 0]
    assert (turn > 0).all()
    # A texture twice as wide as high shows the panels undistorted.
    flat = np.concatenate([_flat_areas(garment, side) for side in ("front", "back")])
    np.testing.assert_allclose(turn * 8, 2 * np.abs(flat), rtol=1e-3)


def test_texture_corners():
    corners = np.array([[-1.0, -1.0], [1.0, 1.0]])
    np.testing.assert_allclose(texture_coordinates("front", corners), [[0, 0], [0.5, 1]])
    np.testing.assert_allclose(texture_coordinates("back", corners), [[1, 0], [0.5, 1]])


def test_anchors_are_the_whole_waist(skirt):
    garment = decode_garment(skirt, ZERO, resolution=32)
    waist = np.flatnonzero(np.abs(garment.rest_vertices[:, 1] - 0.6) < 1e-6)
    np.testing.assert_array_equal(garment.anchors, waist)


def test_panels_in_metres(skirt):
    moved = replace(skirt, panel_center=np.array([0.1, -0.2], np.float32), panel_scale=0.5)
    garment = decode_garment(moved, ZERO, resolution=32)
    reference = decode_garment(skirt, ZERO, resolution=32)
    expected = 0.5 * reference.panels["back"].panel_xy + np.array([0.1, -0.2])
    np.testing.assert_allclose(garment.panels["back"].panel_xy, expected, atol=1e-6)


def test_the_code_shapes_the_panel(skirt):
    small = decode_garment(skirt, np.array([-0.05, 0.0]), resolution=64)
    large = decode_garment(skirt, np.array([0.0, 0.0]), resolution=64)
    assert np.ptp(small.panels["front"].panel_xy[:, 1]) == pytest.approx(
        np.ptp(large.panels["front"].panel_xy[:, 1]) - 0.1, abs=1e-4
    )


@given(st.integers(0, 2**31))
@settings(max_examples=8, deadline=None)
def test_label_noise_changes_nothing(seed):
    generator = torch.Generator().manual_seed(seed)
    noise = lambda logits: 3 * torch.randn(logits.shape, generator=generator)  # noqa: E731
    model = polygon_model([SHIRT], [SHIRT], SHIRT_SEAMS, noise=noise)
    garment = decode_garment(model, ZERO, resolution=32)
    _check_garment(garment, 4)
    assert len(garment.seams) == 6


def test_lift_moves_the_border_with_the_code():
    """Eq. 5: for a disc whose radius grows with the code, dv/dz is the normal on the border, 0 inside."""
    model = pillow_model({"front": DiscField(), "back": DiscField()}, ((1, 1),))
    sewn = sew_panels(
        cut_panels(model, ZERO, resolution=32).outlines, model.seam_pairs, spacing=1 / 16, sliver=0.06
    )
    code = torch.zeros(2, requires_grad=True)

    def vertices(z):
        return weld_points(sewn, lift_points(model, sewn, z, border=border_slopes(model, sewn, code)))

    values = vertices(code)
    by_radius, by_shift = (
        torch.autograd.functional.jvp(vertices, code, axis)[1].numpy() for axis in torch.eye(2)
    )
    np.testing.assert_allclose(by_shift, np.tile([1.0, 0.0, 0.0], (sewn.num_vertices, 1)), atol=1e-6)
    xy = np.zeros((sewn.num_vertices, 2))
    border = np.zeros(sewn.num_vertices, bool)
    for panel in sewn.panels.values():
        xy[panel.vertex_index] = panel.points
        border[panel.vertex_index[panel.border_label > 0]] = True
    radius = np.linalg.norm(xy, axis=1, keepdims=True)
    expected = np.where(border[:, None], xy / np.maximum(radius, 1e-9), 0)
    # Seam points of the two panels coincide here, so their mean is the same point.
    np.testing.assert_allclose(by_radius[:, :2], expected, atol=2e-4)
    np.testing.assert_allclose(by_radius[:, 2], 0)
    plain = weld_points(sewn, lift_points(model, sewn, code))
    torch.testing.assert_close(values, plain, rtol=0, atol=1e-7)


def test_gradient_of_the_lift_agrees_with_decoding_again(skirt):
    """Finite difference of the height of the hem, decoded afresh, against Eq. 5."""
    base, step = np.array([0.02, 0.0]), 1e-3
    cut = cut_panels(skirt, base, resolution=32)
    sewn = sew_panels(cut.outlines, SKIRT_SEAMS, spacing=1 / 16, sliver=0.06)
    code = torch.tensor(base, dtype=torch.float32, requires_grad=True)
    lifted = lift_points(skirt, sewn, code, border=border_slopes(skirt, sewn, code))["front"]
    run = dict(sewn.panels["front"].runs)[1]
    (gradient,) = torch.autograd.grad(lifted[run[len(run) // 2], 1], code)
    low, high = (
        decode_garment(skirt, base + np.array([d, 0.0]), resolution=32).panels["front"].panel_xy[:, 1].min()
        for d in (-step, step)
    )
    assert gradient[0].item() == pytest.approx((high - low) / (2 * step), rel=1e-2)


def test_an_empty_panel_is_reported(skirt):
    with pytest.raises(
        DecodeError, match=r"pillow 'rag' cannot be decoded.*front panel.*no inside.*norm 2.*nearer"
    ):
        decode_garment(skirt, np.array([-2.0, 0.0]), name="rag")


def test_a_panel_that_leaves_its_square_is_reported(skirt):
    with pytest.raises(DecodeError, match="edge of its square"):
        decode_garment(skirt, np.array([0.5, 0.0]))


def test_a_missing_partner_is_reported(shirt):
    """A sleeved front and a back without sleeves."""
    vest = [
        (1, [(-0.35, -0.7), (0.35, -0.7)]),
        (2, [(0.35, -0.7), (0.35, 0.1)]),
        (4, [(0.35, 0.1), (0.3, 0.48)]),
    ]
    vest += [
        (5, [(0.3, 0.48), (0.15, 0.5)]),
        (10, [(0.15, 0.5), (-0.15, 0.5)]),
        (6, [(-0.15, 0.5), (-0.3, 0.48)]),
    ]
    vest += [(7, [(-0.3, 0.48), (-0.35, 0.1)]), (9, [(-0.35, 0.1), (-0.35, -0.7)])]
    with pytest.raises(DecodeError, match=r"seam \([38], [38]\): the front panel .* no partner on the back"):
        decode_garment(polygon_model([SHIRT], [vest], SHIRT_SEAMS), ZERO)


@pytest.mark.parametrize("resolution", [0, 31, 513])
def test_resolution_limits(skirt, resolution):
    with pytest.raises(DecodeError, match=r"32\.\.512"):
        decode_garment(skirt, ZERO, resolution=resolution)


@pytest.mark.parametrize(
    ("code", "message"),
    [(np.zeros(3), "has 2 numbers"), (np.zeros(1), "has 2 numbers"), (np.array([np.nan, 0]), "NaN")],
)
def test_bad_codes(skirt, code, message):
    with pytest.raises(DecodeError, match=message):
        decode_garment(skirt, code)


def test_an_atlas_that_gives_nan_is_reported(skirt):
    atlases = {"front": PillowAtlas(float("nan")), "back": PillowAtlas(0.0)}
    with pytest.raises(DecodeError, match="NaN"):
        decode_garment(replace(skirt, atlases=atlases), ZERO, resolution=32)


def test_random_weights_give_a_garment_or_a_decode_error():
    """Whatever an untrained network draws, nothing but DecodeError comes out."""
    for seed in range(12):
        torch.manual_seed(seed)
        config = PanelFieldConfig(num_labels=4, code_size=2, width=16)
        fields = {side: PanelField(config) for side in ("front", "back")}
        for field in fields.values():
            with torch.no_grad():
                field.distance.layers[-1].weight.mul_(20)
                field.distance.layers[-1].bias.fill_(0.0)
                field.label.layers[-1].weight.mul_(20)
        try:
            garment = decode_garment(
                pillow_model(fields, SKIRT_SEAMS), np.random.default_rng(seed).normal(size=2), resolution=32
            )
        except DecodeError:
            continue
        assert edges(garment.faces).num_faces.max() <= 2


def test_noisy_polygon_fields_share_the_shape(shirt):
    field = shirt.panel_fields["front"]
    assert isinstance(field, PolygonField)
    xy = torch.rand(50, 2) * 2 - 1
    distance, _ = field(xy, torch.zeros(2))
    torch.testing.assert_close(distance, field.signed_distance(xy, torch.zeros(2)))
