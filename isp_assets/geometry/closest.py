"""Exact closest points on a triangle mesh, with a signed height.

The sign comes from angle-weighted pseudonormals, which give the right side at
faces, edges and vertices alike. On an open mesh a point whose closest point lies
on the border has no side: ask ``on_border`` before using its sign.

Positions are in metres, in one shared space. NumPy, one frame at a time; the
connectivity is prepared once (`SurfaceTopology`) and reused over frames.

Reference: Baerentzen and Aanaes, "Signed Distance Computation Using the Angle
Weighted Pseudonormal", 2005.
"""

from dataclasses import dataclass
from functools import cached_property

import igl
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array

from isp_assets.errors import GeometryError
from isp_assets.geometry.topology import edges

_ON_FEATURE = 1e-7  # barycentric weight below which the closest point lies on an edge or a vertex


@dataclass(frozen=True, eq=False)
class SurfaceTopology:
    """Connectivity of a triangle mesh as closest-point queries need it; static over frames."""

    faces: Int[np.ndarray, "F 3"]
    edge_faces: Int[np.ndarray, "E 2"]
    """Faces at each edge; the second is -1 on the border."""
    face_edge: Int[np.ndarray, "F 3"]
    """Edge opposite to each corner of a face."""
    border_vertex: Bool[np.ndarray, " V"]

    @cached_property
    def is_open(self) -> bool:
        """Whether the surface has a border, as every garment has."""
        return bool(self.border_vertex.any())

    @cached_property
    def neighbour_average(self) -> csr_array:
        """Matrix [V, V] that averages a field over the neighbours of each vertex."""
        faces, count = self.faces, len(self.border_vertex)
        row = np.concatenate([faces, faces]).reshape(-1)
        column = np.concatenate([np.roll(faces, 1, axis=1), np.roll(faces, -1, axis=1)]).reshape(-1)
        matrix = csr_array((np.ones(len(row)), (row, column)), shape=(count, count))
        matrix.data[:] = 1.0  # an inner edge is met twice
        matrix.data /= np.repeat(np.maximum(np.diff(matrix.indptr), 1), np.diff(matrix.indptr))
        return matrix

    @cached_property
    def border_rings(self) -> Float[np.ndarray, " V"]:
        """Edges between each vertex and the open border, counted up to 4."""
        faces = self.faces
        rings = np.where(self.border_vertex, 0.0, 4.0)
        for _ in range(3):
            nearest = rings[faces].min(1) + 1
            np.minimum.at(rings, faces.reshape(-1), np.repeat(nearest, 3))
        return rings

    @classmethod
    def build(cls, faces: Int[np.ndarray, "F 3"], num_vertices: int) -> "SurfaceTopology":
        """Prepare a mesh.

        Raises:
            GeometryError: If the mesh is empty, an index is out of range, or an edge has more than two faces.
        """
        if len(faces) == 0:
            raise GeometryError("surface has no faces; closest points need at least one triangle")
        if faces.min() < 0 or faces.max() >= num_vertices:
            raise GeometryError(f"faces must index 0..{num_vertices - 1}, got {faces.min()}..{faces.max()}")
        faces = np.ascontiguousarray(faces, np.int64)
        mesh = edges(faces)
        if mesh.num_faces.max() > 2:
            raise GeometryError(f"surface has an edge with {mesh.num_faces.max()} faces, expected at most 2")
        order = np.argsort(mesh.face_edge.reshape(-1), kind="stable")
        first = np.searchsorted(mesh.face_edge.reshape(-1)[order], np.arange(len(mesh.vertices)))
        edge_faces = np.full((len(mesh.vertices), 2), -1, np.int64)
        edge_faces[:, 0] = order[first] // 3
        double = mesh.num_faces == 2
        edge_faces[double, 1] = order[first[double] + 1] // 3
        border = np.zeros(num_vertices, bool)
        border[mesh.vertices[~double]] = True
        opposite = np.roll(mesh.face_edge, -1, axis=1)
        return cls(faces, edge_faces, opposite, border)


