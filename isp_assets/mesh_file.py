"""Reading garment meshes that other programs wrote.

OBJ, PLY, STL, GLB and others come through trimesh, VTK and VTU through meshio.
Vertices at one place become one vertex, so that texture seams and unindexed
formats leave no cuts. Units and axes are those of the file: see `alignment`.
"""

from pathlib import Path

import numpy as np

from isp_assets.errors import GeometryError, MeshError
from isp_assets.geometry.surface_distance import Surface

_TRIMESH = (".glb", ".gltf", ".obj", ".off", ".ply", ".stl")
_MESHIO = (".vtk", ".vtu")
_WRITTEN = (".glb", ".obj", ".off", ".ply", ".stl")  # each in one file
SUFFIXES = (*_TRIMESH, *_MESHIO)


def read_surface(path: Path) -> Surface:
    """Read a triangle mesh; polygons are cut into triangles, several parts become one.

    Raises:
        MeshError: If the file is missing, of an unknown kind, damaged, or holds no triangle.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise MeshError(f"{path}: meshes are read from {', '.join(SUFFIXES)} files, got {suffix!r}")
    if not path.is_file():
        raise MeshError(f"no such file: {path}")
    try:
        vertices, faces = (_by_meshio if suffix in _MESHIO else _by_trimesh)(path)
        return _welded(np.asarray(vertices, np.float64), np.asarray(faces, np.int64))
    except GeometryError as error:
        raise MeshError(f"{path}: {error}") from error
    # Both libraries answer a damaged file with whatever error its reader meets first.
    except Exception as error:
        reason = " ".join(str(error).split())[:200]
        raise MeshError(f"{path}: not readable as {suffix} ({type(error).__name__}: {reason})") from error


def write_surface(path: Path, surface: Surface) -> None:
    """Write a triangle mesh; the suffix names the format. Whole or not at all.

    Raises:
        MeshError: If the suffix is unknown.
    """
    import trimesh

    from isp_assets.files import published

    check_writable(path)
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    with published(path) as temporary:
        mesh.export(temporary)


def check_writable(path: Path) -> None:
    """Whether `write_surface` knows the kind of a file.

    Raises:
        MeshError: If it does not.
    """
    if path.suffix.lower() not in _WRITTEN:
        raise MeshError(f"{path}: meshes are written to {', '.join(_WRITTEN)} files, got {path.suffix!r}")


def _by_trimesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    scene = trimesh.load_scene(path, process=False)
    parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh)]
    if not parts:
        raise GeometryError("the file holds no mesh")
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + offset for part, offset in zip(parts, offsets, strict=False)]
    return np.concatenate([part.vertices for part in parts]), np.concatenate(faces)


def _by_meshio(path: Path) -> tuple[np.ndarray, np.ndarray]:
    import meshio

    # Its general reader leaves the process when a file is damaged; those of single formats raise.
    mesh = {".vtk": meshio.vtk, ".vtu": meshio.vtu}[path.suffix.lower()].read(path)
    kinds = {cells.type for cells in mesh.cells}
    if unknown := kinds - {"triangle", "quad", "polygon", "line", "vertex"}:
        raise GeometryError(
            f"the file holds cells of kind {sorted(unknown)}, not triangles and polygons only"
        )
    polygons = [np.asarray(cells.data) for cells in mesh.cells if cells.type not in ("line", "vertex")]
    if not polygons:
        raise GeometryError(f"the file holds no triangles, but {sorted(kinds)}")
    # A fan about the first corner, as every reader cuts polygons that carry no better advice.
    faces = [data[:, [0, k, k + 1]] for data in polygons for k in range(1, data.shape[1] - 1)]
    return mesh.points[:, :3], np.concatenate(faces)


def _welded(vertices: np.ndarray, faces: np.ndarray) -> Surface:
    """One vertex a place; faces that lose a corner by it, and vertices without a face, are dropped."""
    surface = Surface(vertices, faces)  # checks before anything is looked up
    step = 1e-6 * max(float(np.ptp(surface.vertices, axis=0).max()), 1e-30)
    _, first, place = np.unique(
        np.round((vertices - vertices.min(axis=0)) / step).astype(np.int64), axis=0,
        return_index=True, return_inverse=True,
    )  # fmt: skip
    faces = place.reshape(-1)[faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    used, faces = np.unique(faces, return_inverse=True)
    return Surface(vertices[first][used], faces.reshape(-1, 3).astype(np.int64))
