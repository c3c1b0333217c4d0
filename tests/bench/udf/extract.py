"""Triangle meshes from unsigned distances: cells are meshed by the directions of their gradients.

Where a surface passes through a cell, gradients on its two sides point apart. That gives
the corners signs that hold within the cell, which is all that marching cubes needs; no
inside or outside exists. Cells are found from coarse to fine, so cost follows the surface.

Reference: Guillard, Stella and Fua, "MeshUDF: Fast and Differentiable Meshing of
Unsigned Distance Field Networks", ECCV 2022.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import igl
import numpy as np
import torch
from bench.udf.cleanup import clean_mesh
from bench.udf.field import UdfField
from torch import Tensor

Distance = Callable[[Tensor], Tensor]
"""Distances [N] at points [N, 3] of [-1, 1]^3."""

_CORNERS = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)])
_EDGES = np.array(
    [(0, 1), (1, 2), (3, 2), (0, 3), (4, 5), (5, 6), (7, 6), (4, 7), (0, 4), (1, 5), (2, 6), (3, 7)]
)


@dataclass(frozen=True)
class ExtractOptions:
    """What tells the surface from what is near it; lengths in cells unless said otherwise."""

    reach: float = 1.1
    """A cell may hold the surface if its centre is nearer than this many half diagonals."""
    stretch: float = 1.15
    """The distances at the ends of an edge that crosses the surface add up to no more than its length."""
    snap: bool = True
    """Whether vertices are moved onto the surface along the gradient."""
    fill: int = 8
    """Holes of up to this many edges are closed."""
    chunk: int = 32768
    """Points evaluated at once."""


@dataclass
class ExtractReport:
    """What an extraction cost."""

    values: int = 0
    """Points at which the distance alone was evaluated."""
    gradients: int = 0
    """Points at which its gradient was evaluated too."""
    cells: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    _last: float = field(default_factory=time.perf_counter)

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[stage], self._last = now - self._last, now


def extract_mesh(
    field_: UdfField, code: np.ndarray | Tensor, resolution: int, options: ExtractOptions | None = None
) -> tuple[np.ndarray, np.ndarray, ExtractReport]:
    """The garment of a code: vertices [V, 3] in metres, faces [F, 3] that face outwards, and the cost.

    Args:
        field_: A trained field.
        code: Latent code, [code_size].
        resolution: Cells along each side of the cube.
        options: What tells the surface from what is near it.
    """
    weight = next(field_.parameters())
    latent = torch.as_tensor(code, dtype=weight.dtype, device=weight.device)

    def distance(points: Tensor) -> Tensor:
        return field_(points.to(weight), latent).double().cpu()

    vertices, faces, report = extract_surface(distance, resolution, options, floor=float(field_.floor))
    return field_.to_metres(vertices), faces, report


def extract_surface(
    distance: Distance, resolution: int, options: ExtractOptions | None = None, *, floor: float = 0.0
) -> tuple[np.ndarray, np.ndarray, ExtractReport]:
    """The zero set of unsigned distances in [-1, 1]^3: vertices [V, 3], faces [F, 3] and the cost.

    Args:
        distance: The field; differentiable.
        resolution: Cells along each side, at most 48 after halving it as often as it is even.
        options: What tells the surface from what is near it.
        floor: What the field says on the surface itself, where it should say 0.
    """
    options, report = options or ExtractOptions(), ExtractReport()
    cells = _active_cells(distance, resolution, options, floor, report)
    report.lap("search")
    keys, corner = np.unique(_key(cells[:, None] + _CORNERS, resolution), return_inverse=True)
    corner = corner.reshape(-1, 8)
    points = _from_key(keys, resolution) * (2 / resolution) - 1
    values, directions = _evaluate(distance, points, options.chunk)
    report.gradients += len(points)
    report.lap("gradients")
    signs = _pseudo_signs(values[corner], directions[corner])
    kept = _crossed(values[corner], signs, options.stretch * 2 / resolution + 2 * floor)
    report.cells = int(kept.sum())
    vertices, faces = _march(cells[kept], signs[kept], keys, values, resolution)
    report.lap("march")
    if options.snap and len(vertices):
        values, directions = _evaluate(distance, vertices, options.chunk)
        report.gradients += len(vertices)
        vertices = vertices - np.clip(values - floor, 0, 1 / resolution)[:, None] * directions
    report.lap("snap")
    vertices, faces = clean_mesh(vertices, faces, fill=options.fill)
    report.lap("clean")
    return vertices, faces, report


def _active_cells(
    distance: Distance, resolution: int, options: ExtractOptions, floor: float, report: ExtractReport
) -> np.ndarray:
    """Integer positions [C, 3] of the cells whose centre is near enough to the surface."""
    side = resolution
    while side % 2 == 0 and side > 48:
        side //= 2
    if side > 48:
        raise ValueError(f"resolution must be a small number times a power of two, got {resolution}")
    cells = np.indices((side,) * 3).reshape(3, -1).T
    while True:
        centres = torch.from_numpy((cells + 0.5) * (2 / side) - 1)
        with torch.no_grad():
            values = torch.cat([distance(part) for part in centres.split(options.chunk)]).numpy()
        report.values += len(cells)
        cells = cells[values <= options.reach * np.sqrt(3) / side + 2 * floor]
        if side == resolution:
            return cells
        cells, side = (2 * cells[:, None] + _CORNERS).reshape(-1, 3), 2 * side


def _evaluate(distance: Distance, points: np.ndarray, chunk: int) -> tuple[np.ndarray, np.ndarray]:
    """Distances [N] and the unit vectors [N, 3] along which they grow."""
    values, directions = [np.empty(0)], [np.empty((0, 3))]
    for part in torch.from_numpy(points).split(chunk):
        part.requires_grad_()
        found = distance(part)
        (gradient,) = torch.autograd.grad(found.sum(), part)
        values.append(found.detach().numpy())
        directions.append(torch.nn.functional.normalize(gradient, dim=-1).numpy())
    return np.concatenate(values), np.concatenate(directions)


def _pseudo_signs(values: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Whether each corner [C, 8] lies on the side that the cell's own direction points to.

    The direction is the axis that all gradients of a cell agree on best, whichever way they
    point; corners far from the surface count more, as their gradients are surer.
    """
    spread = np.einsum("ck,cki,ckj->cij", values, directions, directions)
    axis = np.linalg.eigh(spread)[1][:, :, -1]
    return np.einsum("cki,ci->ck", directions, axis) >= 0


