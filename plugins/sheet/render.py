"""Pictures of dressed bodies without a display: ray casting with Embree, smooth shading, soft shadows.

Positions are in metres, Y up. Colours are sRGB in 0..1 at the interface and
linear inside. The same input gives the same pixels: nothing is random.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image

from isp_assets.errors import PluginError
from isp_assets.frames import Layer

from .camera import Camera, View
from .shading import ambient_occlusion, linear_from_srgb, shade, srgb_from_linear, vertex_normals
from .tracer import Tracer

SKIN = (0.66, 0.64, 0.63)
"""Display colour of the body: a neutral grey that leaves the colours to the clothes."""


@dataclass(frozen=True, eq=False)
class RenderMesh:
    """One mesh with its look: a texture over ``st``, or one colour."""

    vertices: Float[np.ndarray, "V 3"]
    """World space [m]."""
    faces: Int[np.ndarray, "F 3"]
    color: tuple[float, float, float] = SKIN
    """sRGB in 0..1; not used where there is a texture."""
    texture: UInt8[np.ndarray, "H W 3"] | None = None
    """sRGB; row 0 is t = 1."""
    corner_st: Float[np.ndarray, "F 3 2"] | None = None
    """Texture coordinates of every face's corners; needed with a texture."""

    def __post_init__(self) -> None:
        if self.texture is not None and self.corner_st is None:
            raise PluginError("sheet: a mesh with a texture needs corner_st, its texture coordinates")

    @classmethod
    def of_layer(cls, layer: Layer, vertices: Float[np.ndarray, "V 3"]) -> "RenderMesh":
        """A garment with its texture, at ``vertices`` [m]."""
        garment = layer.garment
        corner_st = garment.st[garment.corner_st_index]
        return cls(vertices, garment.faces, layer.color, layer.texture, corner_st)


def render_view(
    meshes: Sequence[RenderMesh],
    *,
    camera: Camera | None = None,
    size: tuple[int, int] = (480, 640),
    samples: int = 3,
    ground: float | None = None,
) -> UInt8[np.ndarray, "H W 3"]:
    """Picture of some meshes on a light background.

    Args:
        meshes: What to draw.
        camera: Where to look from; by default the front, framed to fit.
        size: Width and height in pixels.
        samples: Rays per pixel along each axis; the shadow is as soft as there are rays.
        ground: Height of a floor that catches shadows [m]; ``None`` for no floor.

    Returns:
        sRGB image.

    Raises:
        PluginError: If there is nothing to draw.
        MissingExtraError: If ``embreex`` is not installed.
    """
    if not meshes:
        raise PluginError("sheet: no meshes to draw")
    view = View.place(camera or Camera(), np.concatenate([m.vertices for m in meshes]), size)
    scene = _Scene(meshes, view, samples)
    image = np.zeros((size[1], size[0], 3))
    for step in range(samples**2):
        image += scene.sample(step, samples, ground)
    return (255.0 * srgb_from_linear(image / samples**2) + 0.5).astype(np.uint8)


