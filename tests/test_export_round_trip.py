"""T21: what is draped comes back from the files as it was: positions, faces and texture coordinates."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pxr import Usd, UsdGeom

from isp_assets.body import Body
from isp_assets.collection import Collection
from isp_assets.drape import DrapeOptions, drape
from isp_assets.frames import FrameChunk, Scene
from isp_assets.motion import Motion
from isp_assets.plugin import make_writer
from isp_assets.shot import Shot


@pytest.fixture(scope="module")
def draped() -> tuple[Scene, FrameChunk]:
    walk = Motion.load("walk")
    motion = replace(walk, poses=walk.poses[90:93], translation=walk.translation[90:93], start_frame=1001)
    shot = Shot("walk", Body.load(), motion)
    frames = drape(Collection.load().outfit(["tee", "trousers"]), shot, DrapeOptions(resolution=48))
    return frames.scene, next(iter(frames))


def written(name: str, draped: tuple[Scene, FrameChunk], folder: Path) -> Path:
    scene, chunk = draped
    writer = make_writer(name)
    path = folder / f"shot{writer.suffix}"
    writer.begin(path, scene)
    writer.add(chunk)
    writer.finish()
    return path


def test_usd_keeps_positions_faces_and_texture_coordinates(draped, tmp_path):
    scene, chunk = draped
    stage = Usd.Stage.Open(str(written("usd", draped, tmp_path)))
    meshes = {prim.GetName(): UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)}
    assert set(meshes) == {"Body", *(layer.name for layer in scene.layers)}
    for layer, positions in zip(scene.layers, chunk.layers, strict=True):
        mesh = meshes[layer.name]
        garment = layer.garment
        faces = np.reshape(mesh.GetFaceVertexIndicesAttr().Get(), (-1, 3))
        np.testing.assert_array_equal(faces, garment.faces)
        for frame, expected in zip(scene.frames, positions, strict=True):
            np.testing.assert_array_equal(mesh.GetPointsAttr().Get(frame), expected.astype(np.float32))
        corner_st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").ComputeFlattened()
        expected_st = garment.st[garment.corner_st_index.ravel()]
        np.testing.assert_allclose(corner_st, expected_st, atol=1e-7)
    for frame, expected in zip(scene.frames, chunk.body, strict=True):
        np.testing.assert_array_equal(meshes["Body"].GetPointsAttr().Get(frame), expected)


def test_glb_keeps_the_first_frame_corner_by_corner(draped, tmp_path):
    """trimesh knows no morph targets: it sees the first frame. The writer's own tests play the others."""
    scene, chunk = draped
    loaded = trimesh.load(written("glb", draped, tmp_path), process=False)
    for layer, positions in zip(scene.layers, chunk.layers, strict=True):
        (mesh,) = (m for name, m in loaded.geometry.items() if layer.name in name)
        garment = layer.garment
        assert mesh.faces.shape == garment.faces.shape
        np.testing.assert_allclose(mesh.vertices[mesh.faces], positions[0][garment.faces], atol=1e-6)
        corner_st = np.asarray(mesh.visual.uv)[mesh.faces]
        np.testing.assert_allclose(corner_st, garment.st[garment.corner_st_index], atol=1e-6)
