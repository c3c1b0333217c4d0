"""Surfaces split into body parts, so that contact is sought where it makes sense.

The nearest point of a body to a sleeve may lie on the torso, and a push towards it
would drag the sleeve through the arm. So every vertex of the body and of a garment
knows the parts it belongs to (from its skinning weights), and closest points are
sought on faces that share a part with the query point (*own* contact) or on those
that share none (*foreign* contact, meant for shallow touches only).

Positions are in metres, in one shared space. NumPy; one frame at a time.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from isp_assets.errors import GeometryError
from isp_assets.geometry.closest import (
    Closest,
    ClosestQuery,
    SurfaceNormals,
    SurfacePart,
    SurfaceTopology,
)
from isp_assets.geometry.winding import Winding

BODY_PARTS: dict[str, tuple[int, ...]] = {
    "torso": (0, 3, 6, 9, 13, 14),
    "head": (12, 15),
    "left_arm": (16, 18, 20, 22),
    "right_arm": (17, 19, 21, 23),
    "left_leg": (1, 4, 7, 10),
    "right_leg": (2, 5, 8, 11),
}
"""Joints of each part."""
TORSO = list(BODY_PARTS).index("torso")
ARMS = tuple(list(BODY_PARTS).index(name) for name in ("left_arm", "right_arm"))
LEGS = tuple(list(BODY_PARTS).index(name) for name in ("left_leg", "right_leg"))
"""Places among the parts."""

NO_ROOM = 0.005
"""Surfaces this near to one another [m] leave no room for cloth between them."""

_BELONGS = 0.3  # weight from which a vertex belongs to a part
_LEAST_MARGIN = 0.0005  # clearance kept where surfaces touch [m]
_EXTENDS = 0.08  # weight from which a face counts to a part; lower, so that parts overlap at their seams


def body_parts(
    joint_weights: Float[np.ndarray, "V 24"],
) -> tuple[Bool[np.ndarray, "V 6"], Bool[np.ndarray, "V 6"]]:
    """Which of `BODY_PARTS` each vertex belongs to, at least one; and which it may touch as its own."""
    return _by_weight(_part_weights(joint_weights))


def apart_from_arms(parts: Bool[np.ndarray, "V 6"]) -> Bool[np.ndarray, "V 6"]:
    """Parts that cloth may lie on: all but the arms as one, since cloth in a hip's crease lies on both."""
    own = parts.copy()
    rest = np.setdiff1d(np.arange(parts.shape[1]), ARMS)
    own[:, rest] |= parts[:, rest].any(axis=1, keepdims=True)
    return own


def joined_at_hips(parts: Bool[np.ndarray, "V 6"]) -> Bool[np.ndarray, "V 6"]:
    """Parts that cloth on bare skin lies on: the torso's on the legs as well, a leg's on the torso.

    Folded up, thighs press on the belly; their cloth must be lifted over either, not drawn in from one.
    """
    own = parts.copy()
    own[:, LEGS] |= parts[:, [TORSO]]
    own[:, TORSO] |= parts[:, LEGS].any(axis=1)
    return own


def _by_weight(
    weight: Float[np.ndarray, "V 6"],
) -> tuple[Bool[np.ndarray, "V 6"], Bool[np.ndarray, "V 6"]]:
    parts = weight >= _BELONGS
    parts[np.arange(len(parts)), weight.argmax(1)] = True
    return parts, weight >= _EXTENDS


def _part_weights(joint_weights: Float[np.ndarray, "V 24"]) -> Float[np.ndarray, "V 6"]:
    return np.stack([joint_weights[:, list(joints)].sum(1) for joints in BODY_PARTS.values()], axis=1)


@dataclass(frozen=True, eq=False)
class CollisionMesh:
    """Static collision data of a body or a garment; built once, used in every frame."""

    topology: SurfaceTopology
    parts: Bool[np.ndarray, "V 6"]
    """Which of `BODY_PARTS` each vertex belongs to; at least one."""
    part_faces: tuple[Int[np.ndarray, " _"], ...]
    """Faces of each part; parts overlap."""
    main_part: Int[np.ndarray, " V"]
    """The part that each vertex belongs to most."""

    @cached_property
    def part_surfaces(self) -> tuple[SurfacePart, ...]:
        """Each part as a surface cut out of the whole."""
        return tuple(SurfacePart.build(self.topology, faces) for faces in self.part_faces)

    @cached_property
    def main_surfaces(self) -> tuple[SurfacePart, ...]:
        """The faces at each part's main vertices, as surfaces that overlap by one face."""
        of_face = self.main_part[self.topology.faces]
        masks = ((of_face == part).any(1) for part in range(len(BODY_PARTS)))
        return tuple(SurfacePart.build(self.topology, np.flatnonzero(mask)) for mask in masks)

    @classmethod
    def build(
        cls, faces: Int[np.ndarray, "F 3"], joint_weights: Float[np.ndarray, "V 24"]
    ) -> "CollisionMesh":
        """Sort a mesh into parts.

        Args:
            faces: Triangles, wound so that normals point away from the body.
            joint_weights: Skinning weights; rows sum to 1.

        Raises:
            GeometryError: If the mesh is no surface.
        """
        weight = _part_weights(joint_weights)
        parts, extended = _by_weight(weight)
        topology = SurfaceTopology.build(faces, len(joint_weights))
        of_face = extended[topology.faces].any(1)
        part_faces = tuple(np.flatnonzero(of_face[:, k]) for k in range(len(BODY_PARTS)))
        return cls(topology, parts, part_faces, weight.argmax(1))


