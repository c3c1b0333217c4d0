"""The body's mesh: closed, symmetric, and no denser than clothes need.

MakeHuman's body surface runs inward at mouth and eyes. Those pockets are cut off
and capped, head, hands and feet are thinned out, and one half is mirrored.
Kept vertices are MakeHuman's own, so targets and weights carry over by number.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from isp_assets.train.default_body.collapse import Collapser
from isp_assets.train.default_body.makehuman import MakeHuman, Phenotype

_ON_MIDLINE = 1e-5  # |x| below this is on the plane of symmetry [m]
_SHAPE = Phenotype({"gender": 0.5, "height": 0.365})  # where edges are measured

# Where the pockets begin (left half, MakeHuman's vertex numbers): behind the eyelid, and inside the lips.
# Found by casting rays outward from every face; one face beyond each loop seeds the flood.
_EYE = [
    7748, 7747, 7749, 7750, 7751, 7752, 7753, 7754, 7755, 7756, 11716, 7757, 7758, 7759, 7760,
    7761, 7762, 7763, 11717, 7764, 7771, 7797, 7796, 7795, 7794, 7798, 7793, 7767, 7766, 7765,
]  # fmt: skip
_MOUTH = [
    520, 7267, 7268, 7261, 7262, 11962, 7263, 7181, 7180, 7178, 7193, 7196, 10399, 10400, 7191,
    7192, 7195, 10376, 7205, 7204, 7197, 7206, 7266, 7265, 7280, 7279, 540,
]  # fmt: skip
_SEEDS = ([7787, 7788, 7762, 7761], [7194, 7195, 7192, 7191])


@dataclass(frozen=True)
class _Region:
    """A part of the body, its bones, and how far to thin it."""

    bones: tuple[str, ...]
    budget: int | None
    """Vertices to keep in one half of the mesh; ``None`` leaves the part as it is."""
    longest: float
    """Longest edge to make [m]."""


_TRUNK_BONES = (
    "lowerarm", "upperarm", "shoulder", "clavicle", "spine", "breast", "root", "pelvis",
    "upperleg", "lowerleg", "neck",
)  # fmt: skip
_REGIONS = (
    _Region(("",), 600, 0.022),  # the head: every bone that no other region names
    _Region(("finger",), 400, 0.014),
    _Region(("metacarpal", "wrist"), 170, 0.022),
    _Region(("toe",), 150, 0.016),
    _Region(("foot",), 170, 0.026),
    _Region(_TRUNK_BONES, None, 1.0),
    _Region((), 190, 0.03),  # spots of the trunk that are needlessly dense
)
_TRUNK, _DENSE = 5, 6
_DENSE_EDGE = 0.0125  # mean edge length below which a trunk vertex counts as dense [m]


@dataclass(frozen=True)
class Topology:
    """Faces, and the MakeHuman vertex behind each vertex: midline first, then left, then right."""

    base_vertices: Int[np.ndarray, " V"]
    faces: Int[np.ndarray, "F 3"]
    num_midline: int
    num_side: int

    @property
    def mirror(self) -> Int[np.ndarray, " V"]:
        """The partner of each vertex on the other side; midline vertices are their own."""
        middle, side = self.num_midline, self.num_side
        left, right = np.arange(middle, middle + side), np.arange(middle + side, middle + 2 * side)
        return np.concatenate([np.arange(middle), right, left])


def build_topology(makehuman: MakeHuman) -> Topology:
    """Cut, cap, thin out and mirror the left half of MakeHuman's body."""
    base = makehuman.vertices
    midline = np.abs(base[:, 0]) < _ON_MIDLINE
    points = makehuman.shape(_SHAPE)
    quads = makehuman.groups["body"]
    quads = quads[(base[quads][:, :, 0] >= -_ON_MIDLINE).all(1)]
    quads = quads[~_in_pocket(quads)]
    faces = _triangulate(quads, points)
    edges = _edges(faces)
    for loop in _border_loops(quads):
        faces = np.concatenate([faces, _cap(loop, midline, points, edges)])
    collapser = Collapser(
        points,
        faces,
        fixed=midline,
        region=_regions(makehuman.bone_weights(), points, edges),
        budget=[region.budget for region in _REGIONS],
        longest=[region.longest for region in _REGIONS],
    )
    return _mirrored(collapser.run(), midline, base)


def _in_pocket(quads: Int[np.ndarray, "Q 4"]) -> Bool[np.ndarray, " Q"]:
    """The quads beyond the loops: a flood from the seeds that does not cross them."""
    eye = zip(_EYE, _EYE[1:] + _EYE[:1], strict=True)
    mouth = itertools.pairwise(_MOUTH)
    walls = {frozenset(edge) for edge in (*eye, *mouth)}
    rows = quads.tolist()
    beside: dict[frozenset[int], list[int]] = {}
    for number, quad in enumerate(rows):
        for edge in zip(quad, quad[1:] + quad[:1], strict=True):
            beside.setdefault(frozenset(edge), []).append(number)
    inside = np.zeros(len(quads), dtype=bool)
    stack = [number for number, quad in enumerate(rows) if quad in _SEEDS]
    inside[stack] = True
    while stack:
        quad = rows[stack.pop()]
        for side in zip(quad, quad[1:] + quad[:1], strict=True):
            if frozenset(side) not in walls:
                fresh = [number for number in beside[frozenset(side)] if not inside[number]]
                inside[fresh] = True
                stack += fresh
    return inside


