"""How much of a garment lies where it must not: inside the body, or inside an inner garment.

Four figures for a pair: area fraction, number of crossing triangle pairs, deepest
penetration, and the area fraction that no garment could avoid: the body itself
leaves no room there, for one layer of cloth or for as many as are worn. Areas come from
quadrature points on the faces, refined where a face lies on both sides.

Positions are in metres, in one shared space. NumPy, one frame at a time.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from isp_assets.errors import GeometryError
from isp_assets.geometry.closest import ClosestQuery, SurfaceTopology
from isp_assets.geometry.crossing import crossing_pairs
from isp_assets.geometry.winding import Winding

INNER_REACH = 0.02
"""How far beneath an inner garment [m] a point still counts as inside it."""

_SPLITS = 4  # a face on both sides is cut into this many strips, 16 small triangles
_SKIN_SPLITS = 2  # the same for triangles of the body where room is looked for
_NEAR = 0.015  # a point this near [m] to skin without room is excused,
_OVER = 0.03  # or this far [m] on its outer side, as a sleeve on an arm inside the torso
_AROUND = 0.03  # triangles of a body with their middle this near [m] to a point are looked at


@dataclass(frozen=True)
class Intersection:
    """One garment against one surface."""

    area_percent: float
    """Share of the garment's area on the wrong side, where it could have been avoided [%]."""
    unavoidable_percent: float
    """Share on the wrong side at places where the body leaves no room for cloth [%]."""
    crossing_pairs: int
    """Pairs of triangles that cross, all places."""
    deepest: float
    """Largest depth of a quadrature point on the wrong side, avoidable places only [m]."""


class Beneath:
    """A surface in one frame that garments are measured against; prepared once, used for every layer."""

    def __init__(
        self,
        vertices: Float[np.ndarray, "V 3"],
        topology: SurfaceTopology,
        *,
        closed: bool,
        body: "Beneath | None" = None,
    ) -> None:
        """Place a surface.

        Args:
            vertices: Its positions [m].
            topology: Its connectivity.
            closed: True for a body: inside is where the winding number exceeds one half.
                False for a garment: inside is beneath its nearest triangle, at most ``INNER_REACH``, where
                the winding number says so as well: a fold may have turned the triangle over.
            body: What wears the garment; without it, no place counts as unavoidable.
        """
        if closed and topology.is_open:
            raise GeometryError(
                "a closed surface was expected, but the mesh has a border; is the body mesh complete?"
            )
        self.vertices = np.ascontiguousarray(vertices, np.float64)
        self.topology = topology
        self.closed = closed
        self.body = self if closed else body

    @cached_property
    def closest(self) -> ClosestQuery:
        return ClosestQuery(self.vertices, self.topology)

    @cached_property
    def winding(self) -> Winding:
        return Winding(self.vertices, self.topology.faces)

    @cached_property
    def without_room(self) -> Bool[np.ndarray, " V"]:
        """Vertices of a body above which cloth finds no room: creases, and parts that press together."""
        if not self.closed:
            return np.zeros(len(self.vertices), bool)
        return self.winding.inside(self.vertices + _room(0) * self.closest.normals.of_vertices)

    def leaves_no_room(self, points: Float[np.ndarray, "P 3"], layers: int) -> Bool[np.ndarray, " P"]:
        """Whether a body's skin near points has no room for cloth over so many layers.

        Skin is sampled more finely than the body's triangles are.
        """
        faces, normals, room = self.topology.faces, self.closest.normals.of_vertices, _room(layers)
        middle = self.vertices[faces].mean(1)
        distance, _ = cKDTree(points, balanced_tree=False).query(middle, distance_upper_bound=_AROUND)
        around = faces[distance < _AROUND]
        weights = _subdivision(_SKIN_SPLITS)
        skin = np.einsum("qk,fkc->fqc", weights, self.vertices[around]).reshape(-1, 3)
        away = np.einsum("qk,fkc->fqc", weights, normals[around]).reshape(-1, 3)
        away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
        skin = skin[self.winding.inside(skin + room * away)]
        if len(skin) == 0:
            return np.zeros(len(points), bool)
        found, _ = cKDTree(skin, balanced_tree=False).query(points, distance_upper_bound=_NEAR)
        return np.asarray(found < _NEAR)

    def depth(
        self, points: Float[np.ndarray, "P 3"], layers: int = 0
    ) -> tuple[Float[np.ndarray, " P"], Bool[np.ndarray, " P"]]:
        """Depth [m] of points on the wrong side, 0 elsewhere; and whether the body leaves no room there.

        Args:
            points: Where to measure [m].
            layers: How many garments are worn beneath the one that is measured.
        """
        found = self.closest(points)
        distance = np.abs(found.height)
        if self.closed:
            # The nearest triangle misleads only where the body cuts itself: ask the winding number there.
            inside = found.height < 0
            above = self.without_room[self.topology.faces[found.face]].any(1)
            if above.any():
                inside[above] = self.winding.inside(points[above])
            excused = above & (found.height > 0) & (distance < _OVER)
        else:
            inside = (found.height < 0) & ~found.on_border & (distance < INNER_REACH)
            inside[inside] = self.winding.beneath(points[inside])
            excused = np.zeros(len(points), bool)
        rest = np.flatnonzero(inside & ~excused)
        if len(rest) and self.body is not None:
            excused[rest] = self.body.leaves_no_room(points[rest], layers)
        return np.where(inside, distance, 0.0), excused & inside

    def box(self) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """Bounds of the points that may lie inside [m]."""
        grow = 0.0 if self.closed else INNER_REACH
        return self.vertices.min(0) - grow, self.vertices.max(0) + grow


