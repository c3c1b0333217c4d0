"""Maps over the two panels: images in the plane of the pattern, sampled at garment vertices.

A map has six channels, ``R x R`` texels: three values for the front panel, then
three for the back. It spans panel coordinates [-1, 1]²: the centre of texel
``[row, column]`` lies at ``x = (2 column + 1)/R - 1``, ``y = (2 row + 1)/R - 1``, so row
0 is the lowest. Both operators below are linear, and fixed once a garment is known.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from isp_assets.errors import GeometryError

PANEL_COUNT = 2


@dataclass(frozen=True, eq=False)
class PanelSampler:
    """Moves values between the vertices of one garment and maps of R x R texels. Make it with `build`."""

    resolution: int
    num_vertices: int
    texel_index: Int[Tensor, "P 4"]
    """Flat texel of each bilinear neighbour, counted over both panels."""
    texel_weight: Float[Tensor, "P 4"]
    """Bilinear weight over the number of points that share the vertex."""
    point_vertex: Int[Tensor, " P"]
    """Garment vertex of every panel point, front panel first."""
    inside_texel: Int[Tensor, " T"]
    """Flat texels whose centre lies inside a panel."""
    corner_vertex: Int[Tensor, "T 3"]
    corner_weight: Float[Tensor, "T 3"]
    """Barycentric coordinates of those centres in the triangle of ``corner_vertex``."""

    @classmethod
    def build(
        cls,
        points: Sequence[Float[np.ndarray, "_ 2"]],
        faces: Sequence[Int[np.ndarray, "_ 3"]],
        vertex_index: Sequence[Int[np.ndarray, " _"]],
        *,
        resolution: int,
    ) -> "PanelSampler":
        """Precompute both operators.

        Args:
            points: Per panel, front first: panel coordinates of its points, within [-1, 1].
            faces: Per panel: triangles over its points.
            vertex_index: Per panel: garment vertex of every point.
            resolution: Texels R along a side.

        Raises:
            GeometryError: If there are not two panels or points lie outside [-1, 1]².
        """
        if not len(points) == len(faces) == len(vertex_index) == PANEL_COUNT:
            raise GeometryError(f"panel map: expected {PANEL_COUNT} panels, got {len(points)}")
        largest = max(float(np.abs(p).max(initial=0)) for p in points)
        if not largest <= 1.0 + 1e-6:
            raise GeometryError(
                f"panel map: points must lie in [-1, 1]², the largest coordinate is {largest:g}; "
                "subtract the category's panel centre and divide by its scale first"
            )
        offsets = [k * resolution**2 for k in range(PANEL_COUNT)]
        index, weight = zip(*(_bilinear(p, resolution) for p in points), strict=True)
        texel, corner, barycentric = zip(
            *(_cover(p, f, resolution) for p, f in zip(points, faces, strict=True)), strict=True
        )
        vertex = np.concatenate(vertex_index).astype(np.int64)
        shared = np.bincount(vertex)
        corners = [v[c] for v, c in zip(vertex_index, corner, strict=True)]
        return cls(
            resolution=resolution,
            num_vertices=len(shared),
            texel_index=_integers([i + o for i, o in zip(index, offsets, strict=True)]),
            texel_weight=torch.from_numpy((np.concatenate(weight) / shared[vertex, None]).astype(np.float32)),
            point_vertex=torch.from_numpy(vertex),
            inside_texel=_integers([t + o for t, o in zip(texel, offsets, strict=True)]),
            corner_vertex=_integers(corners),
            corner_weight=torch.from_numpy(np.concatenate(barycentric).astype(np.float32)),
        )

    @property
    def inside(self) -> Bool[Tensor, "2 R R"]:
        """Which texel centres lie inside the front and the back panel."""
        mask = torch.zeros(
            PANEL_COUNT * self.resolution**2, dtype=torch.bool, device=self.inside_texel.device
        )
        mask[self.inside_texel] = True
        return mask.reshape(PANEL_COUNT, self.resolution, self.resolution)

    def sample(self, maps: Float[Tensor, "*batch 6 R R"]) -> Float[Tensor, "*batch V 3"]:
        """Read maps at the vertices, bilinearly; panel points that share a vertex are averaged.

        Raises:
            GeometryError: If the maps are not of this sampler's resolution.
        """
        if tuple(maps.shape[-3:]) != (3 * PANEL_COUNT, self.resolution, self.resolution):
            raise GeometryError(
                f"panel map: expected [6, {self.resolution}, {self.resolution}], got {list(maps.shape[-3:])}"
            )
        batch = maps.shape[:-3]
        texels = maps.reshape(-1, PANEL_COUNT, 3, self.resolution**2).transpose(-1, -2).flatten(1, 2)
        corner = texels.index_select(1, self.texel_index.reshape(-1)).unflatten(1, (-1, 4))
        point = (corner * self.texel_weight.to(maps.dtype)[..., None]).sum(-2)
        vertex = point.new_zeros(point.shape[0], self.num_vertices, 3).index_add(1, self.point_vertex, point)
        return vertex.reshape(*batch, self.num_vertices, 3)

    def rasterise(self, values: Float[Tensor, "*batch V 3"]) -> Float[Tensor, "*batch 6 R R"]:
        """Draw vertex values into maps: linear over each triangle at texel centres inside, 0 elsewhere."""
        batch = values.shape[:-2]
        flat = values.reshape(-1, *values.shape[-2:])
        corner = flat.index_select(1, self.corner_vertex.reshape(-1)).unflatten(1, (-1, 3))
        texel = (corner * self.corner_weight.to(values.dtype)[..., None]).sum(-2)
        drawn = texel.new_zeros(texel.shape[0], PANEL_COUNT * self.resolution**2, 3)
        drawn = drawn.index_copy(1, self.inside_texel, texel)
        planes = drawn.unflatten(1, (PANEL_COUNT, -1)).transpose(-1, -2)
        return planes.reshape(*batch, 3 * PANEL_COUNT, self.resolution, self.resolution)

    def to(self, device: torch.device | str) -> "PanelSampler":
        """Copy to a device."""
        tensors = {k: v.to(device) for k, v in vars(self).items() if isinstance(v, Tensor)}
        return PanelSampler(resolution=self.resolution, num_vertices=self.num_vertices, **tensors)


def _integers(parts: Sequence[np.ndarray]) -> Tensor:
    return torch.from_numpy(np.concatenate(parts).astype(np.int64))


def _bilinear(
    points: Float[np.ndarray, "P 2"], resolution: int
) -> tuple[Int[np.ndarray, "P 4"], Float[np.ndarray, "P 4"]]:
    """Neighbouring texels and weights; beyond the outermost centres the map goes on unchanged."""
    position = np.clip((points.astype(np.float64) + 1) * (resolution / 2) - 0.5, 0, resolution - 1)
    low = np.minimum(position.astype(np.int64), max(resolution - 2, 0))
    high = np.minimum(low + 1, resolution - 1)
    fraction = position - low
    x = np.stack([low[:, 0], high[:, 0]], 1)
    y = np.stack([low[:, 1], high[:, 1]], 1)
    weight_x = np.stack([1 - fraction[:, 0], fraction[:, 0]], 1)
    weight_y = np.stack([1 - fraction[:, 1], fraction[:, 1]], 1)
    index = y[:, :, None] * resolution + x[:, None, :]
    weight = weight_y[:, :, None] * weight_x[:, None, :]
    return index.reshape(-1, 4), weight.reshape(-1, 4)


def _cover(
    points: Float[np.ndarray, "P 2"], faces: Int[np.ndarray, "F 3"], resolution: int
) -> tuple[Int[np.ndarray, " T"], Int[np.ndarray, "T 3"], Float[np.ndarray, "T 3"]]:
    """Texels whose centre a triangle covers, that triangle, and the centre's barycentric coordinates."""
    corner = ((points.astype(np.float64) + 1) * (resolution / 2) - 0.5)[faces]
    low = np.clip(np.ceil(corner.min(1) - 1e-9), 0, None).astype(np.int64)
    high = np.clip(np.floor(corner.max(1) + 1e-9), None, resolution - 1).astype(np.int64)
    size = np.clip(high - low + 1, 0, None)
    count = size.prod(1)
    # One row per texel of every triangle's bounding box.
    face = np.repeat(np.arange(len(faces)), count)
    within = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
    column, row = low[face, 0] + within % size[face, 0], low[face, 1] + within // size[face, 0]
    barycentric = _barycentric(np.stack([column, row], 1), corner[face])
    hit = np.flatnonzero((barycentric >= -1e-9).all(1))
    # A centre on an edge is covered twice: the first triangle keeps it.
    texel, first = np.unique((row * resolution + column)[hit], return_index=True)
    kept = hit[first]
    return texel, faces[face[kept]], barycentric[kept]


def _barycentric(
    point: Float[np.ndarray, "T 2"] | Int[np.ndarray, "T 2"], corner: Float[np.ndarray, "T 3 2"]
) -> Float[np.ndarray, "T 3"]:
    first, second = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    offset = point - corner[:, 0]
    area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):  # a flat triangle covers nothing: NaN compares false
        b = (offset[:, 0] * second[:, 1] - offset[:, 1] * second[:, 0]) / area
        c = (first[:, 0] * offset[:, 1] - first[:, 1] * offset[:, 0]) / area
    return np.stack([1 - b - c, b, c], 1)