def _triangulate(quads: Int[np.ndarray, "Q 4"], points: Float[np.ndarray, "M 3"]) -> Int[np.ndarray, "F 3"]:
    """Split quads along their shorter diagonal."""
    first = np.linalg.norm(points[quads[:, 0]] - points[quads[:, 2]], axis=1)
    second = np.linalg.norm(points[quads[:, 1]] - points[quads[:, 3]], axis=1)
    one = np.stack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]], axis=1)
    other = np.stack([quads[:, [0, 1, 3]], quads[:, [1, 2, 3]]], axis=1)
    return np.where((first <= second)[:, None, None], one, other).reshape(-1, 3)


def _edges(faces: Int[np.ndarray, "F 3"]) -> set[tuple[int, int]]:
    """Every edge, in both directions."""
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).tolist()
    return {(a, b) for a, b in directed} | {(b, a) for a, b in directed}


def _border_loops(quads: Int[np.ndarray, "Q 4"]) -> list[list[int]]:
    """Closed borders, each in the direction of its faces."""
    sides = (zip(quad, quad[1:] + quad[:1], strict=True) for quad in quads.tolist())
    directed = dict.fromkeys(edge for side in sides for edge in side)  # a set that keeps its order
    following = {a: b for a, b in directed if (b, a) not in directed}
    loops = []
    while following:
        loop = [next(iter(following))]
        while loop[-1] in following:
            loop.append(following.pop(loop[-1]))
        loops.append(loop[:-1])
    return loops


def _cap(
    loop: list[int],
    midline: Bool[np.ndarray, " M"],
    points: Float[np.ndarray, "M 3"],
    edges: set[tuple[int, int]],
) -> Int[np.ndarray, "C 3"]:
    """Faces that close a border: all of an eye socket, or the half mouth that interrupts the midline."""
    on_midline = midline[loop]
    if on_midline.any():
        start = next(k for k in range(len(loop)) if on_midline[k] and not on_midline[(k + 1) % len(loop)])
        turned = loop[start:] + loop[: start + 1]
        end = next(k for k in range(1, len(turned)) if midline[turned[k]])
        loop = turned[: end + 1]
    return fill_polygon(points, loop[::-1], edges)


def fill_polygon(
    points: Float[np.ndarray, "M 3"], polygon: Sequence[int], edges: set[tuple[int, int]]
) -> Int[np.ndarray, "C 3"]:
    """Triangulate a polygon in space with the least area (dynamic programming).

    Args:
        points: Vertex positions [m].
        polygon: Vertex numbers around the polygon.
        edges: Edges that exist already, in both directions; as diagonals they would be used four times.
    """
    corners = points[list(polygon)]
    count = len(polygon)
    cost, apex = np.zeros((count, count)), np.full((count, count), -1)
    for span in range(2, count):
        for i in range(count - span):
            j = i + span
            best = np.inf
            for k in range(i + 1, j):
                taken = (k > i + 1 and (polygon[i], polygon[k]) in edges) or (
                    j > k + 1 and (polygon[k], polygon[j]) in edges
                )
                total = cost[i, k] + cost[k, j] + _triangle_cost(corners[[i, k, j]])
                if not taken and total < best:
                    best, apex[i, j] = total, k
            cost[i, j] = best
    triangles, stack = [], [(0, count - 1)]
    while stack:
        i, j = stack.pop()
        if j - i >= 2:
            k = int(apex[i, j])
            triangles.append((polygon[i], polygon[k], polygon[j]))
            stack += [(k, j), (i, k)]
    return np.array(triangles)


def _triangle_cost(corners: Float[np.ndarray, "3 3"]) -> float:
    """Area, and a little for long edges, which decides between flat triangulations."""
    area = np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0])) / 2
    return float(area + 1e-3 * ((corners - np.roll(corners, 1, axis=0)) ** 2).sum())


def _regions(
    bone_weights: Mapping[str, list[tuple[int, float]]],
    points: Float[np.ndarray, "M 3"],
    edges: set[tuple[int, int]],
) -> Int[np.ndarray, " M"]:
    """Region number of each vertex, by the bone that moves it most."""
    weights = np.zeros((len(points), len(bone_weights)))
    for bone, rows in enumerate(bone_weights.values()):
        for vertex, weight in rows:
            weights[vertex, bone] += weight
    of_bone = [
        next((k for k, region in enumerate(_REGIONS) if k and name.startswith(region.bones)), 0)
        for name in bone_weights
    ]
    region = np.array(of_bone)[weights.argmax(1)]
    pairs = np.array(sorted(edges))
    lengths = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    total = np.bincount(pairs[:, 0], weights=lengths, minlength=len(points))
    mean = total / np.maximum(np.bincount(pairs[:, 0], minlength=len(points)), 1)
    region[(region == _TRUNK) & (mean < _DENSE_EDGE)] = _DENSE
    return region


def _mirrored(
    half: Int[np.ndarray, "H 3"], midline: Bool[np.ndarray, " M"], base: Float[np.ndarray, "M 3"]
) -> Topology:
    """Both halves, numbered midline, left, right; mirrored faces are turned round to face outward."""
    _, partner = cKDTree(base).query(base * [-1, 1, 1])
    used = np.unique(half)
    middle, left = used[midline[used]], used[~midline[used]]
    number = np.full(len(base), -1)
    number[middle] = np.arange(len(middle))
    number[left] = len(middle) + np.arange(len(left))
    faces = number[half]
    other = np.where(faces >= len(middle), faces + len(left), faces)[:, ::-1]
    vertices = np.concatenate([middle, left, partner[left]])
    return Topology(vertices, np.concatenate([faces, other]), len(middle), len(left))
