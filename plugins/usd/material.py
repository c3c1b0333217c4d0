"""Materials: a preview surface whose colour is an image over ``st``, or one colour."""

from pxr import Gf, Sdf, Usd, UsdShade

from isp_assets.fabric_style import Color

ROUGHNESS = 0.85


def linear_color(srgb: Color) -> Gf.Vec3f:
    """An sRGB colour in 0..1 as USD wants colours: linear, same primaries."""
    return Gf.Vec3f(*(c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in srgb))


def define_material(
    stage: Usd.Stage, path: Sdf.Path, color: Color, texture: str | None = None
) -> UsdShade.Material:
    """A material with a ``UsdPreviewSurface``.

    Args:
        stage: Where to define it.
        path: Path of the material.
        color: Diffuse colour, sRGB; the fallback where the image cannot be read.
        texture: Asset path of an sRGB image, relative to the layer.
    """
    material = UsdShade.Material.Define(stage, path)
    surface = _shader(stage, path.AppendChild("surface"), "UsdPreviewSurface")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(ROUGHNESS)
    diffuse = surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
    if texture is None:
        diffuse.Set(linear_color(color))
    else:
        diffuse.ConnectToSource(_image(stage, path, color, texture))
    surface.CreateOutput("surface", Sdf.ValueTypeNames.Token)
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    return material


def _image(stage: Usd.Stage, path: Sdf.Path, color: Color, texture: str) -> UsdShade.Output:
    reader = _shader(stage, path.AppendChild("st"), "UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    image = _shader(stage, path.AppendChild("texture"), "UsdUVTexture")
    image.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(texture))
    image.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB")
    image.CreateInput("fallback", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(*linear_color(color), 1))
    for wrap in ("wrapS", "wrapT"):
        image.CreateInput(wrap, Sdf.ValueTypeNames.Token).Set("clamp")
    st = image.CreateInput("st", Sdf.ValueTypeNames.Float2)
    st.ConnectToSource(reader.CreateOutput("result", Sdf.ValueTypeNames.Float2))
    return image.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)


def _shader(stage: Usd.Stage, path: Sdf.Path, identifier: str) -> UsdShade.Shader:
    shader = UsdShade.Shader.Define(stage, path)
    shader.CreateIdAttr(identifier)
    return shader