class Obstacle:
    """A collision mesh in one frame; its search trees are built on first use and shared by all who ask."""

    def __init__(
        self,
        mesh: CollisionMesh,
        vertices: Float[np.ndarray, "V 3"],
        *,
        margin: float,
        tight: Bool[np.ndarray, " V"] | None = None,
    ) -> None:
        """Place a mesh.

        Args:
            mesh: Its collision data.
            vertices: Its positions in this frame [m].
            margin: Clearance that others keep above it [m].
            tight: Vertices above which there is no room for cloth, besides those that probing finds.

        Raises:
            GeometryError: If the margin is negative.
        """
        if margin < 0:
            raise GeometryError(f"margin must be >= 0 m, got {margin:g}")
        self._tight = tight
        self.mesh = mesh
        self.vertices = np.ascontiguousarray(vertices, np.float64)
        self.margin = margin
        self._queries: dict[int, ClosestQuery] = {}

    @cached_property
    def normals(self) -> SurfaceNormals:
        return SurfaceNormals(self.vertices, self.mesh.topology.faces)

    @cached_property
    def whole(self) -> ClosestQuery:
        """All parts at once."""
        return ClosestQuery(self.vertices, self.mesh.topology, normals=self.normals)

    @cached_property
    def winding(self) -> Winding:
        """Tells the side of points where folds mislead."""
        return Winding(self.vertices, self.mesh.topology.faces)

    @cached_property
    def room(self) -> Float[np.ndarray, " V"]:
        """How far above each vertex another place of the surface lies [m]; 1 cm or four margins at most."""
        half = max(2 * self.margin, NO_ROOM)
        probe = self.whole(self.vertices + half * self.normals.of_vertices)
        return np.where(self.blocked, 0.0, (half + probe.height).clip(0))

    @cached_property
    def blocked(self) -> Bool[np.ndarray, " V"]:
        """Vertices that are known to have no room above them."""
        return self._tight if self._tight is not None else np.zeros(len(self.vertices), bool)

    @cached_property
    def tight(self) -> Bool[np.ndarray, " V"]:
        """Vertices above which there is no room for cloth: a deep crease, or the body touches itself.

        Nothing can lie there without cutting the surface, so what crosses it there is not blamed.
        """
        return self.room < NO_ROOM

    @cached_property
    def margins(self) -> Float[np.ndarray, " V"]:
        """Clearance to keep above each vertex [m]: the margin, or a quarter of the room if that is less."""
        return (self.room / 4).clip(min(_LEAST_MARGIN, self.margin), self.margin)

    def margin_at(self, found: Closest) -> Float[np.ndarray, " P"]:
        """Clearance to keep over closest points [m]."""
        return np.einsum("pk,pk->p", self.margins[self.mesh.topology.faces[found.face]], found.weights)

    @cached_property
    def mean_edge(self) -> float:
        """Mean length of the triangles' edges [m]."""
        return mean_edge(self.vertices, self.mesh.topology.faces)

    @cached_property
    def part_boxes(self) -> Float[np.ndarray, "6 2 3"]:
        """Bounding box of each part [m]; an empty part has an inverted box, which holds nothing."""
        boxes = np.full((len(BODY_PARTS), 2, 3), [[np.inf] * 3, [-np.inf] * 3])
        for part, faces in enumerate(self.mesh.part_faces):
            if len(faces):
                corner = self.vertices[self.mesh.topology.faces[faces]].reshape(-1, 3)
                boxes[part] = corner.min(0), corner.max(0)
        return boxes

    def parts_at(self, face: Int[np.ndarray, " n"]) -> Bool[np.ndarray, "n 6"]:
        """Parts that each face belongs to."""
        return self.mesh.parts[self.mesh.topology.faces[face]].any(1)

    def border_rings_at(self, found: Closest) -> Float[np.ndarray, " P"]:
        """Edges between closest points and the open border, counted up to 4."""
        rings = self.mesh.topology.border_rings[self.mesh.topology.faces[found.face]]
        return np.einsum("pk,pk->p", rings, found.weights)

    def contacts(
        self, points: Float[np.ndarray, "P 3"], parts: Bool[np.ndarray, "P 6"], *, within: float
    ) -> Closest:
        """Closest points on faces that share a part with each point.

        Points outside a part's box by more than ``within`` [m] are not sought there; points
        without any candidate get height +inf, and the point itself as the closest one. Points
        outside of cloth whose closest triangle a fold turned over get height +inf too.
        """
        best = Closest(
            points.copy(), np.zeros(len(points), np.int64), np.zeros_like(points), np.zeros_like(points),
            np.full(len(points), np.inf), np.zeros(len(points), bool), np.zeros(len(points), bool),
        )  # fmt: skip
        for part, (low, high) in enumerate(self.part_boxes):
            index = np.flatnonzero(parts[:, part])
            here = points[index]
            index = index[((here >= low - within) & (here <= high + within)).all(1)]
            if len(index) == 0:
                continue
            found = self._query(part)(points[index])
            closer = np.abs(found.height) < np.abs(best.height[index])
            for field in ("point", "face", "weights", "normal", "height", "on_border", "on_cut"):
                getattr(best, field)[index[closer]] = getattr(found, field)[closer]
        if self.mesh.topology.is_open:
            beneath = np.flatnonzero((best.height < 0) & ~best.on_border)
            best.height[beneath[~self.winding.beneath(points[beneath])]] = np.inf
        return best

    def _query(self, part: int) -> ClosestQuery:
        if part not in self._queries:
            self._queries[part] = ClosestQuery(
                self.vertices,
                self.mesh.topology,
                part=self.mesh.part_surfaces[part],
                normals=self.normals,
            )
        return self._queries[part]


def mean_edge(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> float:
    """Mean length of the first edge of every triangle [m]."""
    side = vertices[faces[:, 1]] - vertices[faces[:, 0]]
    return float(np.sqrt(np.einsum("fc,fc->f", side, side)).mean())
