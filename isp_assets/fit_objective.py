"""What a fit minimises: squared distances between a decoded garment and a surface, both ways.

Closest points are found anew at every evaluation, and held while differentiating: by
the envelope theorem that is the exact gradient of the distance to the closest point.
Lengths inside are millimetres, so that terms of usual size are near one.
"""

from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Float, Int

from isp_assets.fit_residuals import (
    MeshPoints,
    Residuals,
    curve_distances,
    normal_differences,
    segment_tangents,
    surface_distances,
)
from isp_assets.geometry.closest import unit_face_normals
from isp_assets.geometry.surface_distance import Surface, uniform_weights
from isp_assets.geometry.topology import edges


@dataclass(frozen=True)
class FitWeights:
    """How the terms of a fit are weighed."""

    border: float = 0.5
    """Open borders against open borders."""
    normal: float = 10.0
    """Normals: 1 - |cosine|, as if it were square millimetres."""
    prior: float = 0.1
    """Mean square of the whitened code."""


class Target:
    """A surface prepared for fitting: a tree of its triangles, samples, and its open border.

    Args:
        surface: In the space of the rest body [m].
        samples: Points drawn on it.
        seed: Of the samples.
    """

    def __init__(self, surface: Surface, *, samples: int, seed: int = 0) -> None:
        self.surface = surface
        rng = np.random.default_rng(seed)
        self.points, _ = surface.sample(samples, rng)
        self._vertices = np.ascontiguousarray(surface.vertices, np.float64)
        self._tree = igl.AABB()
        self._tree.init(self._vertices, surface.faces)
        self.face_normals = unit_face_normals(self._vertices, surface.faces)
        mesh = edges(surface.faces)
        self.border = mesh.vertices[mesh.num_faces == 1]
        self.border_points = _on_segments(surface.vertices, self.border, samples // 4, rng)

    @property
    def has_border(self) -> bool:
        return len(self.border) > 0

    def closest(
        self, points: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Closest points on the surface [m], and its unit normals there."""
        _, face, closest = self._tree.squared_distance(self._vertices, self.surface.faces, points)
        return closest.reshape(-1, 3), self.face_normals[face.reshape(-1)]

    def closest_on_border(
        self, points: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Closest points on the open border [m], and unit tangents of the border there."""
        _, segment, closest = igl.point_mesh_squared_distance(points, self._vertices, self.border)
        return closest.reshape(-1, 3), segment_tangents(self._vertices, self.border[segment.reshape(-1)])


class Distance:
    """The terms of a fit for one topology of the garment.

    Args:
        target: What to come close to.
        faces: Triangles of the garment.
        areas: Their areas, for sampling.
        samples: Points drawn on the garment.
        weights: Of the terms.
    """

    def __init__(
        self, target: Target, faces: Int[np.ndarray, "F 3"], areas: Float[np.ndarray, " F"], *,
        samples: int, weights: FitWeights,
    ) -> None:  # fmt: skip
        self.target, self.faces, self.weights = target, faces, weights
        rng = np.random.default_rng(0)
        self._face = rng.choice(len(faces), samples, p=areas / areas.sum())
        self._weights = uniform_weights(samples, rng)
        mesh = edges(faces)
        self._border = mesh.vertices[mesh.num_faces == 1]

    def __call__(self, vertices: Float[np.ndarray, "V 3"]) -> Residuals:
        """Residuals of vertex positions [m]: their squares add up to weighted mean squares."""
        target, count = self.target, len(vertices)
        corners = self.faces[self._face]
        there = MeshPoints(corners, self._weights, self._face)
        points = there.at(vertices)
        closest, aim = target.closest(points)
        back = MeshPoints.closest(vertices, self.faces, target.points)
        normals = unit_face_normals(vertices, self.faces)[back.element]
        terms = [
            surface_distances(there, points - closest, aim, count),
            surface_distances(back, back.at(vertices) - target.points, normals, count),
            normal_differences(corners, aim, vertices, self.weights.normal),
        ]
        if target.has_border and len(self._border):
            terms += self._border_terms(vertices)
        return Residuals.concatenate(terms)

    def _border_terms(self, vertices: Float[np.ndarray, "V 3"]) -> list[Residuals]:
        target, weight, count = self.target, self.weights.border, len(vertices)
        own = np.unique(self._border)
        there = MeshPoints(own[:, None], np.ones((len(own), 1)), own)
        closest, along = target.closest_on_border(vertices[own])
        back = MeshPoints.closest(vertices, self._border, target.border_points)
        offsets = back.at(vertices) - target.border_points
        return [
            curve_distances(there, vertices[own] - closest, along, count, weight),
            curve_distances(back, offsets, segment_tangents(vertices, back.corners), count, weight),
        ]


def _on_segments(
    vertices: Float[np.ndarray, "V 3"], segments: Int[np.ndarray, "S 2"], count: int, rng: np.random.Generator
) -> Float[np.ndarray, "n 3"]:
    if len(segments) == 0:
        return np.zeros((0, 3))
    ends = vertices[segments]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    chosen = rng.choice(len(segments), count, p=length / length.sum())
    return ends[chosen, 0] + rng.random((count, 1)) * (ends[chosen, 1] - ends[chosen, 0])
