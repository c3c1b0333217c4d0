"""One bad file a rule: each is a good file with one fault, and exactly its rule must speak."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdShade, Vt

from isp_assets.errors import PluginError
from isp_assets.plugin_conformance import write_shot
from isp_assets.synthetic import synthetic_shot
from isp_assets_plugins.usd import UsdWriter, check_usd
from isp_assets_plugins.usd.rules import RULES

COAT = "/synthetic/Garments/L01_coat"


def centimetres(stage: Usd.Stage) -> None:
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)


def late_end(stage: Usd.Stage) -> None:
    stage.SetEndTimeCode(2000)


def index_out_of_range(stage: Usd.Stage) -> None:
    attribute = UsdGeom.Mesh.Get(stage, COAT).GetFaceVertexIndicesAttr()
    indices = np.array(attribute.Get())
    indices[5] = 99_999
    attribute.Set(Vt.IntArray.FromNumpy(indices))


def not_a_number(stage: Usd.Stage) -> None:
    attribute = UsdGeom.Mesh.Get(stage, COAT).GetNormalsAttr()
    normals = np.array(attribute.Get(1002))
    normals[3] = np.nan
    attribute.Set(Vt.Vec3fArray.FromNumpy(normals), 1002)


def small_extent(stage: Usd.Stage) -> None:
    attribute = UsdGeom.Mesh.Get(stage, COAT).GetExtentAttr()
    attribute.Set(Vt.Vec3fArray.FromNumpy(0.9 * np.array(attribute.Get(1003))), 1003)


def one_flipped_face(stage: Usd.Stage) -> None:
    attribute = UsdGeom.Mesh.Get(stage, COAT).GetFaceVertexIndicesAttr()
    indices = np.array(attribute.Get()).reshape(-1, 3)
    indices[4] = indices[4, ::-1].copy()
    attribute.Set(Vt.IntArray.FromNumpy(indices.ravel()))


def inside_out(stage: Usd.Stage) -> None:
    attribute = UsdGeom.Mesh.Get(stage, COAT).GetFaceVertexIndicesAttr()
    attribute.Set(
        Vt.IntArray.FromNumpy(np.ascontiguousarray(np.array(attribute.Get()).reshape(-1, 3)[:, ::-1]).ravel())
    )


def missing_image(stage: Usd.Stage) -> None:
    UsdShade.Shader.Get(stage, "/synthetic/Materials/L01_coat/texture").GetInput("file").Set(
        Sdf.AssetPath("./no.png")
    )


def absolute_image(stage: Usd.Stage) -> None:
    image = UsdShade.Shader.Get(stage, "/synthetic/Materials/L01_coat/texture").GetInput("file")
    image.Set(Sdf.AssetPath(stage.GetRootLayer().ComputeAbsolutePath(image.Get().path)))


def lost_panel_face(stage: Usd.Stage) -> None:
    subset = UsdGeom.Subset.Get(stage, f"{COAT}/front")
    subset.GetIndicesAttr().Set(subset.GetIndicesAttr().Get()[1:])


BAD = {
    "units": [centimetres],
    "frames": [late_end],
    "sizes": [index_out_of_range],
    "finite": [not_a_number],
    "extent": [small_extent],
    "winding": [one_flipped_face, inside_out],
    "panels": [lost_panel_face],
    "textures": [missing_image, absolute_image],
}


@pytest.mark.parametrize(
    ("rule", "spoil"),
    [(rule, f) for rule, faults in BAD.items() for f in faults],
    ids=lambda v: getattr(v, "__name__", v),
)
def test_each_rule_speaks_alone(tmp_path: Path, rule: str, spoil: Callable[[Usd.Stage], None]) -> None:
    path = tmp_path / "bad.usdc"
    write_shot(UsdWriter, path, synthetic_shot(frames="1001-1003"))
    assert check_usd(path) == []
    stage = Usd.Stage.Open(str(path))
    spoil(stage)
    stage.GetRootLayer().Save()
    del stage
    findings = check_usd(path)
    assert {f.rule for f in findings if not f.rule.startswith("usd:")} == {rule}, [str(f) for f in findings]


def test_every_rule_has_a_bad_file() -> None:
    assert set(BAD) == set(RULES)


def test_the_official_validators_speak_too(tmp_path: Path) -> None:
    path = tmp_path / "bad.usda"
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.Xform.Define(stage, "/a")
    stage.GetRootLayer().Save()
    assert any(f.rule.startswith("usd:") for f in check_usd(path))


def test_a_file_that_is_not_usd(tmp_path: Path) -> None:
    (tmp_path / "a.usdc").write_bytes(b"nothing")
    with pytest.raises(PluginError, match="not a USD file"):
        check_usd(tmp_path / "a.usdc")
