"""Textures: cloth at its physical size, stitches at seams and hems, nothing foreign beyond the edge."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isp_assets.bake import FabricStyle, bake_texture, border_loops
from isp_assets.errors import GarmentError, InputError
from isp_assets.fabric_style import REPEATS, weave
from isp_assets.garment import Garment
from isp_assets.synthetic import synthetic_garment


@pytest.fixture(scope="module")
def garment() -> Garment:
    return synthetic_garment("vest", radius=0.24, columns=13, rows=9)


def flipped_st(garment: Garment, matrix: np.ndarray, shift: np.ndarray) -> Garment:
    """The garment with its front panel's st transformed."""
    front = garment.panels["front"]
    panels = {**garment.panels, "front": replace(front, st=front.st @ matrix.T + shift)}
    return replace(garment, panels=panels)


@pytest.mark.parametrize("kind", sorted(REPEATS))
def test_is_an_image_twice_as_wide_as_high_and_the_same_every_time(garment: Garment, kind: str) -> None:
    style = FabricStyle((0.3, 0.4, 0.6), kind)
    first = bake_texture(garment, style, height=64)
    assert first.shape == (64, 128, 3)
    assert first.dtype == np.uint8
    assert np.array_equal(first, bake_texture(garment, style, height=64))


def test_mean_colour_is_the_cloths_and_also_fills_the_margin(garment: Garment) -> None:
    style = FabricStyle((0.7, 0.3, 0.2))
    image = bake_texture(garment, style, height=512)
    margin = image[0, [0, 511, 512, 1023]]
    np.testing.assert_allclose(margin / 255, np.tile(style.color, (4, 1)), atol=0.02)


def test_cloth_continues_beyond_the_edge(garment: Garment) -> None:
    """Just outside a hem the stripes go on; far outside there is one colour."""
    style = FabricStyle((1.0, 1.0, 1.0), "stripes", (0.0, 0.0, 0.0))
    image = bake_texture(garment, style, height=512).astype(int)
    bottom = int((1 - garment.panels["front"].st[:, 1].min()) * 512)
    columns = slice(100, 400)
    assert np.ptp(image[bottom + 5, columns, 0]) > 200
    assert np.ptp(image[bottom + 40, columns, 0]) == 0


