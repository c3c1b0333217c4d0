"""Contact between a garment and the surfaces beneath it: the body and every inner garment.

A vertex is compared with the tangent plane of the nearest sample of a surface.
Several surfaces are taken in one pass, and the largest push wins at each vertex:
pushes are not added, because an inner garment lies on the body and both would
lift the same vertex for the same reason.

Positions are in metres, Y up, in one shared space. Every function is pure,
batched over leading axes, and differentiable in the positions of the garment;
which sample is nearest is decided without gradients. On the CPU the look-up uses
a tree per batch entry, on other devices blocks of distances.

Reference: Li, Guillard and Fua, "ISP: Multi-Layered Garment Draping with
Implicit Sewing Patterns", NeurIPS 2023, Eqs. 10-12.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from isp_assets.errors import GeometryError
from isp_assets.geometry.normals import face_normals, vertex_normals

_BLOCK = 2**26  # distances held at once by the look-up without trees (256 MiB in float32)


@dataclass(frozen=True, eq=False)
class Surface:
    """Oriented samples of a surface that a garment must stay above."""

    points: Float[Tensor, "*batch P 3"]
    """Sample positions [m]."""
    normals: Float[Tensor, "*batch P 3"]
    """Unit normals, pointing away from the body."""
    reach: float = math.inf
    """Samples further than this from a vertex [m] do not touch it; keeps the border of a short
    inner garment from pushing the hem of a long outer one along its extended plane."""

    def __post_init__(self) -> None:
        if self.points.shape[-2] == 0:
            raise GeometryError("surface has no sample points; is the mesh beneath empty?")
        if self.points.shape != self.normals.shape:
            raise GeometryError(
                f"surface has points {list(self.points.shape)} but normals {list(self.normals.shape)}"
            )
        if not self.reach > 0:
            raise GeometryError(f"reach must be above 0 m, got {self.reach:g}")

    @classmethod
    def of_mesh(
        cls,
        vertices: Float[Tensor, "*batch V 3"],
        faces: Int[Tensor, "F 3"],
        *,
        reach: float = math.inf,
        centroids: bool = False,
    ) -> "Surface":
        """Sample a mesh at its vertices (as the paper does) and, on request, at its face centroids."""
        points, normals = vertices, vertex_normals(vertices, faces)
        if centroids:
            middle = vertices[..., faces, :].mean(-2)
            points = torch.cat([points, middle], -2)
            normals = torch.cat([normals, face_normals(vertices, faces)], -2)
        return cls(points.detach(), normals.detach(), reach)

    @classmethod
    def of_cloth(
        cls,
        vertices: Float[Tensor, "*batch V 3"],
        faces: Int[Tensor, "F 3"],
        unfolded: Float[Tensor, "*batch V 3"],
        *,
        reach: float = math.inf,
    ) -> "Surface":
        """Sample a garment at its vertices; what a fold turned over gets its normal without the fold.

        Args:
            vertices: The garment [m].
            faces: Its triangles.
            unfolded: The garment in the same pose without folds, as skinning gives it [m].
            reach: Samples further than this from a vertex [m] do not touch it.
        """
        normals, upright = vertex_normals(vertices, faces), vertex_normals(unfolded, faces)
        overturned = (normals * upright).sum(-1, keepdim=True) < 0
        return cls(vertices.detach(), torch.where(overturned, upright, normals).detach(), reach)

    @cached_property
    def trees(self) -> list[cKDTree]:
        """One search tree per batch entry; built on first use."""
        # A balanced tree recurses for ever on exact zeros where torch flushes denormal numbers.
        samples = self.points.reshape(-1, *self.points.shape[-2:]).numpy()
        return [cKDTree(points, balanced_tree=False) for points in samples]


def clearance(vertices: Float[Tensor, "*batch V 3"], surface: Surface) -> Float[Tensor, "*batch V"]:
    """Height [m] of vertices over the tangent plane of their nearest sample; infinite beyond its reach."""
    return _height_and_normal(vertices, surface)[0]


def force(
    vertices: Float[Tensor, "*batch V 3"], surfaces: Sequence[Surface], *, margin: float = 0.0
) -> Float[Tensor, "*batch V 3"]:
    """Repulsive virtual force on each vertex (Eq. 12) [m]: the shortest push to the tangent plane.

    Args:
        vertices: Garment positions [m].
        surfaces: Body and inner garments; at each vertex the largest push wins.
        margin: Clearance to ask for [m]. The paper's force is ``margin=0``.

    Returns:
        ``max(0, margin - height) n``; exactly zero for vertices that are clear.

    Raises:
        GeometryError: If ``margin`` is negative.
    """
    if margin < 0:
        raise GeometryError(f"margin must be >= 0 m, got {margin:g}")
    total, largest = torch.zeros_like(vertices), vertices.new_zeros(vertices.shape[:-1])
    for surface in surfaces:
        height, normal = _height_and_normal(vertices, surface)
        push = torch.relu(margin - height)
        stronger = push > largest
        total = torch.where(stronger[..., None], push[..., None] * normal, total)
        largest = torch.where(stronger, push, largest)
    return total


def collision_loss(
    vertices: Float[Tensor, "*batch V 3"], surfaces: Sequence[Surface], *, margin: float = 0.002
) -> Float[Tensor, "*batch"]:
    """Sum over vertices and surfaces of ``max(0, margin - height)^3`` (Eqs. 8 and 12) [m^3].

    Raises:
        GeometryError: If ``margin`` is negative.
    """
    if margin < 0:
        raise GeometryError(f"margin must be >= 0 m, got {margin:g}")
    total = vertices.new_zeros(vertices.shape[:-2])
    for surface in surfaces:
        total = total + torch.relu(margin - clearance(vertices, surface)).pow(3).sum(-1)
    return total


def _height_and_normal(vertices: Tensor, surface: Surface) -> tuple[Tensor, Tensor]:
    if vertices.shape[:-2] != surface.points.shape[:-2]:
        raise GeometryError(
            f"vertices have batch {list(vertices.shape[:-2])}, the surface has "
            f"{list(surface.points.shape[:-2])}; expand one of them"
        )
    distance, index = _nearest(vertices.detach(), surface)
    index = index[..., None].expand(*index.shape, 3)
    point, normal = surface.points.gather(-2, index), surface.normals.gather(-2, index)
    height = ((vertices - point) * normal).sum(-1)
    if math.isfinite(surface.reach):
        height = torch.where(distance <= surface.reach, height, math.inf)
    return height, normal


def _nearest(vertices: Tensor, surface: Surface) -> tuple[Tensor, Tensor]:
    """Distance to the nearest sample, and its index, with the shape of ``vertices`` less its last axis."""
    flat = vertices.reshape(-1, *vertices.shape[-2:])
    if _on_cpu(vertices):
        found = [tree.query(points) for tree, points in zip(surface.trees, flat.numpy(), strict=True)]
        distances = [torch.as_tensor(distance, dtype=vertices.dtype) for distance, _ in found]
        indices = [torch.as_tensor(index, dtype=torch.int64) for _, index in found]
    else:
        samples = surface.points.reshape(-1, *surface.points.shape[-2:])
        rows = max(1, _BLOCK // (len(samples) * samples.shape[-2]))
        # By products of matrices, distances are off by up to .5 mm: enough to choose by, not to report.
        index = torch.cat([torch.cdist(part, samples).argmin(-1) for part in flat.split(rows, dim=1)], dim=1)
        indices = list(index)
        distances = [
            (points - beneath[chosen]).norm(dim=-1)
            for points, beneath, chosen in zip(flat, samples, indices, strict=True)
        ]
    shape = vertices.shape[:-1]
    return torch.stack(distances).reshape(shape), torch.stack(indices).reshape(shape)


def _on_cpu(tensor: Tensor) -> bool:
    return tensor.device.type == "cpu"
