"""Triangulation of a flat panel: its outline, a regular lattice inside, Delaunay in between.

The lattice is anchored at the origin and mirror-symmetric in x, so the front and
the back of a garment share their inner points, and the left half mirrors the right.
"""

from collections import deque
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import Delaunay, cKDTree

from isp_assets.errors import GeometryError

_CLEARANCE = 0.62
"""Distance of lattice points from the outline, in spacings; nearer points make thin triangles."""
_DEEP = 1.2
"""Lattice points so far from the outline, in spacings, are Delaunay neighbours of lattice points only:
a circumcircle there has radius 0.58 and cannot reach an outline point."""


def triangulate_panel(
    loops: Sequence[Float[np.ndarray, "_ 2"]], spacing: float
) -> tuple[Float[np.ndarray, "P 2"], Int[np.ndarray, "F 3"]]:
    """Fill closed outlines with triangles of side about ``spacing``.

    Args:
        loops: Closed polygons without a repeated end point [m], resampled at about
            ``spacing``; separate pieces, none inside another.
        spacing: Side of a lattice triangle [m].

    Returns:
        Points [m], of which the first are the loops' own in order, and faces,
        counter-clockwise. Every loop edge is an edge of the result, and every point is used.

    Raises:
        GeometryError: If a loop has under three points, crosses itself, or cannot be filled.
    """
    if spacing <= 0 or not np.isfinite(spacing):
        raise GeometryError(f"spacing must be a positive length in metres, got {spacing}")
    if len(loops) == 0:
        raise GeometryError("a panel needs at least one outline loop, got none")
    num_border = sum(map(len, loops))
    border, inner, faces, start, inner_start = [], [], [], 0, num_border
    for number, loop in enumerate(loops):
        lattice, triangles = _fill(
            np.asarray(loop, dtype=np.float64), spacing, where=f"outline loop {number}"
        )
        index = np.concatenate([start + np.arange(len(loop)), inner_start + np.arange(len(lattice))])
        border.append(loop)
        inner.append(lattice)
        faces.append(index[triangles])
        start, inner_start = start + len(loop), inner_start + len(lattice)
    return np.concatenate([*border, *inner]).astype(np.float64), np.concatenate(faces)


def points_in_polygon(
    points: Float[np.ndarray, "n 2"], loop: Float[np.ndarray, "m 2"]
) -> Bool[np.ndarray, " n"]:
    """Tell which points lie inside a closed polygon, by the even-odd rule."""
    return _enclosed(points, loop, np.roll(loop, -1, axis=0))


def _enclosed(
    points: Float[np.ndarray, "n 2"], start: Float[np.ndarray, "m 2"], end: Float[np.ndarray, "m 2"]
) -> Bool[np.ndarray, " n"]:
    """Whether a ray from each point towards +x crosses an odd number of segments.

    Points are sorted by height, so every segment meets only the few in its span.
    """
    order = np.argsort(points[:, 1], kind="stable")
    height = points[order, 1]
    low, high = (f(start[:, 1], end[:, 1]) for f in (np.minimum, np.maximum))
    first, last = np.searchsorted(height, low), np.searchsorted(height, high)
    count = last - first
    segment = np.repeat(np.arange(len(start)), count)
    at = order[np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)]
    a, along = start[segment], (end - start)[segment]
    crossing = a[:, 0] + (points[at, 1] - a[:, 1]) / along[:, 1] * along[:, 0]
    return np.bincount(at[points[at, 0] < crossing], minlength=len(points)) % 2 == 1


