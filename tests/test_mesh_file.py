"""Foreign meshes: every format comes back as the same surface; bad files are named."""

import meshio
import numpy as np
import pytest
import trimesh

from isp_assets.errors import MeshError
from isp_assets.geometry.surface_distance import Surface
from isp_assets.geometry.topology import boundary_loops
from isp_assets.mesh_file import read_surface, write_surface

VERTICES = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0.5], [2, 1, 0.5]])
FACES = np.array([[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]])


def same(surface: Surface) -> None:
    assert surface.vertices.shape == VERTICES.shape
    corners = sorted(map(tuple, surface.vertices[surface.faces].reshape(-1, 9).round(5).tolist()))
    assert corners == sorted(map(tuple, VERTICES[FACES].reshape(-1, 9).tolist()))
    assert len(boundary_loops(surface.faces)) == 1


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl", "glb", "off"])
def test_what_is_written_comes_back(tmp_path, suffix):
    path = tmp_path / f"mesh.{suffix}"
    write_surface(path, Surface(VERTICES, FACES))
    same(read_surface(path))


@pytest.mark.parametrize("suffix", ["vtk", "vtu"])
def test_formats_of_simulation_programs(tmp_path, suffix):
    path = tmp_path / f"mesh.{suffix}"
    cells = [("triangle", FACES[:2]), ("quad", np.array([[1, 4, 5, 2]])), ("line", np.array([[0, 1]]))]
    meshio.Mesh(VERTICES, cells).write(path)
    same(read_surface(path))


def test_volumes_are_no_garments(tmp_path):
    meshio.Mesh(VERTICES, [("tetra", np.array([[0, 1, 2, 4]]))]).write(tmp_path / "solid.vtu")
    with pytest.raises(MeshError, match="cells of kind"):
        read_surface(tmp_path / "solid.vtu")


def test_cuts_of_the_texture_are_closed(tmp_path):
    """An OBJ with two texture coordinates at one vertex, as seams of a texture have."""
    path = tmp_path / "mesh.obj"
    lines = [f"v {x} {y} {z}" for x, y, z in VERTICES] + [f"vt 0.{k} 0.{k}" for k in range(1, 9)]
    lines += ["f 1/1 2/2 3/3", "f 1/1 3/3 4/4", "f 2/5 5/6 6/7", "f 2/5 6/7 3/8"]
    path.write_text("\n".join(lines) + "\n")
    same(read_surface(path))


def test_placed_parts_of_a_scene_are_joined(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.Trimesh(VERTICES, FACES[:2], process=False))
    moved = trimesh.Trimesh(VERTICES - [5, 0, 0], FACES[2:], process=False)
    scene.add_geometry(moved, transform=trimesh.transformations.translation_matrix([5, 0, 0]))
    scene.export(tmp_path / "scene.glb")
    same(read_surface(tmp_path / "scene.glb"))


def test_a_missing_file_and_an_unknown_kind(tmp_path):
    with pytest.raises(MeshError, match="no such file"):
        read_surface(tmp_path / "none.obj")
    with pytest.raises(MeshError, match=r"read from \.glb.*got '\.fbx'"):
        read_surface(tmp_path / "none.fbx")
    with pytest.raises(MeshError, match=r"written to .*got '\.fbx'"):
        write_surface(tmp_path / "none.fbx", Surface(VERTICES, FACES))


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl", "glb", "gltf", "off", "vtk", "vtu"])
@pytest.mark.parametrize("content", [b"", b"\x00\xff\x13garbage" * 40])
def test_damaged_files_are_named(tmp_path, suffix, content):
    path = tmp_path / f"bad.{suffix}"
    path.write_bytes(content)
    with pytest.raises(MeshError, match=rf"bad\.{suffix}"):
        read_surface(path)


def test_files_without_faces_are_named(tmp_path):
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\n")
    with pytest.raises(MeshError, match=r"no mesh|no faces|no triangles"):
        read_surface(tmp_path / "points.obj")
    meshio.Mesh(VERTICES, [("line", np.array([[0, 1]]))]).write(tmp_path / "lines.vtk")
    with pytest.raises(MeshError, match="no triangles"):
        read_surface(tmp_path / "lines.vtk")


def test_positions_that_are_not_numbers_are_refused(tmp_path):
    (tmp_path / "nan.obj").write_text("v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(MeshError, match=r"nan\.obj"):
        read_surface(tmp_path / "nan.obj")
