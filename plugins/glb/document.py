"""The glTF scene of a shot: nodes, meshes, materials, textures, animation."""

import io
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int
from PIL import Image

import isp_assets
from isp_assets.frames import Layer, Scene
from isp_assets_plugins.normals import VertexNormals

from .container import ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER, GlbFile
from .morph import MeshTargets, TargetStore

BODY_COLOR = (0.343, 0.319, 0.296, 1.0)
"""Skin grey, linear light."""
_CLAMP, _LINEAR, _LINEAR_MIPMAP_LINEAR = 33071, 9729, 9987
_ROUGHNESS = 0.9


@dataclass(eq=False)
class Part:
    """One mesh of the file, and what was recorded of its motion."""

    name: str
    faces: Int[np.ndarray, "F 3"]
    """Over points."""
    vertex_index: Int[np.ndarray, " P"]
    """Vertex of every point: a vertex on a seam of the texture has several points."""
    vertex_normals: VertexNormals
    layer: Layer | None = None
    position: Float[np.ndarray, "P 3"] | None = None
    """First frame [m]."""
    normal: Float[np.ndarray, "P 3"] | None = None
    targets: MeshTargets = field(default_factory=MeshTargets)

    @classmethod
    def of_body(cls, faces: Int[np.ndarray, "F 3"], num_vertices: int) -> "Part":
        return cls("Body", faces, np.arange(num_vertices), VertexNormals(faces, num_vertices))

    @classmethod
    def of_layer(cls, layer: Layer) -> "Part":
        garment = layer.garment
        index = np.concatenate([panel.vertex_index for panel in garment.panels.values()])
        normals = VertexNormals(garment.faces, garment.num_vertices)
        return cls(layer.name, garment.corner_st_index, index, normals, layer)

    def record(self, vertices: Float[np.ndarray, "V 3"], store: TargetStore) -> None:
        """Keep the first frame; store any other as differences to it."""
        vertices = vertices.astype(np.float32)
        normal = self.vertex_normals(vertices)[self.vertex_index]
        position = vertices[self.vertex_index]
        if self.position is None or self.normal is None:
            self.position, self.normal = position, normal
        else:
            store.add(self.targets, position - self.position, normal - self.normal)


def build(scene: Scene, body: Part, garments: list[Part], store: TargetStore) -> GlbFile:
    """The whole file. Nodes: the shot, under it ``Body`` and ``Garments``, under that one node a layer."""
    extras = {"frames": str(scene.frames), "fps": scene.fps}
    file = GlbFile({"generator": f"isp-assets {isp_assets.__version__}", "extras": extras})
    parts = [body, *garments]
    targets = store.attach(file, [part.targets for part in parts])
    frames = list(scene.frames)
    nodes = [_add_mesh(file, part, entries, frames) for part, entries in zip(parts, targets, strict=True)]
    group: dict[str, object] = {"name": "Garments"}
    if garments:
        group["children"] = nodes[1:]
    root = file.append("nodes", {"name": scene.name, "children": [nodes[0], file.append("nodes", group)]})
    file.document |= {"scenes": [{"nodes": [root]}], "scene": 0}
    if len(frames) > 1:
        _add_animation(file, scene, nodes, [part.targets.scales for part in parts])
    return file


def _add_mesh(file: GlbFile, part: Part, targets: list[dict[str, int]], frames: list[int]) -> int:
    """A mesh and its node; returns the node."""
    assert part.position is not None
    assert part.normal is not None
    attributes = {
        "POSITION": file.array(part.position, target=ARRAY_BUFFER, bounds=True),
        "NORMAL": file.array(part.normal, target=ARRAY_BUFFER),
    }
    if part.layer is not None:
        st = part.layer.garment.st.astype(np.float32)
        flipped = np.stack([st[:, 0], 1 - st[:, 1]], 1)  # glTF counts from the top of the image
        attributes["TEXCOORD_0"] = file.array(flipped, target=ARRAY_BUFFER)
    index_type = np.uint16 if len(part.position) < 65535 else np.uint32
    indices = file.array(part.faces.astype(index_type).ravel(), target=ELEMENT_ARRAY_BUFFER)
    primitive: dict[str, object] = {
        "attributes": attributes,
        "indices": indices,
        "material": _add_material(file, part),
    }
    mesh: dict[str, object] = {"name": part.name, "primitives": [primitive]}
    if targets:
        primitive["targets"] = targets
        mesh["weights"] = [0.0] * len(targets)
        mesh["extras"] = {"targetNames": [str(frame) for frame in frames[1:]]}
    return file.append("nodes", {"name": part.name, "mesh": file.append("meshes", mesh)})


def _add_material(file: GlbFile, part: Part) -> int:
    surface: dict[str, object] = {"metallicFactor": 0.0, "roughnessFactor": _ROUGHNESS}
    if part.layer is None:
        surface["baseColorFactor"] = list(BODY_COLOR)
        return file.append("materials", {"name": part.name, "pbrMetallicRoughness": surface})
    surface["baseColorTexture"] = {"index": _add_texture(file, part.layer)}
    material = {"name": part.name, "pbrMetallicRoughness": surface, "doubleSided": True}
    return file.append("materials", material)


def _add_texture(file: GlbFile, layer: Layer) -> int:
    data = io.BytesIO()
    Image.fromarray(layer.texture).save(data, format="PNG", compress_level=4)
    image = {"name": layer.name, "mimeType": "image/png", "bufferView": file.view(data.getvalue())}
    if "samplers" not in file.document:
        wrap = {"wrapS": _CLAMP, "wrapT": _CLAMP}
        file.append("samplers", {"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAP_LINEAR, **wrap})
    return file.append("textures", {"source": file.append("images", image), "sampler": 0})


def _add_animation(file: GlbFile, scene: Scene, nodes: list[int], scales: list[list[float]]) -> None:
    """Frame k plays at ``(k - start) / fps`` seconds: full weight there, falling linearly."""
    frames = np.array(list(scene.frames))
    times = file.array(((frames - frames[0]) / scene.fps).astype(np.float32), bounds=True)
    samplers: list[dict[str, object]] = []
    channels: list[dict[str, object]] = []
    written: dict[tuple[float, ...], int] = {}
    for node, weights in zip(nodes, scales, strict=True):
        key = tuple(weights)
        if key not in written:
            table = np.zeros((len(frames), len(weights)), np.float32)
            table[np.arange(1, len(frames)), np.arange(len(weights))] = weights
            written[key] = len(samplers)
            samplers.append({"input": times, "output": file.array(table.ravel()), "interpolation": "LINEAR"})
        channels.append({"sampler": written[key], "target": {"node": node, "path": "weights"}})
    file.append("animations", {"name": scene.name, "samplers": samplers, "channels": channels})