@dataclass(frozen=True, eq=False)
class Closest:
    """Closest points on a surface to P query points."""

    point: Float[np.ndarray, "P 3"]
    face: Int[np.ndarray, " P"]
    weights: Float[np.ndarray, "P 3"]
    """Barycentric weights of ``point`` in ``face``."""
    normal: Float[np.ndarray, "P 3"]
    """Unit pseudonormal of the surface at ``point``."""
    height: Float[np.ndarray, " P"]
    """Distance [m], negative on the inner side."""
    on_border: Bool[np.ndarray, " P"]
    """The closest point lies on the open border of the surface: the sign means nothing."""
    on_cut: Bool[np.ndarray, " P"]
    """The same for the border of the part of the surface that was searched."""


@dataclass(frozen=True, eq=False)
class SurfacePart:
    """Some faces of a surface, and the border along which they were cut out of it; static over frames."""

    faces: Int[np.ndarray, " n"]
    cut_edge: Bool[np.ndarray, " E"]
    cut_vertex: Bool[np.ndarray, " V"]

    @classmethod
    def build(cls, topology: SurfaceTopology, faces: Int[np.ndarray, " n"]) -> "SurfacePart":
        """Find the border of the faces with these indices."""
        inside = np.zeros(len(topology.faces) + 1, bool)  # the last stands for the -1 of an open border
        inside[faces] = True
        first, second = inside[topology.edge_faces].T
        cut_edge = first != second
        cut_vertex = np.zeros(len(topology.border_vertex), bool)
        for corner in range(3):  # the edge opposite to a corner joins the two others
            of_cut = topology.faces[cut_edge[topology.face_edge[:, corner]]]
            cut_vertex[np.delete(of_cut, corner, axis=1)] = True
        return cls(faces, cut_edge, cut_vertex)