def test_stripes_have_their_physical_width(garment: Garment) -> None:
    """Counting edges across 0.6 m of cloth gives the repeat, whatever the image size."""
    style = FabricStyle((1.0, 1.0, 1.0), "stripes", (0.0, 0.0, 0.0), scale=0.05)
    for height in (256, 512):
        image = bake_texture(garment, style, height=height)
        panel = garment.panels["front"]
        metres = np.ptp(panel.panel_xy[:, 0]) / np.ptp(panel.st[:, 0])
        row = image[height // 2, :height, 0].astype(int)
        inside = row[int(panel.st[:, 0].min() * 2 * height) + 8 : int(panel.st[:, 0].max() * 2 * height) - 8]
        edges = np.count_nonzero(np.diff(inside > 127))
        assert edges == pytest.approx(2 * len(inside) / (2 * height) * metres / 0.05, abs=1.5)


def test_hem_and_seam_carry_stitches_at_their_own_depth(garment: Garment) -> None:
    """Thread lies 10 mm inside the hem and 3 mm inside the seam, and nowhere in the middle of the cloth."""
    image = bake_texture(garment, FabricStyle((0.1, 0.15, 0.4), "denim"), height=1024).astype(float)
    redness = image[..., 0] - image[..., 2]  # ochre thread on blue cloth
    panel = garment.panels["front"]
    per_metre = np.ptp(panel.st[:, 0]) * 2048 / np.ptp(panel.panel_xy[:, 0])
    bottom, left = (1 - panel.st[:, 1].min()) * 1024, panel.st[:, 0].min() * 2048
    middle_row, middle_column = int(1024 * (1 - panel.st[:, 1].mean())), int(2048 * panel.st[:, 0].mean())
    hem = redness[int(bottom - 0.010 * per_metre), middle_column - 100 : middle_column + 100]
    seam = redness[middle_row - 100 : middle_row + 100, int(left + 0.003 * per_metre)]
    cloth = redness[middle_row - 50 : middle_row + 50, middle_column - 100 : middle_column + 100]
    assert cloth.max() < 0
    for line in (hem, seam):
        assert 0.4 < (line > 0).mean() < 0.95  # dashes, with gaps between them


@settings(max_examples=25, deadline=None)
@given(pixel=st.floats(0.0005, 0.02), scale=st.floats(0.002, 0.05))
def test_a_coarse_pixel_sees_the_mean_of_fine_ones(pixel: float, scale: float) -> None:
    """Bars are averaged over a pixel in closed form, so 8 fine pixels average to one coarse pixel."""
    style = FabricStyle(kind="stripes", scale=scale)
    coarse, fine = (
        weave(
            style, ((np.arange(n) + 0.5) * size)[None].astype(np.float32), np.zeros((1, 1), np.float32), size
        )[1]
        for n, size in ((16, pixel), (128, pixel / 8))
    )
    np.testing.assert_allclose(fine.reshape(16, 8).mean(1), coarse[0], atol=4e-3)


@pytest.mark.parametrize("kind", sorted(REPEATS))
def test_detail_finer_than_a_pixel_fades(kind: str) -> None:
    """Seen from afar every cloth is nearly one tone: no moire."""
    u = (np.arange(64) + 0.5).astype(np.float32) * np.float32(0.5)
    shade, second = weave(FabricStyle(kind=kind), u[None], u[:, None], 0.5)
    assert np.ptp(shade) < 0.06
    assert np.ptp(second) < 0.06


def test_mirrored_and_rotated_st_are_accepted(garment: Garment) -> None:
    """A back panel may be drawn mirrored; a turned one takes the general path and gives the turned image."""
    style = FabricStyle((0.8, 0.2, 0.2), "stripes", (0.1, 0.1, 0.6))
    plain = bake_texture(garment, style, height=256)[:, :256]
    mirrored = flipped_st(garment, np.diag([-1.0, 1.0]), np.array([0.5, 0.0]))
    reflected = bake_texture(mirrored, style, height=256)[:, 255::-1].astype(int)
    assert np.abs(reflected - plain).mean() < 1
    quarter = flipped_st(garment, np.array([[0.0, -0.5], [2.0, 0.0]]), np.array([0.5, 0.0]))
    turned = np.rot90(bake_texture(quarter, style, height=256)[:, :256], -1).astype(int)
    assert np.abs(turned - plain).mean() < 1


def test_border_loops_follow_the_outline_once(garment: Garment) -> None:
    panel = garment.panels["front"]
    (loop,) = border_loops(panel)
    assert sorted(loop) == sorted(np.flatnonzero(panel.border_label))
    x, y = panel.panel_xy[loop].T
    assert 0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) == pytest.approx(np.pi * 0.24 * 0.5)


def test_bad_input_is_refused(garment: Garment) -> None:
    with pytest.raises(InputError, match="height"):
        bake_texture(garment, FabricStyle(), height=4)
    with pytest.raises(GarmentError, match="half"):
        bake_texture(flipped_st(garment, np.eye(2), np.array([0.3, 0.0])), FabricStyle())
    front = garment.panels["front"]
    bent = replace(front, st=front.st + 0.02 * front.st[:, 1:] ** 2 * [1, 0])
    with pytest.raises(GarmentError, match="affine"):
        bake_texture(replace(garment, panels={**garment.panels, "front": bent}), FabricStyle())


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ({"kind": "velvet"}, "plain"),
        ({"color": (0.1, 0.2, 1.5)}, "0..1"),
        ({"accent": (0.1, -0.2, 0.5)}, "accent"),
        ({"scale": 0.0}, "scale"),
    ],
)
def test_bad_styles_are_refused(field: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        FabricStyle(**field)


def test_colours_from_text() -> None:
    style = FabricStyle.from_text(color="#ff0080", kind="checks", accent="#000000", scale=0.02)
    assert style.color == (1.0, 0.0, 128 / 255)
    assert style.second_color == (0.0, 0.0, 0.0)
    with pytest.raises(InputError, match="#e8e4da"):
        FabricStyle.from_text(color="red")