def _fill(loop: Float[np.ndarray, "n 2"], spacing: float, *, where: str):
    """Lattice points and faces of one loop; faces index the loop, then the lattice.

    Deep inside, the lattice's own triangles are the Delaunay triangulation already;
    only the strip between them and the outline is left to compute.
    """
    if loop.ndim != 2 or loop.shape[1] != 2 or len(loop) < 3 or not np.isfinite(loop).all():
        raise GeometryError(
            f"{where}: expected at least 3 finite points of shape [n, 2], got shape {loop.shape}"
        )
    lattice, regular, buried = _lattice_inside(loop, spacing)
    points = np.concatenate([loop, lattice])
    regular = regular + len(loop)
    strip = np.concatenate([np.arange(len(loop)), len(loop) + np.flatnonzero(~buried)])
    triangles = Delaunay(points[strip]).simplices.astype(np.int64)
    triangles = _counter_clockwise(points[strip], triangles)
    for a, b in _missing_edges(triangles, len(loop)):
        _recover_edge(points[strip], triangles, a, b, where=where)
    triangles = strip[triangles]
    # A buried point has lattice triangles all round: no edge of it can lie on a rim.
    on_rim = np.concatenate([np.ones(len(loop), bool), ~buried])
    directed = _directed_edges(regular, on_rim)
    rim = directed[~np.isin(_edge_keys(directed), _edge_keys(directed[:, ::-1]))]
    start = points[np.concatenate([np.arange(len(loop)), rim[:, 0]])]
    end = points[np.concatenate([np.roll(np.arange(len(loop)), -1), rim[:, 1]])]
    triangles = triangles[_enclosed(points[triangles].mean(axis=1), start, end)]
    triangles = triangles[_double_area(points, triangles) > 1e-6 * spacing**2]
    triangles = np.concatenate([triangles, regular])
    _check_filled(points, triangles, loop, on_rim, where=where)
    return lattice, triangles


def _lattice_inside(loop: Float[np.ndarray, "n 2"], spacing: float):
    """Lattice points inside a loop, triangles among those far from it, which points have no others."""
    low, high = loop.min(axis=0), loop.max(axis=0)
    row_height = spacing * np.sqrt(3) / 2
    rows = np.arange(np.floor(low[1] / row_height) - 1, np.ceil(high[1] / row_height) + 2)
    columns = np.arange(np.floor(low[0] / spacing) - 1, np.ceil(high[0] / spacing) + 2)
    column, row = np.meshgrid(columns, rows)
    lattice = np.stack([(column + 0.5 * (np.abs(row) % 2)) * spacing, row * row_height], axis=-1).reshape(
        -1, 2
    )
    inside = np.flatnonzero(points_in_polygon(lattice, loop))
    step = np.linspace(0, 1, 6)[:-1, None, None]
    dense = (loop + step * (np.roll(loop, -1, axis=0) - loop)).reshape(-1, 2)
    distance = np.zeros(len(lattice))
    # A balanced tree recurses for ever on exact zeros where torch flushes denormal numbers.
    # Beyond the bound the distance comes back infinite, which is deep enough.
    tree = cKDTree(dense, balanced_tree=False)
    distance[inside], _ = tree.query(lattice[inside], distance_upper_bound=1.01 * _DEEP * spacing)
    kept = np.flatnonzero(distance > _CLEARANCE * spacing)
    deep = (distance > _DEEP * spacing).reshape(row.shape)
    triangles, used = _lattice_triangles(deep, np.abs(rows) % 2 == 1)
    number = np.full(len(lattice), -1)
    number[kept] = np.arange(len(kept))
    return lattice[kept], number[triangles], used.reshape(-1)[kept] == 6


def _lattice_triangles(deep: Bool[np.ndarray, "r c"], shifted: Bool[np.ndarray, " r"]):
    """Upward and downward triangles whose corners are all deep, and how many meet at each lattice point."""
    index = np.arange(deep.size).reshape(deep.shape)
    odd = shifted[:-1, None]
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    up = np.where(odd[..., None], np.stack([a, b, d], -1), np.stack([a, b, c], -1))
    down = np.where(odd[..., None], np.stack([a, d, c], -1), np.stack([b, d, c], -1))
    triangles = np.concatenate([up.reshape(-1, 3), down.reshape(-1, 3)])
    triangles = triangles[deep.reshape(-1)[triangles].all(axis=1)]
    return triangles, np.bincount(triangles.reshape(-1), minlength=deep.size)


def _edge_keys(directed: Int[np.ndarray, "n 2"]) -> Int[np.ndarray, " n"]:
    """One number an edge: sorting numbers is far faster than sorting rows."""
    return (directed[:, 0] << 32) | directed[:, 1]


def _double_area(points: Float[np.ndarray, "P 2"], faces: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, " F"]:
    a, b, c = (points[faces[:, k]] for k in range(3))
    return (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])


def _counter_clockwise(
    points: Float[np.ndarray, "P 2"], faces: Int[np.ndarray, "F 3"]
) -> Int[np.ndarray, "F 3"]:
    flipped = _double_area(points, faces) < 0
    return np.where(flipped[:, None], faces[:, [0, 2, 1]], faces)