class SurfaceNormals:
    """Normals of a surface in one frame; made once, shared by queries."""

    def __init__(self, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> None:
        self._vertices, self._faces = vertices, faces

    @cached_property
    def of_faces(self) -> Float[np.ndarray, "F 3"]:
        """Unit normals; zero for a face without area."""
        return unit_face_normals(self._vertices, self._faces)

    @cached_property
    def of_vertices(self) -> Float[np.ndarray, "V 3"]:
        """Unit sums of the face normals around each vertex, weighted by the faces' angles there."""
        corner = self._vertices[self._faces]
        side = np.roll(corner, -1, axis=1) - corner
        side /= np.maximum(np.sqrt(np.einsum("fkc,fkc->fk", side, side)), 1e-30)[..., None]
        cosine = -np.einsum("fkc,fkc->fk", side, np.roll(side, 1, axis=1))
        weighted = np.arccos(cosine.clip(-1, 1))[..., None] * self.of_faces[:, None]
        total = np.stack(
            [
                np.bincount(
                    self._faces.reshape(-1), weighted[..., axis].reshape(-1), minlength=len(self._vertices)
                )
                for axis in range(3)
            ],
            axis=1,
        )
        return total / np.maximum(np.sqrt(np.einsum("vc,vc->v", total, total)), 1e-12)[:, None]


class ClosestQuery:
    """A surface in one frame, ready for closest-point queries (a tree of boxes, built once, used often)."""

    def __init__(
        self,
        vertices: Float[np.ndarray, "V 3"],
        topology: SurfaceTopology,
        *,
        part: SurfacePart | None = None,
        normals: SurfaceNormals | None = None,
    ) -> None:
        """Build the tree.

        Args:
            vertices: Positions in this frame [m].
            topology: Connectivity.
            part: Search these faces only; sides and borders remain those of the whole surface.
            normals: Normals of the whole surface, where the caller has them already.

        Raises:
            GeometryError: If the positions do not fit the topology or are not finite.
        """
        if len(vertices) != len(topology.border_vertex):
            count = len(topology.border_vertex)
            raise GeometryError(f"surface has {count} vertices, got {len(vertices)} positions")
        if not np.isfinite(vertices).all():
            raise GeometryError("surface positions hold NaN or infinity; check the step before")
        self.vertices = np.ascontiguousarray(vertices, np.float64)
        self.topology = topology
        self._part = part
        self._searched = topology.faces if part is None else np.ascontiguousarray(topology.faces[part.faces])
        self._tree = igl.AABB()
        self._tree.init(self.vertices, self._searched)
        self.normals = normals or SurfaceNormals(self.vertices, topology.faces)

    def __call__(self, points: Float[np.ndarray, "P 3"]) -> Closest:
        """Closest point, side and pseudonormal of every query point."""
        if len(points) == 0:
            empty = np.zeros((0, 3))
            none = np.zeros(0, bool)
            return Closest(empty, np.zeros(0, np.int64), empty, empty, np.zeros(0), none, none)
        points = np.ascontiguousarray(points, np.float64)
        squared, face, closest = self._tree.squared_distance(self.vertices, self._searched, points)
        face, closest = face.reshape(-1).astype(np.int64), closest.reshape(-1, 3)  # igl gives C's long long
        if self._part is not None:
            face = self._part.faces[face]
        weights = barycentric_weights(closest, self.vertices[self.topology.faces[face]])
        normal, on_border, on_cut = self._pseudonormals(face, weights)
        side = np.where(np.einsum("pc,pc->p", points - closest, normal) < 0, -1.0, 1.0)
        return Closest(closest, face, weights, normal, side * np.sqrt(squared), on_border, on_cut)

    def _pseudonormals(
        self, face: Int[np.ndarray, " P"], weights: Float[np.ndarray, "P 3"]
    ) -> tuple[Float[np.ndarray, "P 3"], Bool[np.ndarray, " P"], Bool[np.ndarray, " P"]]:
        topology, of_faces = self.topology, self.normals.of_faces
        zero = weights < _ON_FEATURE
        zeros = zero[:, 0].astype(np.int8) + zero[:, 1] + zero[:, 2]
        normal = of_faces[face]
        on_border, on_cut = np.zeros(len(face), bool), np.zeros(len(face), bool)
        on_edge = np.flatnonzero(zeros == 1)
        edge = topology.face_edge[face[on_edge], zero[on_edge].argmax(1)]
        pair = topology.edge_faces[edge]
        on_border[on_edge] = pair[:, 1] < 0
        across = np.where(pair[:, 0] == face[on_edge], pair[:, 1], pair[:, 0])
        sum_of_two = normal[on_edge] + np.where(across[:, None] >= 0, of_faces[across], 0)
        length = np.sqrt(np.einsum("pc,pc->p", sum_of_two, sum_of_two))[:, None]
        # Where a fold closes to 180 degrees any side is as good: keep the face's.
        normal[on_edge] = np.where(length > 1e-9, sum_of_two / np.maximum(length, 1e-9), normal[on_edge])
        on_vertex = np.flatnonzero(zeros == 2)
        vertex = topology.faces[face[on_vertex], weights[on_vertex].argmax(1)]
        on_border[on_vertex] = topology.border_vertex[vertex]
        normal[on_vertex] = self.normals.of_vertices[vertex]
        if self._part is not None:
            on_cut[on_edge] = self._part.cut_edge[edge]
            on_cut[on_vertex] = self._part.cut_vertex[vertex]
        return normal, on_border, on_cut


def unit_face_normals(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "F 3"]:
    """Unit normals of faces; zero for a face without area."""
    first, second, third = (vertices[corner] for corner in faces.T)
    cross = np.cross(second - first, third - first)
    length = np.sqrt(np.einsum("fc,fc->f", cross, cross))
    return cross / np.maximum(length, 1e-30)[:, None]


def signed_heights(
    points: Float[np.ndarray, "T P 3"], surface: Float[np.ndarray, "T_s V 3"], topology: SurfaceTopology
) -> Float[np.ndarray, "T P"]:
    """Signed height [m] of points over a surface, frame by frame; NaN where its open border is closest."""
    if len(points) != len(surface):
        raise GeometryError(f"points have {len(points)} frames, the surface has {len(surface)}")
    heights = np.empty(points.shape[:2])
    for frame, (queries, vertices) in enumerate(zip(points, surface, strict=True)):
        found = ClosestQuery(vertices, topology)(queries)
        heights[frame] = np.where(found.on_border, np.nan, found.height)
    return heights


def barycentric_weights(
    point: Float[np.ndarray, "P 3"], corner: Float[np.ndarray, "P 3 3"]
) -> Float[np.ndarray, "P 3"]:
    """Weights of the corners of triangles that give points in them; each in 0..1."""
    a, b = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    p = point - corner[:, 0]
    aa, ab, bb, pa, pb = (np.einsum("pc,pc->p", *pair) for pair in ((a, a), (a, b), (b, b), (p, a), (p, b)))
    area = np.maximum(aa * bb - ab * ab, 1e-30)
    second = (bb * pa - ab * pb) / area
    third = (aa * pb - ab * pa) / area
    return np.stack([1 - second - third, second, third], axis=1).clip(0, 1)