def _crossed(values: np.ndarray, signs: np.ndarray, longest: float) -> np.ndarray:
    """Which cells [C] the surface crosses; beyond its border, distances are too long for that."""
    crossing = signs[:, _EDGES[:, 0]] != signs[:, _EDGES[:, 1]]
    total = values[:, _EDGES[:, 0]] + values[:, _EDGES[:, 1]]
    count = crossing.sum(1)
    return (count > 0) & ((total * crossing).sum(1) <= longest * count)


def _march(
    cells: np.ndarray, signs: np.ndarray, keys: np.ndarray, values: np.ndarray, resolution: int
) -> tuple[np.ndarray, np.ndarray]:
    """Mesh every cell by its own signs; triangles of neighbouring cells share vertices.

    On signs alone, vertices fall on the middle of edges: in half cells that is an integer
    position which names the edge.
    """
    if len(cells) == 0:
        return np.empty((0, 3)), np.empty((0, 3), np.int64)
    doubled = 2.0 * (cells[:, None] + _CORNERS).reshape(-1, 3)
    own = np.arange(len(doubled)).reshape(-1, 8)
    middle, faces, _ = igl.marching_cubes(np.where(signs, 1.0, -1.0).ravel(), doubled, own)
    names, merged = np.unique(_key(np.rint(middle).astype(np.int64), 2 * resolution), return_inverse=True)
    middle = _from_key(names, 2 * resolution)
    start, end = middle // 2, (middle + 1) // 2
    first, second = (values[np.searchsorted(keys, _key(c, resolution))] for c in (start, end))
    share = first / np.maximum(first + second, 1e-12)
    vertices = (start + share[:, None] * (end - start)) * (2 / resolution) - 1
    return vertices, merged.reshape(-1)[faces]


def _key(corners: np.ndarray, resolution: int) -> np.ndarray:
    return (corners[..., 0] * (resolution + 1) + corners[..., 1]) * (resolution + 1) + corners[..., 2]


def _from_key(keys: np.ndarray, resolution: int) -> np.ndarray:
    rest, z = np.divmod(keys, resolution + 1)
    return np.stack([*np.divmod(rest, resolution + 1), z], axis=-1)