class _Scene:
    """The meshes as one soup of triangles, with everything shading looks up."""

    def __init__(self, meshes: Sequence[RenderMesh], view: View, samples: int) -> None:
        starts = np.cumsum([0] + [len(m.vertices) for m in meshes])
        self.vertices = np.concatenate([m.vertices for m in meshes]).astype(np.float32)
        faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
        self.faces = np.concatenate(faces).astype(np.int32)
        self.mesh_of_face = np.repeat(np.arange(len(meshes)), [len(m.faces) for m in meshes])
        self.first_face = np.cumsum([0] + [len(m.faces) for m in meshes])
        self.meshes = meshes
        self.view = view
        self.tracer = Tracer(self.vertices, self.faces)
        self.normals = vertex_normals(self.vertices, self.faces)
        self.openness = ambient_occlusion(self.tracer, self.vertices, self.normals)
        texel = view.metres_per_pixel / samples
        self.textures = [None if m.texture is None else _shrunk(m, texel) for m in meshes]

    def sample(self, step: int, samples: int, ground: float | None) -> Float[np.ndarray, "H W 3"]:
        """Linear light through one point of every pixel."""
        jitter = ((step % samples + 0.5) / samples, (step // samples + 0.5) / samples)
        rays = self.view.rays(jitter)
        light = self.view.light(step, samples**2)
        hit = self.tracer.first_hit(self.view.eye, rays)
        image = self.view.backdrop()
        flat = image.reshape(-1, 3)
        toward = rays[hit.ray]
        toward = toward / np.linalg.norm(toward, axis=1, keepdims=True)
        flat[hit.ray] = self._shade(hit, toward, light)
        if ground is not None:
            self._ground_shadow(flat, hit.missed, rays, light, ground)
        return image

    def _shade(self, hit, rays, light):
        corners = self.faces[hit.face]
        weights = hit.weights[..., None]
        normal = (self.normals[corners] * weights).sum(1)
        openness = (self.openness[corners] * hit.weights).sum(1)
        point = (self.vertices[corners] * weights).sum(1)
        return shade(self.tracer, point, normal, hit.facing(rays), openness, self._albedo(hit), rays, light)

    def _albedo(self, hit) -> Float[np.ndarray, "n 3"]:
        albedo = np.empty((len(hit.face), 3))
        which = self.mesh_of_face[hit.face]
        for index, (mesh, texture) in enumerate(zip(self.meshes, self.textures, strict=True)):
            chosen = which == index
            if texture is None or mesh.corner_st is None:
                albedo[chosen] = linear_from_srgb(np.array(mesh.color))
                continue
            corner_st = mesh.corner_st[hit.face[chosen] - self.first_face[index]]
            albedo[chosen] = _bilinear(texture, (corner_st * hit.weights[chosen][..., None]).sum(1))
        return albedo

    def _ground_shadow(self, flat, missed, rays, light, ground: float) -> None:
        direction = rays[missed]
        down = direction[:, 1] < -1e-6
        missed, direction = missed[down], direction[down]
        distance = (ground - self.view.eye[1]) / direction[:, 1]
        point = self.view.eye + distance[:, None] * direction
        near = np.abs(point - self.view.target)[:, [0, 2]].max(1) < 2.0
        lit = ~self.tracer.blocked(point[near], np.broadcast_to(light, (int(near.sum()), 3)))
        flat[missed[near]] *= np.where(lit, 1.0, 0.62)[:, None]


def _shrunk(mesh: RenderMesh, texel: float) -> Float[np.ndarray, "h w 3"]:
    """The texture in linear light, averaged down until a texel covers about one sample (no moire)."""
    assert mesh.texture is not None
    assert mesh.corner_st is not None
    edges = np.linalg.norm(np.diff(mesh.vertices[mesh.faces], axis=1), axis=2).sum()
    scale = np.array(mesh.texture.shape[1::-1])
    texels = np.linalg.norm(np.diff(mesh.corner_st, axis=1) * scale, axis=2).sum()
    factor = max(1, round(float(texel * texels / max(edges, 1e-9))))
    image = Image.fromarray(mesh.texture)
    return linear_from_srgb(np.asarray(image.reduce(factor) if factor > 1 else image) / 255.0)


def _bilinear(texture: Float[np.ndarray, "h w 3"], st: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    height, width = texture.shape[:2]
    x = np.clip(st[:, 0] * width - 0.5, 0, width - 1)
    y = np.clip((1 - st[:, 1]) * height - 0.5, 0, height - 1)
    x0, y0 = x.astype(int), y.astype(int)
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    top = texture[y0, x0] * (1 - fx) + texture[y0, x1] * fx
    return top * (1 - fy) + (texture[y1, x0] * (1 - fx) + texture[y1, x1] * fx) * fy