def _missing_edges(faces: Int[np.ndarray, "F 3"], n: int) -> list[tuple[int, int]]:
    directed = np.sort(np.stack([faces, np.roll(faces, -1, 1)], -1).reshape(-1, 2), axis=1)
    loop = np.stack([np.arange(n), (np.arange(n) + 1) % n], axis=1)
    missing = ~np.isin(_edge_keys(np.sort(loop, axis=1)), _edge_keys(directed))
    return [(int(a), int(b)) for a, b in loop[missing]]


def _crosses(p, q, a, b) -> bool:
    """Whether the open segments pq and ab cross."""

    def turn(u, v, w):
        return (v[0] - u[0]) * (w[1] - u[1]) - (v[1] - u[1]) * (w[0] - u[0])

    return bool(turn(p, q, a) * turn(p, q, b) < 0 and turn(a, b, p) * turn(a, b, q) < 0)


def _recover_edge(points, faces, a: int, b: int, *, where: str) -> None:
    """Flip edges that cross segment ab until ab is an edge (Sloan 1993); changes ``faces`` in place."""
    waiting = deque(_edges_across(points, faces, a, b))
    budget = 4 * len(waiting) ** 2 + 4
    while waiting and budget > 0:
        budget -= 1
        p, q = waiting.popleft()
        pair = np.flatnonzero((faces == p).any(axis=1) & (faces == q).any(axis=1))
        r, s = (int(np.setdiff1d(faces[t], (p, q))[0]) for t in pair)
        if not _crosses(points[p], points[q], points[r], points[s]):
            waiting.append(
                (p, q)
            )  # the two triangles are not convex together; another flip will make them so
            continue
        faces[pair] = _counter_clockwise(points, np.array([[r, s, p], [s, r, q]]))
        if _crosses(points[a], points[b], points[r], points[s]):
            waiting.append((r, s))
    if waiting:
        raise GeometryError(
            f"{where}: cannot keep the outline edge {a}-{b} near {points[a].round(4).tolist()}; "
            "does the outline cross itself?"
        )


def _edges_across(points, faces, a: int, b: int) -> list[tuple[int, int]]:
    """Inner edges that cross the segment ab."""
    directed = np.stack([faces, np.roll(faces, -1, 1)], -1).reshape(-1, 2)
    inner = directed[
        (directed[:, 0] < directed[:, 1]) & np.isin(_edge_keys(directed), _edge_keys(directed[:, ::-1]))
    ]
    return [(int(p), int(q)) for p, q in inner if _crosses(points[a], points[b], points[p], points[q])]


def _directed_edges(faces: Int[np.ndarray, "F 3"], wanted: Bool[np.ndarray, " P"]) -> Int[np.ndarray, "n 2"]:
    """The edges of faces, as they run, between wanted points."""
    start, end = faces.reshape(-1), np.roll(faces, -1, 1).reshape(-1)
    rows = np.flatnonzero(wanted[start] & wanted[end])
    return np.stack([start[rows], end[rows]], axis=1)


def _check_filled(points, faces, loop, on_rim, *, where: str) -> None:
    """The border of the faces must be exactly the loop, and their area the polygon's."""
    n = len(loop)
    directed = np.sort(_directed_edges(faces, on_rim), axis=1)
    keys, count = np.unique(_edge_keys(directed), return_counts=True)
    border = keys[count == 1]
    expected = np.sort(_edge_keys(np.sort(np.stack([np.arange(n), (np.arange(n) + 1) % n], 1), axis=1)))
    if not np.array_equal(border, expected):
        raise GeometryError(
            f"{where}: the outline is not kept by its triangulation ({len(border)} border edges, not {n});"
            " does the outline cross itself, or is it thinner than the spacing?"
        )
    following = np.roll(loop, -1, axis=0)
    area = abs((loop[:, 0] * following[:, 1] - loop[:, 1] * following[:, 0]).sum())
    filled = _double_area(points, faces).sum()
    if abs(filled - area) > 1e-6 * area or (np.bincount(faces.reshape(-1), minlength=len(points)) == 0).any():
        raise GeometryError(
            f"{where}: triangles cover {filled / 2:.6g} m^2 of {area / 2:.6g} m^2; "
            "does the outline cross itself?"
        )
