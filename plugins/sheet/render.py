"""Pictures of dressed bodies without a display: ray casting with Embree, smooth shading, soft shadows.

Positions are in metres, Y up. Colours are sRGB in 0..1 at the interface and
linear inside. The same input gives the same pixels: nothing is random.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from isp_assets.errors import PluginError
from isp_assets.frames import Layer
from isp_assets_plugins.normals import VertexNormals

from .camera import Camera, View
from .shading import SurfacePoints, ambient_occlusion, shade
from .texture import MipTexture, linear_from_srgb, srgb_from_linear
from .tracer import Hits, Tracer

SKIN = (0.66, 0.64, 0.63)
"""Display colour of the body: a neutral grey that leaves the colours to the clothes."""

_GROUND_SHADOW = 0.5
_GROUND_REACH = 1.4  # the shadow fades to nothing this far from the middle of the picture [m]


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
    return RenderScene(meshes).draw(camera or Camera(), size, samples=samples, ground=ground)


class RenderScene:
    """Meshes made ready for pictures from any number of sides: one soup of triangles, its normals, its shade.

    Raises:
        PluginError: If there is nothing to draw.
        MissingExtraError: If ``embreex`` is not installed.
    """

    def __init__(self, meshes: Sequence[RenderMesh]) -> None:
        if not meshes:
            raise PluginError("sheet: no meshes to draw")
        starts = np.cumsum([0] + [len(m.vertices) for m in meshes])
        self._meshes = meshes
        self._vertices = np.concatenate([m.vertices for m in meshes]).astype(np.float32)
        faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
        self._faces = np.concatenate(faces).astype(np.int32)
        self._mesh_of_face = np.repeat(np.arange(len(meshes)), [len(m.faces) for m in meshes])
        self._first_face = np.cumsum([0] + [len(m.faces) for m in meshes])
        self._tracer = Tracer(self._vertices, self._faces)
        self._normals = VertexNormals(self._faces, len(self._vertices))(self._vertices)
        self._openness = ambient_occlusion(self._tracer, self._vertices, self._normals)
        self._textures = [None if m.texture is None else MipTexture(m.texture) for m in meshes]
        self._texel_sizes = [_texel_size(mesh) for mesh in meshes]

    def draw(
        self, camera: Camera, size: tuple[int, int], *, samples: int = 3, ground: float | None = None
    ) -> UInt8[np.ndarray, "H W 3"]:
        """One picture; see `render_view`."""
        view = View.place(camera, self._vertices, size)
        image = np.zeros((size[1], size[0], 3))
        for step in range(samples**2):
            image += self._sample(view, step, samples, ground)
        return (255.0 * srgb_from_linear(image / samples**2) + 0.5).astype(np.uint8)

    def _sample(
        self, view: View, step: int, samples: int, ground: float | None
    ) -> Float[np.ndarray, "H W 3"]:
        """Linear light through one point of every pixel."""
        rays = view.rays(((step % samples + 0.5) / samples, (step // samples + 0.5) / samples))
        light = view.light(step, samples**2)
        hit = self._tracer.first_hit(view.eye, rays)
        image = view.backdrop()
        flat = image.reshape(-1, 3)
        toward = rays[hit.ray]
        toward = toward / np.linalg.norm(toward, axis=1, keepdims=True)
        flat[hit.ray] = self._shade(hit, toward, light, view.metres_per_pixel / samples)
        if ground is not None:
            self._ground_shadow(flat, hit.missed, rays, view, light, ground)
        return image

    def _shade(
        self, hit: Hits, rays: Float[np.ndarray, "n 3"], light: Float[np.ndarray, " 3"], footprint: float
    ) -> Float[np.ndarray, "n 3"]:
        corners = self._faces[hit.face]
        weights = hit.weights[..., None]
        surface = SurfacePoints(
            point=(self._vertices[corners] * weights).sum(1),
            normal=(self._normals[corners] * weights).sum(1),
            outside=hit.facing(rays),
            openness=(self._openness[corners] * hit.weights).sum(1),
            albedo=self._albedo(hit, footprint),
        )
        return shade(self._tracer, surface, rays, light)

    def _albedo(self, hit: Hits, footprint: float) -> Float[np.ndarray, "n 3"]:
        albedo = np.empty((len(hit.face), 3), np.float32)
        which = self._mesh_of_face[hit.face]
        for index, (mesh, texture) in enumerate(zip(self._meshes, self._textures, strict=True)):
            chosen = np.flatnonzero(which == index)
            if texture is None or mesh.corner_st is None:
                albedo[chosen] = linear_from_srgb(np.array(mesh.color))
                continue
            corner_st = mesh.corner_st[hit.face[chosen] - self._first_face[index]]
            st = (corner_st * hit.weights[chosen][..., None]).sum(1)
            albedo[chosen] = texture.sample(st, footprint / self._texel_sizes[index])
        return albedo

    def _ground_shadow(
        self,
        flat: Float[np.ndarray, "n 3"],
        missed: Int[np.ndarray, " m"],
        rays: Float[np.ndarray, "n 3"],
        view: View,
        light: Float[np.ndarray, " 3"],
        ground: float,
    ) -> None:
        """Darken the floor, in place, where the lamp does not reach it."""
        missed = missed[rays[missed, 1] < -1e-6]
        direction = rays[missed]
        point = view.eye + ((ground - view.eye[1]) / direction[:, 1])[:, None] * direction
        away = np.linalg.norm((point - view.target)[:, [0, 2]], axis=1)
        near = np.flatnonzero(away < _GROUND_REACH)
        blocked = self._tracer.blocked(point[near], np.broadcast_to(light, (len(near), 3)))
        dark = near[blocked]
        flat[missed[dark]] *= 1.0 - (_GROUND_SHADOW * (1.0 - away[dark] / _GROUND_REACH))[:, None]


def _texel_size(mesh: RenderMesh) -> float:
    """Mean size of a texel on the mesh [m]."""
    if mesh.texture is None or mesh.corner_st is None:
        return 1.0
    edges = np.linalg.norm(np.diff(mesh.vertices[mesh.faces], axis=1), axis=2).sum()
    texels = np.linalg.norm(np.diff(mesh.corner_st, axis=1) * mesh.texture.shape[1::-1], axis=2).sum()
    return float(edges / max(texels, 1e-9))
