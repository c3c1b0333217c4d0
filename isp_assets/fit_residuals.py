"""Residuals of a fit: distances of points of a mesh, as sparse linear functions of its vertices.

Closest points are held while differentiating: by the envelope theorem that is the exact
gradient of the squared distance. A distance to a surface grows along the line to its
closest point alone, as from point to plane, so that Gauss-Newton steps slide along
surfaces; a distance to a curve slides along the curve.

Positions are in metres, residuals in millimetres. NumPy.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array, vstack

from isp_assets.geometry.closest import barycentric_weights

_MM = 1000.0
_TOUCHING = 1e-7  # so near to a surface, the direction of a distance is the normal's [m]


@dataclass(frozen=True, eq=False)
class Residuals:
    """Numbers whose squares a fit adds up, and how they change with the garment."""

    values: Float[np.ndarray, " R"]
    """Weighted [mm]."""
    slope: csr_array
    """Of shape [R, 3 V]: by vertex coordinates, x, y and z of a vertex side by side [mm/m]."""

    @property
    def energy(self) -> float:
        """Sum of squares [mm^2]."""
        return float(self.values @ self.values)

    @classmethod
    def of(
        cls, values: Float[np.ndarray, " R"], rows: Float[np.ndarray, "R K 3"],
        corners: Int[np.ndarray, "R K"], num_vertices: int,
    ) -> "Residuals":  # fmt: skip
        """From the change with every corner that a residual depends on."""
        columns = 3 * corners[..., None] + np.arange(3)
        starts = np.arange(len(values) + 1) * (3 * corners.shape[1])
        shape = (len(values), 3 * num_vertices)
        return cls(values, csr_array((rows.reshape(-1), columns.reshape(-1), starts), shape=shape))

    @classmethod
    def concatenate(cls, terms: Sequence["Residuals"]) -> "Residuals":
        slope = csr_array(vstack([term.slope for term in terms], format="csr"))
        return cls(np.concatenate([term.values for term in terms]), slope)


@dataclass(frozen=True, eq=False)
class MeshPoints:
    """Points as weighted corners of elements of a mesh."""

    corners: Int[np.ndarray, "n K"]
    weights: Float[np.ndarray, "n K"]
    element: Int[np.ndarray, " n"]

    @classmethod
    def closest(
        cls, vertices: Float[np.ndarray, "V 3"], elements: Int[np.ndarray, "E K"],
        points: Float[np.ndarray, "n 3"],
    ) -> "MeshPoints":  # fmt: skip
        """Those on triangles or segments that are closest to given points."""
        _, element, closest = igl.point_mesh_squared_distance(points, vertices, elements)
        element = element.reshape(-1).astype(np.int64)
        chosen = elements[element]
        return cls(chosen, _weights_of(closest.reshape(-1, 3), vertices[chosen]), element)

    def at(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "n 3"]:
        """Their positions [m]."""
        return np.einsum("nk,nkc->nc", self.weights, vertices[self.corners])


def surface_distances(
    points: MeshPoints, offsets: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"],
    num_vertices: int,
) -> Residuals:  # fmt: skip
    """Distances between points of a mesh and a surface; their mean square is the energy.

    Args:
        points: Points of the mesh.
        offsets: From the surface, or from a point on the other side of the pair [m].
        normals: Of either surface: the direction where the offset vanishes.
        num_vertices: Of the mesh.
    """
    away = offsets + _TOUCHING * normals
    away /= np.maximum(np.linalg.norm(away, axis=1), 1e-30)[:, None]
    scale = _MM / np.sqrt(len(offsets))
    rows = scale * points.weights[..., None] * away[:, None]
    return Residuals.of(scale * (offsets * away).sum(axis=1), rows, points.corners, num_vertices)


def curve_distances(
    points: MeshPoints, offsets: Float[np.ndarray, "n 3"], along: Float[np.ndarray, "n 3"],
    num_vertices: int, weight: float,
) -> Residuals:  # fmt: skip
    """Offsets between points of a mesh and a curve; ``weight`` times their mean square is the energy.

    Args:
        points: Points of the mesh.
        offsets: From the curve, or from a point to the mesh's own [m].
        along: Unit tangents of the curve, along which offsets do not grow.
        num_vertices: Of the mesh.
        weight: Of the term.
    """
    away = offsets / np.maximum(np.linalg.norm(offsets, axis=1), 1e-12)[:, None]
    along = along - (along * away).sum(axis=1, keepdims=True) * away  # at the corners of a polyline
    along = along / np.maximum(np.linalg.norm(along, axis=1), 1e-12)[:, None]
    across = np.eye(3) - along[:, :, None] * along[:, None]
    scale = _MM * np.sqrt(weight / len(offsets))
    rows = scale * points.weights[:, None, :, None] * across[:, :, None]
    size = points.corners.shape[1]
    corners = np.repeat(points.corners, 3, axis=0)
    return Residuals.of(scale * offsets.reshape(-1), rows.reshape(-1, size, 3), corners, num_vertices)


def normal_differences(
    corners: Int[np.ndarray, "n 3"], aim: Float[np.ndarray, "n 3"], vertices: Float[np.ndarray, "V 3"],
    weight: float,
) -> Residuals:  # fmt: skip
    """Differences of unit normals; the energy is ``weight`` times the mean of 1 - |cosine|.

    Args:
        corners: Triangles of the mesh.
        aim: Unit normals that theirs should have, of either sign.
        vertices: Of the mesh [m].
        weight: Of the term.
    """
    first, second, third = vertices[corners].transpose(1, 0, 2)
    sides = np.stack([third - second, first - third, second - first], axis=1)
    cross = np.cross(sides[:, 0], sides[:, 1])
    length = np.maximum(np.linalg.norm(cross, axis=1), 1e-12)[:, None]
    normal = cross / length
    cosine = (normal * aim).sum(axis=1, keepdims=True)
    scale = np.sqrt(0.5 * weight / len(corners))
    flat = (np.eye(3) - normal[:, :, None] * normal[:, None]) / length[..., None]
    # The cross product changes by (opposite side) x (motion) of every corner.
    rows = scale * np.cross(flat[:, :, None], sides[:, None])
    values = scale * (normal - np.where(cosine < 0, -1, 1) * aim)
    return Residuals.of(
        values.reshape(-1), rows.reshape(-1, 3, 3), np.repeat(corners, 3, axis=0), len(vertices)
    )


def segment_tangents(
    vertices: Float[np.ndarray, "V 3"], segments: Int[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 3"]:
    """Unit vectors along segments; zero for one without length."""
    side = vertices[segments[:, 1]] - vertices[segments[:, 0]]
    return side / np.maximum(np.linalg.norm(side, axis=1), 1e-12)[:, None]


def _weights_of(
    point: Float[np.ndarray, "n 3"], corner: Float[np.ndarray, "n K 3"]
) -> Float[np.ndarray, "n K"]:
    """Barycentric weights of points that lie on their triangles or segments."""
    if corner.shape[1] == 3:
        return barycentric_weights(point, corner)
    along = corner[:, 1] - corner[:, 0]
    share = ((point - corner[:, 0]) * along).sum(1) / np.maximum((along**2).sum(1), 1e-30)
    share = share.clip(0, 1)
    return np.stack([1 - share, share], axis=1)
