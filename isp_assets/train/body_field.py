"""What a garment must know of the body it is draped on: depth from front and back, and distance.

Positions are in metres, Y up, the body facing +Z.
"""

from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from isp_assets.errors import BodyError
from isp_assets.geometry.winding import Winding


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Front-most and back-most depth of the body over the frontal plane."""

    origin: Float[np.ndarray, " 2"]
    """Position of cell (0, 0) [m]."""
    cell: float
    """Spacing of the cells [m]."""
    front: Float[np.ndarray, "Y X"]
    """Largest z of the body [m]; -inf outside the silhouette."""
    back: Float[np.ndarray, "Y X"]
    """Smallest z of the body [m]; +inf outside the silhouette."""

    @property
    def mask(self) -> Bool[np.ndarray, "Y X"]:
        """True inside the silhouette."""
        return np.isfinite(self.front)

    def runs_in_row(self, y: float) -> Float[np.ndarray, "n 2"]:
        """Intervals of x inside the silhouette at height ``y`` [m], from -x to +x."""
        row = self.mask[round((y - self.origin[1]) / self.cell)]
        return self.origin[0] + self.cell * _runs(row)

    def runs_in_column(self, x: float) -> Float[np.ndarray, "n 2"]:
        """Intervals of y inside the silhouette at ``x`` [m], upwards."""
        column = self.mask[:, round((x - self.origin[0]) / self.cell)]
        return self.origin[1] + self.cell * _runs(column)


@dataclass(frozen=True, eq=False)
class DistanceGrid:
    """Signed distance to the body on a regular grid, positive outside, clamped to a band."""

    values: Float[np.ndarray, "X Y Z"]
    """Signed distance [m]."""
    origin: Float[np.ndarray, " 3"]
    """Position of cell (0, 0, 0) [m]."""
    cell: float
    """Spacing of the cells [m]."""

    def sample(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Trilinear signed distance [m]; beyond the grid, that of its border."""
        index = (points - self.origin) / self.cell
        return ndimage.map_coordinates(self.values, index.T, order=1, mode="nearest")


def depth_map(
    vertices: Float[np.ndarray, "N 3"], faces: Int[np.ndarray, "F 3"], *, cell: float = 0.005
) -> DepthMap:
    """Rasterise a closed body onto the frontal plane."""
    origin = vertices[:, :2].min(axis=0) - 0.1
    size = ((vertices[:, :2].max(axis=0) + 0.1 - origin) / cell).astype(int) + 1
    corner = np.concatenate([(vertices[:, :2] - origin) / cell, vertices[:, 2:]], axis=1)[faces]
    low = np.ceil(corner[..., :2].min(axis=1)).astype(int)
    span = np.floor(corner[..., :2].max(axis=1)).astype(int) - low + 1
    span[span.min(axis=1) < 1] = 0
    count = span.prod(axis=1)
    face = np.repeat(np.arange(len(faces)), count)
    rank = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
    x = low[face, 0] + rank % np.maximum(span[face, 0], 1)
    y = low[face, 1] + rank // np.maximum(span[face, 0], 1)
    a, b, c = (corner[face, k] for k in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        wb = ((x - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (y - a[:, 1])) / area
        wc = ((b[:, 0] - a[:, 0]) * (y - a[:, 1]) - (x - a[:, 0]) * (b[:, 1] - a[:, 1])) / area
        hit = (np.abs(area) > 1e-9) & (wb >= -1e-6) & (wc >= -1e-6) & (wb + wc <= 1 + 1e-6)
    x, y, wb, wc, corners = x[hit], y[hit], wb[hit], wc[hit], corner[face[hit]]
    depth = corners[:, 0, 2] * (1 - wb - wc) + corners[:, 1, 2] * wb + corners[:, 2, 2] * wc
    front, back = np.full(size[::-1], -np.inf), np.full(size[::-1], np.inf)
    np.maximum.at(front, (y, x), depth)
    np.minimum.at(back, (y, x), depth)
    return DepthMap(origin=origin, cell=cell, front=front, back=back)


def distance_grid(
    vertices: Float[np.ndarray, "N 3"],
    faces: Int[np.ndarray, "F 3"],
    *,
    cell: float = 0.008,
    band: float = 0.05,
) -> DistanceGrid:
    """Signed distance to a closed body: exact in a band about the surface, clamped to ``band`` beyond.

    The sign is that of the generalised winding number, so a body that
    penetrates itself still has an inside.

    Raises:
        BodyError: If the grid finds no inside; the mesh is then open or inside out.
    """
    vertices = np.ascontiguousarray(vertices, dtype=np.float64)
    faces = np.ascontiguousarray(faces, dtype=np.int64)
    low = vertices.min(axis=0) - band - cell
    size = np.ceil((vertices.max(axis=0) + band + cell - low) / cell).astype(int) + 1
    corner = vertices[faces]
    # Samples closer than a cell all over the surface find the band; its exact distances follow.
    share = np.array([(i, j, 8 - i - j) for i in range(9) for j in range(9 - i)]) / 8
    samples = np.einsum("sk,fkd->sfd", share, corner).reshape(-1, 3)
    occupied = np.zeros(size, dtype=bool)
    occupied[tuple(np.round((samples - low) / cell).astype(int).T)] = True
    rough = ndimage.distance_transform_edt(~occupied) * cell
    near = rough < band + 1.5 * cell
    points = low + np.argwhere(near) * cell
    tree = igl.AABB()
    tree.init(vertices, faces)
    distance = np.sqrt(tree.squared_distance(vertices, faces, points)[0])
    sign = np.where(Winding(vertices, faces).inside(points), -1.0, 1.0)
    values = np.full(size, band)
    values[near] = np.clip(sign * distance, -band, band)
    region, _ = ndimage.label(~near)
    values[(region > 0) & (region != region[0, 0, 0])] = -band
    if not (values[near] < 0).any():
        raise BodyError("body mesh has no inside; it must be closed with faces wound outwards")
    return DistanceGrid(values=values, origin=low, cell=cell)


def _runs(line: Bool[np.ndarray, " n"]) -> Int[np.ndarray, "m 2"]:
    change = np.diff(np.concatenate([[0], line.astype(int), [0]]))
    return np.stack([np.flatnonzero(change == 1), np.flatnonzero(change == -1) - 1], axis=1)
