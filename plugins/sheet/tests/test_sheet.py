"""The contact sheet: the life cycle of its writer, and what its pictures show."""

import os
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from isp_assets.errors import MissingExtraError, PluginError
from isp_assets.plugin_conformance import check_writer, write_shot
from isp_assets.synthetic import synthetic_shot
from isp_assets_plugins.sheet import Camera, RenderMesh, SheetStyle, SheetWriter, render_view
from isp_assets_plugins.sheet.camera import View
from isp_assets_plugins.sheet.texture import MipTexture, linear_from_srgb, srgb_from_linear
from isp_assets_plugins.sheet.tracer import Tracer
from isp_assets_plugins.sheet.writer import _Frame, _heading

SMALL = partial(SheetWriter, SheetStyle(columns=3, cell=(40, 50), samples=1))


def _square(z: float, half: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Two triangles that face +Z."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float) * half
    return np.c_[corners, np.full(4, z)], np.array([[0, 1, 2], [0, 2, 3]])


def test_conforms(tmp_path):
    check_writer(SMALL, tmp_path)


def test_sheet_opens_and_is_not_blank(tmp_path):
    write_shot(SMALL, tmp_path / "shot.png", synthetic_shot())
    pixels = np.asarray(Image.open(tmp_path / "shot.png"))
    assert pixels.shape[2] == 3
    assert pixels.reshape(-1, 3).std(0).min() > 10


def test_shot_cut_short_is_refused(tmp_path):
    shot = synthetic_shot()
    writer = SheetWriter()
    writer.begin(tmp_path / "shot.png", shot.scene)
    writer.add(next(iter(shot.chunks(1))))
    with pytest.raises(PluginError, match="never added"):
        writer.finish()
    assert not list(tmp_path.iterdir())


def test_broken_positions_are_refused(tmp_path):
    shot = synthetic_shot()
    chunk = next(iter(shot.chunks(2)))
    chunk.layers[0][0, 0, 0] = np.nan
    writer = SheetWriter()
    writer.begin(tmp_path / "shot.png", shot.scene)
    with pytest.raises(PluginError, match="frame 1001 has NaN"):
        writer.add(chunk)


def test_disk_error_leaves_no_file(tmp_path, monkeypatch):
    def broken(source: Path, target: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", broken)
    with pytest.raises(OSError, match="No space"):
        write_shot(SMALL, tmp_path / "shot.png", synthetic_shot())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("yaw", [0.0, 37.0, 90.0, 180.0, -120.0])
def test_heading_is_the_turn_of_the_garments(yaw):
    shot = synthetic_shot()
    a = np.radians(yaw)
    turn = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    layers = tuple(layer.garment.rest_vertices @ turn.T + [3.0, 0.1, -2.0] for layer in shot.scene.layers)
    found = _heading(shot.scene, _Frame(1, np.zeros((1, 3)), layers))
    assert (found - yaw + 180) % 360 - 180 == pytest.approx(0, abs=1e-3)


def test_tracer_meets_the_nearest_face_at_the_right_weights():
    near, faces = _square(1.0)
    far, _ = _square(0.0)
    tracer = Tracer(np.concatenate([far, near]), np.concatenate([faces, faces + 4]))
    rays = np.array([[0.1, -0.2, -1.0], [0.0, 5.0, -1.0]], np.float32)
    hit = tracer.first_hit(np.array([0.0, 0.0, 2.0]), rays)
    assert hit.ray.tolist() == [0]
    assert hit.missed.tolist() == [1]
    assert hit.face.tolist() == [2]
    corners = np.concatenate([far, near])[faces[0] + 4]
    np.testing.assert_allclose(hit.weights[0] @ corners, [0.1, -0.2, 1.0], atol=1e-6)
    assert hit.facing(rays[hit.ray]).all()


@pytest.mark.parametrize(("yaw", "sees"), [(0.0, "red"), (180.0, "blue")])
def test_yaw_chooses_the_side(yaw, sees):
    front, faces = _square(0.2)
    back, _ = _square(-0.2)
    meshes = [
        RenderMesh(front, faces, color=(0.9, 0.1, 0.1)),
        RenderMesh(back, faces[:, ::-1], color=(0.1, 0.1, 0.9)),
    ]
    image = render_view(meshes, camera=Camera(yaw=yaw, pitch=0.0), size=(40, 40), samples=1)
    red, _, blue = image[20, 20].astype(int)
    assert (red > blue) == (sees == "red")


def test_positive_yaw_sees_the_left_side():
    view = View.place(Camera(yaw=90.0, pitch=0.0), np.eye(3), (10, 10))
    assert (view.eye - view.target)[0] > 1.0  # left is +X


def test_texture_is_upright_and_not_mirrored():
    vertices, faces = _square(0.0)
    texture = np.zeros((2, 2, 3), np.uint8)
    texture[0, 0], texture[0, 1], texture[1, 0] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    corner_st = (vertices[faces][..., :2] + 0.5).astype(float)
    mesh = RenderMesh(vertices, faces, texture=texture, corner_st=corner_st)
    image = render_view([mesh], camera=Camera(pitch=0.0, height=1.2), size=(48, 48), samples=1).astype(int)
    assert image[8, 8].argmax() == 0  # top left: red
    assert image[8, 40].argmax() == 1  # top right: green
    assert image[40, 8].argmax() == 2  # bottom left: blue
    assert image[40, 40].max() < 40  # bottom right: black


def test_everything_fits_in_the_picture():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(200, 3))
    for yaw in (0.0, 50.0, 200.0):
        view = View.place(Camera(yaw=yaw, pitch=20.0), points, (30, 50))
        local = (points - view.eye) @ view.axes.T
        scale = np.linalg.norm(view.target - view.eye) / -local[:, 2]
        assert (np.abs(local[:, 1]) * scale).max() <= view.height / 2
        assert (np.abs(local[:, 0]) * scale).max() <= view.height / 2 * 30 / 50


def test_inner_side_is_darker_than_the_outer():
    vertices, faces = _square(0.0)
    outer, inner = (
        render_view([RenderMesh(vertices, f)], camera=Camera(pitch=0.0), size=(20, 20))[10, 10].mean()
        for f in (faces, faces[:, ::-1])
    )
    assert inner < 0.85 * outer


def test_srgb_round_trip():
    values = np.linspace(0, 1, 101)
    np.testing.assert_allclose(srgb_from_linear(linear_from_srgb(values)), values, atol=1e-6)


def test_fine_checks_fade_to_their_mean():
    checks = (np.indices((64, 64)).sum(0) % 2 * 200).astype(np.uint8)
    texture = MipTexture(np.repeat(checks[..., None], 3, 2))
    st = np.random.default_rng(0).uniform(0.1, 0.9, (50, 2))
    np.testing.assert_allclose(texture.sample(st, 8.0), linear_from_srgb(np.array(100 / 255)), atol=2e-3)
    column, row = np.random.default_rng(1).integers(0, 64, (2, 50))
    centres = np.stack([column + 0.5, 63.5 - row], 1) / 64
    exact = linear_from_srgb(checks[row, column] / 255)[:, None].repeat(3, 1)
    np.testing.assert_allclose(texture.sample(centres, 1.0), exact, atol=1e-6)


def test_texture_without_coordinates_is_refused():
    vertices, faces = _square(0.0)
    with pytest.raises(PluginError, match="corner_st"):
        RenderMesh(vertices, faces, texture=np.zeros((2, 2, 3), np.uint8))


def test_nothing_to_draw_is_refused():
    with pytest.raises(PluginError, match="no meshes"):
        render_view([])


def test_missing_embree_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "embreex.rtcore_scene", None)
    with pytest.raises(MissingExtraError, match="embreex"):
        Tracer(*_square(0.0))


def test_longer_shots_keep_six_frames(tmp_path):
    scene = synthetic_shot(frames="1001-1050").scene
    writer = SheetWriter()
    numbers = list(scene.frames)
    writer.begin(tmp_path / "shot.png", scene)
    assert len(writer._wanted) == 6
    assert {numbers[0], numbers[-1]} <= writer._wanted
