"""How far two surfaces lie apart: exact distances, Chamfer distance, and agreement of normals.

The Chamfer distance of samples has a floor: two samplings of one surface do not
coincide. The distance from samples to triangles has none, so it is the figure to trust;
the other is there because papers print it, with its floor beside it.

Positions are in metres, in one shared space. NumPy.
"""

from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from isp_assets.errors import GeometryError
from isp_assets.geometry.closest import unit_face_normals


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle mesh; it may be open, and need not be a manifold."""

    vertices: Float[np.ndarray, "V 3"]
    """Positions [m]."""
    faces: Int[np.ndarray, "F 3"]

    def __post_init__(self) -> None:
        if len(self.faces) == 0:
            raise GeometryError("surface has no faces; distances need at least one triangle")
        if not np.isfinite(self.vertices).all():
            raise GeometryError("surface positions hold NaN or infinity")
        if self.faces.min() < 0 or self.faces.max() >= len(self.vertices):
            raise GeometryError(
                f"faces must index 0..{len(self.vertices) - 1}, got {self.faces.min()}..{self.faces.max()}"
            )

    def sample(
        self, count: int, rng: np.random.Generator
    ) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
        """Points uniform in area [m], and the face of each.

        Raises:
            GeometryError: If the surface has no area.
        """
        corner = self.vertices[self.faces].astype(np.float64)
        area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
        if not area.sum() > 0:
            raise GeometryError("surface has no area; nothing can be sampled on it")
        face = rng.choice(len(area), count, p=area / area.sum())
        return np.einsum("nk,nkc->nc", uniform_weights(count, rng), corner[face]), face


@dataclass(frozen=True)
class SurfaceDistance:
    """One surface against another; both directions count alike."""

    mean: float
    """Mean distance from a point of one surface to the triangles of the other [m]."""
    p95: float
    max: float
    chamfer: float
    """Mean squared distance to the nearest sample, summed over both directions [units squared]."""
    chamfer_floor: float
    """The same between two samplings of the second surface."""
    normal_consistency: float
    """Mean |cosine| of face normals at nearest samples, 0 to 1."""
    signed_normal_consistency: float
    """The same with its sign: faces that look the wrong way count against it."""


def surface_distance(
    first: Surface, second: Surface, *, unit: float = 1.0, samples: int = 100_000, seed: int = 0
) -> SurfaceDistance:
    """Compare a surface with a reference.

    Args:
        first: The surface that was made.
        second: The reference.
        unit: Length [m] of a unit of the Chamfer distance.
        samples: Points drawn on each surface.
        seed: Of the samples; equal seeds give equal figures.

    Raises:
        GeometryError: If a surface has no area.
    """
    rngs = [np.random.default_rng([seed, k]) for k in range(3)]
    drawn = [s.sample(samples, rng) for s, rng in zip((first, second), rngs, strict=False)]
    again, _ = second.sample(samples, rngs[2])
    trees = [cKDTree(points, balanced_tree=False, compact_nodes=False) for points, _ in drawn]
    normals = [unit_face_normals(s.vertices.astype(np.float64), s.faces) for s in (first, second)]
    exact, squared, cosine = [], [], []
    for own, other, reference in ((0, 1, second), (1, 0, first)):
        points, face = drawn[own]
        exact.append(distance_to_surface(points, reference))
        distance, nearest = trees[other].query(points)
        squared.append(float((distance**2).mean()))
        cosine.append((normals[own][face] * normals[other][drawn[other][1][nearest]]).sum(axis=1))
    floor = (trees[1].query(again)[0] ** 2).mean() + (cKDTree(again).query(drawn[1][0])[0] ** 2).mean()
    distances, cosines = np.concatenate(exact), np.concatenate(cosine)
    return SurfaceDistance(
        mean=float(distances.mean()),
        p95=float(np.quantile(distances, 0.95)),
        max=float(distances.max()),
        chamfer=sum(squared) / unit**2,
        chamfer_floor=float(floor) / unit**2,
        normal_consistency=float(np.abs(cosines).mean()),
        signed_normal_consistency=float(cosines.mean()),
    )


def uniform_weights(count: int, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    """Barycentric weights of points uniform in a triangle."""
    u, v = np.sqrt(rng.random(count)), rng.random(count)
    return np.stack([1 - u, u * (1 - v), u * v], axis=1)


def distance_to_surface(points: Float[np.ndarray, "n 3"], surface: Surface) -> Float[np.ndarray, " n"]:
    """Exact distance from points to the nearest triangle [m]."""
    squared, _, _ = igl.point_mesh_squared_distance(
        np.ascontiguousarray(points, np.float64),
        np.ascontiguousarray(surface.vertices, np.float64),
        np.ascontiguousarray(surface.faces, np.int64),
    )
    return np.sqrt(np.maximum(squared.reshape(-1), 0))
