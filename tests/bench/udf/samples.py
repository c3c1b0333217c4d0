"""Points around a garment with their exact distance and its gradient."""

from dataclasses import dataclass

import igl
import numpy as np
import torch
from torch import Tensor

from isp_assets.train.dataset import GarmentDataset, TrainingGarment

Mesh = tuple[np.ndarray, np.ndarray]
"""Vertices [V, 3] and faces [F, 3]."""


@dataclass(frozen=True)
class UdfSamplingOptions:
    """How many points are drawn where; the rest is uniform in the cube."""

    points: int = 16000
    bands: tuple[tuple[float, float], ...] = ((0.1, 0.0), (0.25, 0.01), (0.2, 0.04), (0.1, 0.1))
    """Share and spread of the points around the surface [network units]."""
    border: tuple[float, float] = (0.1, 0.02)
    """The same around the garment's openings."""
    elsewhere: tuple[float, float] = (0.15, 0.03)
    """The same around other garments: uniform points are too few to teach that this one is not there."""


def rest_mesh(garment: TrainingGarment) -> Mesh:
    """The sewn garment on the rest body [m], faces outwards."""
    return np.asarray(garment.rest_vertices, float), garment.faces.astype(np.int64)


def unit_box(dataset: GarmentDataset, margin: float = 0.05) -> tuple[tuple[float, float, float], float]:
    """Center and half side [m] of a cube around all garments."""
    low = np.min([garment.rest_vertices.min(0) for garment in dataset.garments], axis=0)
    high = np.max([garment.rest_vertices.max(0) for garment in dataset.garments], axis=0)
    x, y, z = (float(v) for v in (low + high) / 2)
    return (x, y, z), float((high - low).max() / 2 / (1 - margin))


def sample_distances(
    mesh: Mesh, places: np.ndarray, options: UdfSamplingOptions, rng: np.random.Generator
) -> Tensor:
    """Training points of one garment in random order, [N, 8]: position, distance, its gradient, and the
    part of the distance that leads beyond the border, at right angles to the normal.

    Args:
        mesh: In network units.
        places: Points [P, 3] on all garments of the category, in network units.
        options: How many points are drawn where.
        rng: Source of randomness.
    """
    vertices, faces = mesh

    def count(share: float) -> int:
        return int(share * options.points)

    def around(points: np.ndarray, spread: float) -> np.ndarray:
        return points + spread * rng.uniform(-1, 1, points.shape)

    parts = [around(points_on(mesh, count(share), rng), spread) for share, spread in options.bands]
    share, spread = options.border
    parts.append(around(_on_edges(vertices[igl.boundary_facets(faces)[0]], count(share), rng), spread))
    share, spread = options.elsewhere
    parts.append(around(rng.choice(places, count(share)), spread))
    parts.append(rng.uniform(-1, 1, (options.points - sum(map(len, parts)), 3)))
    xyz = rng.permutation(np.concatenate(parts).clip(-1, 1))
    squared, face, closest = igl.point_mesh_squared_distance(xyz, vertices, faces)
    distance = np.sqrt(squared)[:, None]
    gradient = np.where(distance > 1e-5, (xyz - closest) / np.maximum(distance, 1e-5), 0.0)
    normal = np.cross(*(vertices[faces[face, k]] - vertices[faces[face, 0]] for k in (1, 2)))
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-15)
    across = ((xyz - closest) * normal).sum(1, keepdims=True)
    beyond = np.sqrt(np.maximum(distance**2 - across**2, 0))
    return torch.from_numpy(np.concatenate([xyz, distance, gradient, beyond], axis=1).astype(np.float32))


def points_on(mesh: Mesh, count: int, rng: np.random.Generator) -> np.ndarray:
    """Points [count, 3] on a surface, uniform in area."""
    corners = mesh[0][mesh[1]]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = corners[rng.choice(len(area), count, p=area / area.sum())]
    return np.einsum("nk,nkd->nd", rng.dirichlet((1, 1, 1), count), chosen)


def _on_edges(ends: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    chosen = ends[rng.choice(len(length), count, p=length / length.sum())]
    return chosen[:, 0] + rng.random((count, 1)) * (chosen[:, 1] - chosen[:, 0])
