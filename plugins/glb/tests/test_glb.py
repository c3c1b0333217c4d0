"""GLB files: what is read back is what was written, in any reader, at any frame."""

import json
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from isp_assets.errors import PluginError
from isp_assets.plugin_conformance import check_writer, write_shot
from isp_assets.synthetic import SyntheticShot, synthetic_shot
from isp_assets_plugins.glb import GlbWriter, PackedGlbWriter, container
from isp_assets_plugins.glb.container import GlbFile, Spool
from isp_assets_plugins.glb.morph import PACKED, MeshTargets, TargetStore

from .glb_reader import Glb

WRITERS = pytest.mark.parametrize("writer", [GlbWriter, PackedGlbWriter])
_VALIDATE = """
const validator = require(process.argv[1]), fs = require('fs');
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2])), {maxIssues: 50})
  .then(report => console.log(JSON.stringify(report.issues)));
"""


def _written(writer: type[GlbWriter], folder: Path, shot: SyntheticShot) -> Glb:
    path = folder / "shot.glb"
    write_shot(writer, path, shot)
    return Glb(path)


def _tolerance(writer: type[GlbWriter]) -> float:
    return 1e-6 if writer is GlbWriter else 2.0 / 32767 / 2 + 1e-6


@WRITERS
def test_conforms(writer, tmp_path):
    check_writer(writer, tmp_path)


@WRITERS
def test_every_frame_reads_back(writer, tmp_path):
    shot = synthetic_shot()
    glb = _written(writer, tmp_path, shot)
    for k, _ in enumerate(shot.scene.frames):
        time = k / shot.scene.fps
        np.testing.assert_allclose(
            glb.attribute("Body", "POSITION", time), shot.body[k], atol=_tolerance(writer)
        )
        for layer, vertices in zip(shot.scene.layers, shot.layers, strict=True):
            index = np.concatenate([p.vertex_index for p in layer.garment.panels.values()])
            found = glb.attribute(layer.name, "POSITION", time)
            np.testing.assert_allclose(found, vertices[k][index], atol=_tolerance(writer))


@WRITERS
def test_between_frames_positions_are_interpolated(writer, tmp_path):
    shot = synthetic_shot()
    glb = _written(writer, tmp_path, shot)
    found = glb.attribute("Body", "POSITION", 1.25 / shot.scene.fps)
    expected = 0.75 * shot.body[1] + 0.25 * shot.body[2]
    np.testing.assert_allclose(found, expected, atol=_tolerance(writer))


@WRITERS
def test_normals_are_those_of_the_welded_surface(writer, tmp_path):
    shot = synthetic_shot()
    glb = _written(writer, tmp_path, shot)
    for k in (0, 3):
        for layer, vertices in zip(shot.scene.layers, shot.layers, strict=True):
            garment = layer.garment
            index = np.concatenate([p.vertex_index for p in garment.panels.values()])
            expected = trimesh.Trimesh(vertices[k], garment.faces, process=False)
            a, b, c = np.moveaxis(vertices[k][garment.faces].astype(float), 1, 0)
            normals = np.zeros_like(vertices[k], float)
            for corner in range(3):
                np.add.at(normals, garment.faces[:, corner], np.cross(b - a, c - a))
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            found = glb.attribute(layer.name, "NORMAL", k / shot.scene.fps)
            np.testing.assert_allclose(found, normals[index], atol=1e-5 if writer is GlbWriter else 0.01)
            assert len(expected.faces) == len(garment.faces)


@WRITERS
def test_no_cracks_along_the_seams(writer, tmp_path):
    """Points that share a vertex have the same bits in every frame."""
    shot = synthetic_shot()
    glb = _written(writer, tmp_path, shot)
    layer = shot.scene.layers[0]
    index = np.concatenate([p.vertex_index for p in layer.garment.panels.values()])
    primitive = glb.primitive(layer.name)
    for accessor in (primitive["attributes"]["POSITION"], *(t["POSITION"] for t in primitive["targets"])):
        values = glb.accessor(accessor)
        first = np.zeros((layer.garment.num_vertices, 3), values.dtype)
        first[index] = values
        assert (first[index] == values).all()
    assert len(index) > layer.garment.num_vertices


