"""The outline of a flat panel: the zero level of its signed distance field.

The field is evaluated in a narrow band about the border only: on a coarse grid,
then on ever finer grids inside the cells that the border can reach. So the cost
grows with the length of the border, not with the area of the square.

Coordinates are network units, in [-1, 1]^2.

Reference: Li, Guillard and Fua, "ISP: Multi-Layered Garment Draping with
Implicit Sewing Patterns", NeurIPS 2023, "Meshing and Preserving Differentiability".
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np
from contourpy import contour_generator
from jaxtyping import Float

from isp_assets.errors import GeometryError

_COARSE_CELLS = 16
"""Cells across the square on the first grid."""
_LIPSCHITZ = 1.2
"""Bound on the slope of the field: 1 for an exact distance, more for a learnt one."""
_SPECK = 0.02
"""Pieces and holes smaller than this share of the largest piece are noise of the field."""
_FLAT_SLOPE = 0.1
"""Squared slope under which a gradient gives no direction."""


@dataclass(frozen=True, eq=False)
class PlaneField:
    """A panel as functions of points of the plane, such as networks give for one code."""

    distance: Callable[[Float[np.ndarray, "n 2"]], Float[np.ndarray, " n"]]
    """Signed distance to the border, negative inside."""
    border: Callable[
        [Float[np.ndarray, "n 2"]],
        tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 2"], Float[np.ndarray, "n L"]],
    ]
    """Signed distance, its gradient, and the logits of the edge labels (label 0 = no edge)."""


@dataclass(frozen=True, eq=False)
class Outline:
    """The border of one panel, as closed polygons with their label logits."""

    loops: tuple[Float[np.ndarray, "_ 2"], ...]
    """One a piece, counter-clockwise, evenly spaced, from left to right; no repeated end point."""
    logits: tuple[Float[np.ndarray, "_ L"], ...]
    """Logits of the edge labels at every point of the loops."""
    num_specks: int
    """Tiny pieces and holes that were dropped."""
    num_evaluations: int
    """Grid points at which the field was evaluated."""


def trace_outline(field: PlaneField, *, cells: int) -> Outline:
    """Find the border of a panel.

    Args:
        field: The panel.
        cells: Grid cells across the square, 16 times a power of two; the outline
            has a point about every cell.

    Raises:
        GeometryError: If there is no panel, if it has a hole, or if it leaves the square.
    """
    values, evaluations = _sample_band(field.distance, cells)
    pieces, num_specks = _zero_loops(values)
    step = 2.0 / cells
    sizes = [max(8, round(_length(loop) / step)) for loop in pieces]
    points = np.concatenate([resample_closed(loop, n) for loop, n in zip(pieces, sizes, strict=True)])
    points, _ = _project(field, points, step)
    splits = np.cumsum(sizes)[:-1]
    # Projection bunches the points a little; even them out, and project what that has moved.
    even = [resample_closed(loop, len(loop)) for loop in np.split(points, splits)]
    points, logits = _project(field, np.concatenate(even), step)
    return Outline(
        loops=tuple(np.split(points, splits)),
        logits=tuple(np.split(logits, splits)),
        num_specks=num_specks,
        num_evaluations=evaluations,
    )


def resample_closed(loop: Float[np.ndarray, "n 2"], num: int) -> Float[np.ndarray, "num 2"]:
    """Points at equal arc length along a closed polygon, starting at its first point."""
    return resample_open(np.concatenate([loop, loop[:1]]), num + 1)[:-1]


def resample_open(curve: Float[np.ndarray, "n 2"], num: int) -> Float[np.ndarray, "num 2"]:
    """Points at equal arc length along a polyline, both ends kept."""
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    even = np.linspace(0.0, arc[-1], num)
    return np.stack([np.interp(even, arc, curve[:, k]) for k in (0, 1)], axis=1)


def _sample_band(distance: Callable, cells: int) -> tuple[Float[np.ndarray, "n n"], int]:
    """Field values on a grid, rows along y: exact wherever a cell can hold border, interpolated elsewhere."""
    size = _COARSE_CELLS
    if cells < size or cells & (cells - 1):
        raise GeometryError(f"cells must be a power of two, {size} or more, got {cells}")
    values = distance(_grid_points(size)).reshape(size + 1, size + 1)
    evaluations, active = values.size, np.ones((size, size), dtype=bool)
    while size < cells:
        corners = np.stack([values[:-1, :-1], values[1:, :-1], values[:-1, 1:], values[1:, 1:]])
        # No point of a cell is farther than half a diagonal from its nearest corner.
        reach = _LIPSCHITZ * np.sqrt(0.5) * 2.0 / size
        active &= (np.abs(corners).min(axis=0) <= reach) | (corners.min(axis=0) * corners.max(axis=0) <= 0)
        size *= 2
        active = active.repeat(2, axis=0).repeat(2, axis=1)
        values = _double(values)
        wanted = np.zeros((size + 1, size + 1), dtype=bool)
        for rows in (slice(None, -1), slice(1, None)):
            for columns in (slice(None, -1), slice(1, None)):
                wanted[rows, columns] |= active
        wanted[::2, ::2] = False  # known from the coarser grid
        if wanted.any():
            values[wanted] = distance(_grid_points(size, np.flatnonzero(wanted)))
        evaluations += int(wanted.sum())
    return values, evaluations


def _grid_points(size: int, index: np.ndarray | None = None) -> Float[np.ndarray, "n 2"]:
    index = np.arange((size + 1) ** 2) if index is None else index
    row, column = np.divmod(index, size + 1)
    return np.stack([column, row], axis=1) * (2.0 / size) - 1.0


def _double(values: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "m m"]:
    """Bilinear interpolation to half the grid step."""
    for axis in (0, 1):
        values = np.moveaxis(values, axis, 0)
        fine = np.empty((2 * len(values) - 1, values.shape[1]))
        fine[::2] = values
        fine[1::2] = 0.5 * (values[:-1] + values[1:])
        values = np.moveaxis(fine, 0, axis)
    return values


def _zero_loops(values: Float[np.ndarray, "n n"]) -> tuple[list[Float[np.ndarray, "_ 2"]], int]:
    """Closed zero contours of a grid, counter-clockwise, and the number of specks left out."""
    if not np.isfinite(values).all():
        raise GeometryError("the panel field gives NaN or infinity")
    axis = np.linspace(-1.0, 1.0, len(values))
    lines = cast(list[np.ndarray], contour_generator(axis, axis, values).lines(0.0))
    if not lines:
        raise GeometryError(
            "the panel field has no inside" if values[0, 0] > 0 else "the panel covers its whole square"
        )
    if any((line[0] != line[-1]).any() for line in lines):
        raise GeometryError("the panel reaches the edge of its square [-1, 1]^2")
    loops = [line[:0:-1] for line in lines]  # contourpy keeps the higher side to the left
    areas = np.array([signed_area(loop) for loop in loops])
    kept = np.flatnonzero(np.abs(areas) > _SPECK * areas.max())
    if (areas[kept] < 0).any() or areas.max() <= 0:
        raise GeometryError(f"the panel has {int((areas[kept] < 0).sum())} hole(s)")
    pieces = [loops[k] for k in kept]
    pieces.sort(key=lambda loop: float(loop[:, 0].mean()))
    return pieces, len(loops) - len(kept)


def signed_area(loop: Float[np.ndarray, "n 2"]) -> float:
    """Area of a closed polygon, positive if it runs counter-clockwise."""
    x, y = (loop - loop.mean(axis=0)).T
    return 0.5 * float(x @ np.roll(y, -1) - np.roll(x, -1) @ y)


def _length(loop: Float[np.ndarray, "n 2"]) -> float:
    return float(np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1).sum())


def _project(field: PlaneField, points: Float[np.ndarray, "n 2"], limit: float):
    """One Newton step ``x - s grad s / |grad s|^2``, no longer than ``limit``; and the logits."""
    distance, gradient, logits = field.border(points)
    slope = (gradient**2).sum(axis=1)
    move = (distance / np.maximum(slope, _FLAT_SLOPE))[:, None] * gradient
    length = np.linalg.norm(move, axis=1, keepdims=True)
    return points - move * np.minimum(1.0, limit / np.maximum(length, 1e-12)), logits
