"""What a fit minimises: squared distances between a decoded garment and a surface, both ways.

Closest points are found anew at every evaluation, and held while differentiating: by
the envelope theorem that is the exact gradient of the distance to the closest point.
Lengths inside are millimetres, so that terms of usual size are near one.
"""

from dataclasses import dataclass

import igl
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from isp_assets.geometry.closest import barycentric_weights, unit_face_normals
from isp_assets.geometry.surface_distance import Surface, uniform_weights
from isp_assets.geometry.topology import edges

_MM = 1000.0


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
        self.face_normals = unit_face_normals(surface.vertices.astype(np.float64), surface.faces)
        mesh = edges(surface.faces)
        self.border = mesh.vertices[mesh.num_faces == 1]
        self.border_points = _on_segments(surface.vertices, self.border, samples // 4, rng)

    @property
    def has_border(self) -> bool:
        return len(self.border) > 0


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
        self._weights = torch.from_numpy(uniform_weights(samples, rng)).float()
        mesh = edges(faces)
        self._border = mesh.vertices[mesh.num_faces == 1]
        self._tree = igl.AABB()
        self._tree.init(np.ascontiguousarray(target.surface.vertices, np.float64), target.surface.faces)

    def __call__(self, vertices: Float[Tensor, "V 3"]) -> Tensor:
        """Weighted sum of squared distances [mm^2]; differentiable in the positions [m]."""
        target = self.target
        corners = vertices[torch.from_numpy(self.faces[self._face])]
        points = (self._weights[..., None] * corners).sum(dim=1)
        here = points.detach().double().numpy()
        _, face, closest = self._tree.squared_distance(
            np.ascontiguousarray(target.surface.vertices, np.float64), target.surface.faces, here
        )
        total = _mean_square(points - torch.from_numpy(closest.reshape(-1, 3)).to(points))
        normals = torch.linalg.cross(*(_MM * (corners[:, 1:] - corners[:, :1])).unbind(1))
        aim = torch.from_numpy(target.face_normals[face.reshape(-1)]).to(points)
        cosine = torch.nn.functional.cosine_similarity(normals, aim, dim=-1)
        total = total + self.weights.normal * (1 - cosine.abs()).mean()
        total = total + _mean_square(
            _closest_on(vertices, self.faces, target.points) - _tensor(target.points)
        )
        if target.has_border and len(self._border):
            total = total + self.weights.border * self._border_term(vertices)
        return total

    def _border_term(self, vertices: Float[Tensor, "V 3"]) -> Tensor:
        target = self.target
        to_target = vertices[torch.from_numpy(np.unique(self._border))]
        here = to_target.detach().double().numpy()
        _, _, closest = igl.point_mesh_squared_distance(here, target.surface.vertices, target.border)
        back = _closest_on(vertices, self._border, target.border_points) - _tensor(target.border_points)
        return _mean_square(to_target - torch.from_numpy(closest.reshape(-1, 3)).to(vertices)) + _mean_square(
            back
        )


def _closest_on(
    vertices: Float[Tensor, "V 3"], elements: Int[np.ndarray, "E K"], points: Float[np.ndarray, "n 3"]
) -> Float[Tensor, "n 3"]:
    """Closest points on triangles or segments, as combinations of their corners."""
    here = vertices.detach().double().numpy()
    _, element, closest = igl.point_mesh_squared_distance(points, here, elements)
    chosen = elements[element.reshape(-1)]
    weights = _weights_of(closest.reshape(-1, 3), here[chosen])
    return (torch.from_numpy(weights).to(vertices)[..., None] * vertices[torch.from_numpy(chosen)]).sum(dim=1)


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


def _on_segments(
    vertices: Float[np.ndarray, "V 3"], segments: Int[np.ndarray, "S 2"], count: int, rng: np.random.Generator
) -> Float[np.ndarray, "n 3"]:
    if len(segments) == 0:
        return np.zeros((0, 3))
    ends = vertices[segments]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    chosen = rng.choice(len(segments), count, p=length / length.sum())
    return ends[chosen, 0] + rng.random((count, 1)) * (ends[chosen, 1] - ends[chosen, 0])


def _mean_square(offsets: Float[Tensor, "n 3"]) -> Tensor:
    return (_MM * offsets).square().sum(dim=-1).mean()


def _tensor(points: Float[np.ndarray, "n 3"]) -> Float[Tensor, "n 3"]:
    return torch.from_numpy(points).float()