@WRITERS
def test_names_faces_and_texture(writer, tmp_path):
    shot = synthetic_shot()
    glb = _written(writer, tmp_path, shot)
    nodes = glb.json["nodes"]
    (root,) = glb.json["scenes"][0]["nodes"]
    assert nodes[root]["name"] == shot.scene.name
    assert [nodes[k]["name"] for k in nodes[root]["children"]] == ["Body", "Garments"]
    names = [nodes[k]["name"] for k in glb.node("Garments")["children"]]
    assert names == [layer.name for layer in shot.scene.layers]
    assert glb.json["meshes"][0]["extras"]["targetNames"] == ["1002", "1003", "1004", "1005"]
    for layer in shot.scene.layers:
        primitive = glb.primitive(layer.name)
        st = glb.accessor(primitive["attributes"]["TEXCOORD_0"])
        np.testing.assert_allclose(st, layer.garment.st * [1, -1] + [0, 1], atol=1e-6)
        faces = glb.accessor(primitive["indices"]).reshape(-1, 3)
        assert (faces == layer.garment.corner_st_index).all()
        material = glb.json["materials"][primitive["material"]]
        texture = glb.json["textures"][material["pbrMetallicRoughness"]["baseColorTexture"]["index"]]
        view = glb.json["bufferViews"][glb.json["images"][texture["source"]]["bufferView"]]
        (tmp_path / "t.png").write_bytes(glb.binary[view["byteOffset"] :][: view["byteLength"]])
        assert (np.asarray(Image.open(tmp_path / "t.png")) == layer.texture).all()


@WRITERS
def test_trimesh_sees_the_first_frame(writer, tmp_path):
    shot = synthetic_shot()
    path = tmp_path / "shot.glb"
    write_shot(writer, path, shot)
    scene = trimesh.load_scene(path, process=False)
    assert set(scene.geometry) == {"Body", *(layer.name for layer in shot.scene.layers)}
    np.testing.assert_allclose(scene.geometry["Body"].vertices, shot.body[0], atol=1e-6)
    for layer, vertices in zip(shot.scene.layers, shot.layers, strict=True):
        mesh = scene.geometry[layer.name]
        assert len(mesh.faces) == len(layer.garment.faces)
        np.testing.assert_allclose(mesh.triangles, vertices[0][layer.garment.faces], atol=1e-6)
        np.testing.assert_allclose(mesh.visual.uv, layer.garment.st, atol=1e-6)  # trimesh flips back


@WRITERS
@pytest.mark.parametrize("frames", ["1001-1005", "7", "10-30x10"])
def test_khronos_validator_finds_nothing(writer, frames, tmp_path):
    write_shot(writer, tmp_path / "shot.glb", synthetic_shot(frames=frames))
    issues = _validate(tmp_path / "shot.glb")
    assert issues["messages"] == []


def test_validator_would_find_something(tmp_path):
    file = GlbFile({})
    file.array(np.zeros((3, 3), np.float32))
    file.append("accessors", {"componentType": 5126, "count": 1, "type": "VEC3", "bufferView": 5})
    file.write(tmp_path / "bad.glb")
    assert _validate(tmp_path / "bad.glb")["numErrors"] > 0


def test_stepped_range_keeps_real_time(tmp_path):
    shot = synthetic_shot(frames="10-30x10", fps=25.0)
    glb = _written(GlbWriter, tmp_path, shot)
    times = glb.accessor(glb.json["animations"][0]["samplers"][0]["input"])[:, 0]
    np.testing.assert_allclose(times, [0.0, 0.4, 0.8])


def test_single_frame_has_no_animation(tmp_path):
    glb = _written(GlbWriter, tmp_path, synthetic_shot(frames="7"))
    assert "animations" not in glb.json
    assert "targets" not in glb.primitive("Body")


def test_packed_stays_accurate_over_a_long_walk(tmp_path):
    shot = synthetic_shot()
    walk = np.array([0, 1, 5, 10, 20], np.float32)[:, None, None] * np.array([0, 0, 1], np.float32)
    moved = replace(shot, body=shot.body + walk, layers=tuple(layer + walk for layer in shot.layers))
    glb = _written(PackedGlbWriter, tmp_path, moved)
    for k, distance in enumerate((0, 1, 5, 10, 20)):
        error = np.abs(glb.attribute("Body", "POSITION", k / shot.scene.fps) - moved.body[k]).max()
        assert error <= max(2.0, distance + 0.1) * 1.6e-5