def _room(layers: int) -> float:
    """Clearance [m] that cloth needs over the body: more for every layer beneath, one on either side."""
    return 0.006 + 0.005 * layers


def measure_intersection(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    beneath: Beneath,
    *,
    layers: int = 0,
) -> Intersection:
    """Measure one garment against one surface.

    Args:
        vertices: The garment [m].
        faces: Its triangles.
        beneath: The body, or a garment worn beneath.
        layers: How many garments are worn beneath it: so many more need room.

    Raises:
        GeometryError: If a position is not finite.
    """
    vertices = np.ascontiguousarray(vertices, np.float64)
    if not np.isfinite(vertices).all():
        raise GeometryError("garment positions hold NaN or infinity; nothing can be measured")
    corner = vertices[faces]
    areas = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    low, high = beneath.box()
    near = np.flatnonzero(((corner.max(1) >= low) & (corner.min(1) <= high)).all(1))
    wrong, excused, deepest = _wrong_shares(vertices, faces[near], beneath, layers)
    total = max(areas.sum(), 1e-30)
    pairs = crossing_pairs(vertices, faces, beneath.vertices, beneath.topology.faces)
    return Intersection(
        area_percent=float(100 * (areas[near] * (wrong - excused)).sum() / total),
        unavoidable_percent=float(100 * (areas[near] * excused).sum() / total),
        crossing_pairs=len(pairs),
        deepest=deepest,
    )


def _wrong_shares(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    beneath: Beneath,
    layers: int,
) -> tuple[Float[np.ndarray, " F"], Float[np.ndarray, " F"], float]:
    """Share of each face on the wrong side, the excused part of it, and the deepest sample not excused."""
    if len(faces) == 0:
        return np.zeros(0), np.zeros(0), 0.0
    used, index = np.unique(faces, return_inverse=True)
    samples = np.concatenate([vertices[used], vertices[faces].mean(1)])
    depth, excuse = beneath.depth(samples, layers)
    of_face = np.concatenate([index.reshape(-1, 3), len(used) + np.arange(len(faces))[:, None]], axis=1)
    inside = depth[of_face] > 0
    wrong = inside.mean(1)
    excused = (inside & excuse[of_face]).mean(1)
    deepest = float(np.where(excuse, 0, depth).max())
    mixed = np.flatnonzero(inside.any(1) & ~inside.all(1))
    if len(mixed):
        weights = _subdivision(_SPLITS)
        fine = np.einsum("qk,fkc->fqc", weights, vertices[faces[mixed]])
        depth, excuse = (part.reshape(len(mixed), -1) for part in beneath.depth(fine.reshape(-1, 3), layers))
        wrong[mixed] = (depth > 0).mean(1)
        excused[mixed] = ((depth > 0) & excuse).mean(1)
        deepest = max(deepest, float(np.where(excuse, 0, depth).max()))
    return wrong, excused, deepest


def _subdivision(splits: int) -> Float[np.ndarray, "Q 3"]:
    """Barycentric centroids of the ``splits ** 2`` equal triangles a face is cut into."""
    upward = [(i + 1 / 3, j + 1 / 3) for i in range(splits) for j in range(splits - i)]
    downward = [(i + 2 / 3, j + 2 / 3) for i in range(splits - 1) for j in range(splits - 1 - i)]
    first, second = np.array(upward + downward).T / splits
    return np.stack([1 - first - second, first, second], axis=1)
