"""What a shot's stage holds before the first frame: prims, topology, texture coordinates, materials.

::

    /walk                  Xform, assembly, the default prim
      Garments             Xform, group
        L00_tank_top       Mesh, component; one prim a layer, so that each can be hidden
          front, back      GeomSubset, family "panel"
      Body                 Mesh, component, purpose "guide"
      Materials            Scope
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdShade, Vt

import isp_assets
from isp_assets.conventions import METRES_PER_UNIT, PANELS, UP_AXIS
from isp_assets.fabric_style import Color
from isp_assets.frames import Layer, Scene
from isp_assets_plugins.normals import VertexNormals

from .material import define_material, linear_color
from .names import prim_names

BODY_COLOR: Color = (0.62, 0.60, 0.58)
PANEL_FAMILY = "panel"


@dataclass(frozen=True, eq=False)
class AnimatedMesh:
    """A mesh prim of constant topology that takes one set of points a frame."""

    points: Usd.Attribute
    normals: Usd.Attribute
    extent: Usd.Attribute
    vertex_normals: VertexNormals

    def set_frame(self, vertices: Float[np.ndarray, "V 3"], frame: int) -> None:
        """Author points, normals and extent at time code ``frame``.

        The first frame is also the default value: programs that ask for no
        time see the figure standing instead of nothing. The file stores it once.
        """
        vertices = np.ascontiguousarray(vertices, np.float32)
        points = Vt.Vec3fArray.FromNumpy(vertices)
        normals = Vt.Vec3fArray.FromNumpy(self.vertex_normals(vertices))
        box = UsdGeom.PointBased.ComputeExtent(points)
        for attribute, value in ((self.points, points), (self.normals, normals), (self.extent, box)):
            if not attribute.HasAuthoredValue():
                attribute.Set(value)
            attribute.Set(value, frame)


def define_shot(
    stage: Usd.Stage, scene: Scene, textures: str
) -> tuple[AnimatedMesh, tuple[AnimatedMesh, ...]]:
    """Author everything that does not change over the shot.

    Args:
        stage: An empty stage.
        scene: The shot.
        textures: Folder of the images, relative to the layer.

    Returns:
        The body's mesh, and the garments' meshes, innermost first.
    """
    frames = list(scene.frames)
    root = _model(
        stage, Sdf.Path.absoluteRootPath.AppendChild(prim_names([scene.name])[0]), Kind.Tokens.assembly
    )
    UsdGeom.SetStageMetersPerUnit(stage, METRES_PER_UNIT)
    UsdGeom.SetStageUpAxis(stage, UP_AXIS)
    stage.SetDefaultPrim(root)
    stage.SetStartTimeCode(frames[0])
    stage.SetEndTimeCode(frames[-1])
    stage.SetTimeCodesPerSecond(scene.fps)
    stage.SetFramesPerSecond(scene.fps)
    stage.GetRootLayer().customLayerData = {"creator": f"isp-assets {isp_assets.__version__}"}
    group = _model(stage, root.GetPath().AppendChild("Garments"), Kind.Tokens.group)
    names = prim_names([layer.name for layer in scene.layers])
    garments = tuple(
        _garment(stage, group.GetPath().AppendChild(name), layer)
        for name, layer in zip(names, scene.layers, strict=True)
    )
    body = _body(stage, root.GetPath().AppendChild("Body"), scene.body_faces)
    looks = UsdGeom.Scope.Define(stage, root.GetPath().AppendChild("Materials")).GetPath()
    for name, layer in zip(names, scene.layers, strict=True):
        material = define_material(stage, looks.AppendChild(name), layer.color, f"./{textures}/{name}.png")
        _bind(stage, group.GetPath().AppendChild(name), material)
    skin = define_material(stage, looks.AppendChild(prim_names([*names, "Body"])[-1]), BODY_COLOR)
    _bind(stage, root.GetPath().AppendChild("Body"), skin)
    return body, garments


def _model(stage: Usd.Stage, path: Sdf.Path, kind: str) -> Usd.Prim:
    prim = UsdGeom.Xform.Define(stage, path).GetPrim()
    Usd.ModelAPI(prim).SetKind(kind)
    return prim


def _garment(stage: Usd.Stage, path: Sdf.Path, layer: Layer) -> AnimatedMesh:
    garment = layer.garment
    mesh = _mesh(stage, path, garment.faces, layer.color)
    Usd.ModelAPI(mesh.GetPrim()).SetAssetName(garment.name)
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
        "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying
    )
    st.Set(Vt.Vec2fArray.FromNumpy(garment.st.astype(np.float32)))
    st.SetIndices(_ints(garment.corner_st_index))
    for number, panel in enumerate(PANELS):
        faces = np.flatnonzero(garment.face_panel == number)
        UsdGeom.Subset.CreateGeomSubset(mesh, panel, UsdGeom.Tokens.face, _ints(faces), PANEL_FAMILY)
    UsdGeom.Subset.SetFamilyType(mesh, PANEL_FAMILY, UsdGeom.Tokens.partition)
    return _animated(mesh, garment.faces, garment.num_vertices)


def _body(stage: Usd.Stage, path: Sdf.Path, faces: Int[np.ndarray, "F 3"]) -> AnimatedMesh:
    mesh = _mesh(stage, path, faces, BODY_COLOR)
    mesh.CreatePurposeAttr(UsdGeom.Tokens.guide)
    return _animated(mesh, faces, int(faces.max()) + 1)


def _mesh(stage: Usd.Stage, path: Sdf.Path, faces: Int[np.ndarray, "F 3"], color: Color) -> UsdGeom.Mesh:
    mesh = UsdGeom.Mesh.Define(stage, path)
    Usd.ModelAPI(mesh.GetPrim()).SetKind(Kind.Tokens.component)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
    mesh.CreateDoubleSidedAttr(True)
    mesh.CreateFaceVertexCountsAttr(_ints(np.full(len(faces), 3)))
    mesh.CreateFaceVertexIndicesAttr(_ints(faces))
    mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set(
        Vt.Vec3fArray([Gf.Vec3f(linear_color(color))])
    )
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    return mesh


def _animated(mesh: UsdGeom.Mesh, faces: Int[np.ndarray, "F 3"], num_vertices: int) -> AnimatedMesh:
    attributes = mesh.CreatePointsAttr(), mesh.CreateNormalsAttr(), mesh.CreateExtentAttr()
    return AnimatedMesh(*attributes, VertexNormals(faces, num_vertices))


def _bind(stage: Usd.Stage, path: Sdf.Path, material: UsdShade.Material) -> None:
    UsdShade.MaterialBindingAPI.Apply(stage.GetPrimAtPath(path)).Bind(material)


def _ints(values: Int[np.ndarray, "..."]) -> Vt.IntArray:
    return Vt.IntArray.FromNumpy(np.ascontiguousarray(values.ravel(), np.int32))
