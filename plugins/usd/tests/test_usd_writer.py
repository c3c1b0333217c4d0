"""The USD writer: life cycle, exact round trip, layout, and failures."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from pxr import Kind, Sdf, Usd, UsdGeom, UsdShade

from isp_assets.errors import PluginError
from isp_assets.plugin_conformance import check_writer, write_shot
from isp_assets.synthetic import SyntheticShot, synthetic_shot
from isp_assets_plugins.normals import VertexNormals
from isp_assets_plugins.usd import UsdWriter, check_usd
from isp_assets_plugins.usd.material import linear_color
from isp_assets_plugins.usd.names import prim_names
from isp_assets_plugins.usd.writer import FLUSH_EVERY


@pytest.fixture(scope="module")
def shot() -> SyntheticShot:
    return synthetic_shot()


@pytest.fixture(scope="module")
def written(shot: SyntheticShot, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("usd") / "walk.usdc"
    write_shot(UsdWriter, path, shot)
    return path


def mesh_at(stage: Usd.Stage, path: str) -> UsdGeom.Mesh:
    mesh = UsdGeom.Mesh.Get(stage, f"/synthetic/{path}")
    assert mesh, path
    return mesh


def test_conforms(tmp_path: Path) -> None:
    check_writer(UsdWriter, tmp_path)


def test_passes_every_check(written: Path) -> None:
    assert check_usd(written) == []


def test_points_faces_and_st_come_back_exactly(written: Path, shot: SyntheticShot) -> None:
    stage = Usd.Stage.Open(str(written))
    for k, layer in enumerate(shot.scene.layers):
        mesh = mesh_at(stage, f"Garments/{layer.name}")
        for i, frame in enumerate(shot.scene.frames):
            assert np.array_equal(mesh.GetPointsAttr().Get(frame), shot.layers[k][i])
        assert np.array_equal(np.reshape(mesh.GetFaceVertexIndicesAttr().Get(), (-1, 3)), layer.garment.faces)
        corner_st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").ComputeFlattened()
        expected = layer.garment.st[layer.garment.corner_st_index.ravel()].astype(np.float32)
        assert np.array_equal(corner_st, expected)
    body = mesh_at(stage, "Body")
    assert np.array_equal(body.GetPointsAttr().Get(1003), shot.body[2])
    assert np.array_equal(np.reshape(body.GetFaceVertexIndicesAttr().Get(), (-1, 3)), shot.scene.body_faces)


def test_stage_says_what_it_is(written: Path, shot: SyntheticShot) -> None:
    stage = Usd.Stage.Open(str(written))
    assert stage.GetDefaultPrim().GetPath() == "/synthetic"
    assert (UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage)) == (1.0, "Y")
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (1001, 1005)
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == shot.scene.fps
    kinds = {
        str(p.GetPath()): Usd.ModelAPI(p).GetKind() for p in stage.Traverse() if Usd.ModelAPI(p).GetKind()
    }
    assert kinds == {
        "/synthetic": Kind.Tokens.assembly,
        "/synthetic/Garments": Kind.Tokens.group,
        "/synthetic/Garments/L00_vest": Kind.Tokens.component,
        "/synthetic/Garments/L01_coat": Kind.Tokens.component,
        "/synthetic/Body": Kind.Tokens.component,
    }
    assert mesh_at(stage, "Body").GetPurposeAttr().Get() == UsdGeom.Tokens.guide


def test_panels_and_materials(written: Path, shot: SyntheticShot) -> None:
    stage = Usd.Stage.Open(str(written))
    layer = shot.scene.layers[1]
    mesh = mesh_at(stage, "Garments/L01_coat")
    subsets = UsdGeom.Subset.GetGeomSubsets(mesh, UsdGeom.Tokens.face, "panel")
    for number, subset in enumerate(subsets):
        assert np.array_equal(
            subset.GetIndicesAttr().Get(), np.flatnonzero(layer.garment.face_panel == number)
        )
    material, _ = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()
    image = UsdShade.Shader.Get(stage, material.GetPath().AppendChild("texture"))
    assert image.GetInput("file").Get().path == "./walk_textures/L01_coat.png"
    assert np.array_equal(
        np.asarray(Image.open(written.parent / "walk_textures/L01_coat.png")), layer.texture
    )
    assert mesh.GetDisplayColorAttr().Get()[0] == linear_color(layer.color)


def test_normals_and_extents_move_with_the_points(written: Path) -> None:
    stage = Usd.Stage.Open(str(written))
    mesh = mesh_at(stage, "Garments/L00_vest")
    for frame in (1001, 1005):
        points, normals = (
            np.array(mesh.GetPointsAttr().Get(frame)),
            np.array(mesh.GetNormalsAttr().Get(frame)),
        )
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
        np.testing.assert_array_equal(mesh.GetExtentAttr().Get(frame), [points.min(0), points.max(0)])
    assert np.array_equal(mesh.GetPointsAttr().Get(), mesh.GetPointsAttr().Get(1001))  # asked for no time
    assert not np.array_equal(mesh.GetNormalsAttr().Get(1001), mesh.GetNormalsAttr().Get(1005))


def test_a_frame_step_keeps_frame_numbers_and_ends_on_the_last_one(tmp_path: Path) -> None:
    shot = synthetic_shot(frames="10-15x2", fps=24.0)
    write_shot(UsdWriter, tmp_path / "a.usdc", shot)
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    assert mesh_at(stage, "Body").GetPointsAttr().GetTimeSamples() == [10, 12, 14]
    assert stage.GetEndTimeCode() == 14
    assert check_usd(tmp_path / "a.usdc") == []


def test_bytes_do_not_depend_on_chunks_beyond_a_flush(tmp_path: Path) -> None:
    """More frames than are held in memory, cut so that chunks straddle the flushes."""
    shot = synthetic_shot(frames=f"1-{2 * FLUSH_EVERY + 3}", columns=4, rows=3)
    for size in (7, 60):
        write_shot(UsdWriter, tmp_path / f"{size}" / "a.usdc", shot, chunk=size)
    assert (tmp_path / "7/a.usdc").read_bytes() == (tmp_path / "60/a.usdc").read_bytes()
    stage = Usd.Stage.Open(str(tmp_path / "7/a.usdc"))
    points = mesh_at(stage, "Garments/L00_vest").GetPointsAttr()
    for i in (0, FLUSH_EVERY - 1, FLUSH_EVERY, 2 * FLUSH_EVERY + 2):
        assert np.array_equal(points.Get(i + 1), shot.layers[0][i])


def test_replaces_an_old_output_that_is_open(tmp_path: Path) -> None:
    """A reader keeps the file it opened; who opens it afterwards gets the new one."""
    path = tmp_path / "a.usdc"
    write_shot(UsdWriter, path, synthetic_shot(frames="1-2"))
    old = Usd.Stage.Open(str(path))
    write_shot(UsdWriter, path, synthetic_shot(frames="1-3"))
    assert mesh_at(old, "Body").GetPointsAttr().GetTimeSamples() == [1, 2]
    old.GetRootLayer().Reload()
    assert mesh_at(old, "Body").GetPointsAttr().GetTimeSamples() == [1, 2, 3]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a["frames"].__setitem__(0, 7), "order"),
        (lambda a: a.update(layers=a["layers"][:1]), "expected 2 layers, got 1"),
        (lambda a: a.update(layers=(a["layers"][0][:, 1:], a["layers"][1])), "L00_vest must have"),
        (lambda a: a["body"].__setitem__((1, 0, 0), np.nan), "Body holds NaN or infinity at frame 1002"),
    ],
    ids=["frames", "layers", "vertices", "finite"],
)
def test_chunks_that_do_not_fit_are_refused(
    tmp_path: Path, shot: SyntheticShot, change, message: str
) -> None:
    chunk = next(iter(shot.chunks(2)))
    fields = dict(vars(chunk))
    change(fields)
    writer = UsdWriter()
    writer.begin(tmp_path / "a.usdc", shot.scene)
    with pytest.raises(PluginError, match=message):
        writer.add(type(chunk)(**fields))
    writer.abort()
    assert list(tmp_path.iterdir()) == []


def test_missing_frames_publish_nothing(tmp_path: Path, shot: SyntheticShot) -> None:
    writer = UsdWriter()
    writer.begin(tmp_path / "a.usdc", shot.scene)
    writer.add(next(iter(shot.chunks(2))))
    with pytest.raises(PluginError, match="only 2 of 5 frames"):
        writer.finish()
    assert list(tmp_path.iterdir()) == []


@given(st.lists(st.text(max_size=6), max_size=8))
def test_prim_names_are_valid_and_distinct(names: list[str]) -> None:
    made = prim_names(names)
    assert len(set(made)) == len(names)
    assert all(Sdf.Path.IsValidIdentifier(name) for name in made)


def test_valid_prim_names_are_kept() -> None:
    assert prim_names(["L00_tee", "L01_tee", "L00_tee", "1 coat"]) == [
        "L00_tee",
        "L01_tee",
        "L00_tee_2",
        "__coat",
    ]


def test_normals_of_a_cube_corner_and_of_a_flat_sheet() -> None:
    corner = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2]])
    normal = VertexNormals(faces, 4)(corner)[0]
    np.testing.assert_allclose(normal, -np.ones(3) / np.sqrt(3), rtol=1e-6)
    assert np.array_equal(VertexNormals(faces, 5)(np.zeros((5, 3), np.float32))[4], [0, 1, 0])


def test_linear_color_is_monotone_and_keeps_black_and_white() -> None:
    ramp = [linear_color((v, v, v))[0] for v in np.linspace(0, 1, 50)]
    assert (ramp[0], ramp[-1]) == (0, 1)
    assert all(a < b for a, b in itertools.pairwise(ramp))
    assert linear_color((0.5, 0.5, 0.5))[0] == pytest.approx(0.21404, abs=1e-5)