def test_packed_is_smaller(tmp_path):
    shot = synthetic_shot(frames="1-20", columns=41, rows=31)
    for writer in (GlbWriter, PackedGlbWriter):
        write_shot(writer, tmp_path / f"{writer.name}.glb", shot)
    assert (tmp_path / "glb_packed.glb").stat().st_size < 0.6 * (tmp_path / "glb.glb").stat().st_size


@pytest.mark.parametrize("change", ["order", "layers", "nan"])
def test_wrong_chunks_are_refused(change, tmp_path):
    shot = synthetic_shot()
    chunk = next(iter(shot.chunks(2)))
    if change == "order":
        chunk = replace(chunk, frames=chunk.frames[::-1])
    elif change == "layers":
        chunk = replace(chunk, layers=chunk.layers[:1])
    else:
        chunk.layers[1][1, 3, 0] = np.nan
    writer = GlbWriter()
    writer.begin(tmp_path / "shot.glb", shot.scene)
    words = {
        "order": "order",
        "layers": "2 layers",
        "nan": "L01_coat has NaN or infinite positions in frame 1002",
    }
    with pytest.raises(PluginError, match=words[change]):
        writer.add(chunk)
    writer.abort()
    assert not list(tmp_path.iterdir())


def test_missing_frames_are_refused(tmp_path):
    shot = synthetic_shot()
    writer = GlbWriter()
    writer.begin(tmp_path / "shot.glb", shot.scene)
    writer.add(next(iter(shot.chunks(2))))
    with pytest.raises(PluginError, match="only 2 of 5"):
        writer.finish()
    assert not list(tmp_path.iterdir())


def test_missing_folder_is_named(tmp_path):
    with pytest.raises(PluginError, match="nowhere"):
        GlbWriter().begin(tmp_path / "nowhere" / "shot.glb", synthetic_shot().scene)


@pytest.mark.parametrize("where", ["spool", "file"])
def test_disk_error_leaves_no_file(where, tmp_path, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Spool, "append" if where == "spool" else "copy_to", full)
    writer = GlbWriter()
    shot = synthetic_shot()
    writer.begin(tmp_path / "shot.glb", shot.scene)
    with pytest.raises(OSError, match="No space"):
        for chunk in shot.chunks(2):
            writer.add(chunk)
        writer.finish()
    writer.abort()
    assert not list(tmp_path.iterdir())


def test_too_large_a_file_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(container, "_LARGEST", 10_000)
    with pytest.raises(PluginError, match="GLB ends at 4"):
        write_shot(GlbWriter, tmp_path / "shot.glb", synthetic_shot())
    assert not list(tmp_path.iterdir())


def test_packed_rounding_is_half_a_step(tmp_path):
    rng = np.random.default_rng(0)
    change = rng.uniform(-3, 3, (100, 3))
    store, targets = TargetStore(PACKED, tmp_path), MeshTargets()
    store.add(targets, change, np.zeros((100, 3)))
    file = GlbFile({})
    ((entry,),) = store.attach(file, [targets])
    file.write(tmp_path / "one.glb")
    store.close()
    found = Glb(tmp_path / "one.glb").accessor(entry["POSITION"]) * targets.scales[0]
    assert np.abs(found - change).max() <= 0.5 * targets.scales[0] / 32767 + 1e-9


def _validate(path: Path) -> dict:
    package = os.environ.get("ISP_ASSETS_GLTF_VALIDATOR", "")
    if not package:
        found = [
            p / "node_modules" / "gltf-validator" for p in (Path.cwd(), *Path(__file__).resolve().parents)
        ]
        package = str(next((p for p in found if p.is_dir()), ""))
    node = shutil.which("node")
    if not package or node is None:
        pytest.skip(
            "no Khronos validator: npm install gltf-validator, or set ISP_ASSETS_GLTF_VALIDATOR to its folder"
        )
    command = [node, "-e", _VALIDATE, "--", str(Path(package).resolve()), str(path)]
    run = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    return json.loads(run.stdout)
