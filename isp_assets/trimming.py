"""Cut off what is tucked in so deep that nobody sees it: a scene needs no more than its rim.

The hem of a shirt inside trousers ends up in the creases of hips and seat. It would crumple there, and
strain and lift the trousers over it. A hand's breadth beneath the waistband is enough to hide its end.

Positions are in metres; NumPy.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from isp_assets.garment import Garment
from isp_assets.geometry.closest import SurfaceNormals
from isp_assets.geometry.cutting import faces_without
from isp_assets.geometry.geodesic import distance_along
from isp_assets.geometry.obstacle import CollisionMesh, Obstacle
from isp_assets.skinning import BoundGarment

_REACH = 0.12  # cloth further from a cover than this [m] has nothing to do with it
_ALIKE = 0.3  # cosine from which cloth and its cover face the same way


@dataclass(frozen=True, eq=False)
class Piece:
    """A decoded garment of V vertices, bound to the body."""

    garment: Garment
    skin: BoundGarment
    rest: Float[np.ndarray, "V 3"]
    """Skinned to the wearer in T-pose [m]."""
    trimmed: float = 0.0
    """Share of its flat area that was cut off."""

    @property
    def collision(self) -> CollisionMesh:
        return CollisionMesh.build(self.garment.faces, self.skin.joint_weights.cpu().numpy())


def trim_tucked(pieces: Sequence[Piece], *, depth: float) -> tuple[Piece, ...]:
    """Cut off what lies deeper beneath a garment that the body holds than is seen.

    Args:
        pieces: All garments of an outfit, innermost first. Those that the body holds are left whole.
        depth: How far beneath its cover's border cloth is kept, along the cover [m].
    """
    covers: list[tuple[Obstacle, np.ndarray]] = []
    trimmed = []
    for piece in reversed(pieces):
        held, mesh = len(piece.garment.anchors) > 0, piece.collision
        if covers and not held:
            piece = _without(piece, _deepest(piece, mesh, covers) > depth)
        trimmed.append(piece)
        if held:
            border = np.flatnonzero(mesh.topology.border_vertex)
            inside = distance_along(piece.rest, piece.garment.faces, border)
            covers.append((Obstacle(mesh, piece.rest, margin=0.0), inside))
    return tuple(reversed(trimmed))


def _deepest(
    piece: Piece, mesh: CollisionMesh, covers: Sequence[tuple[Obstacle, np.ndarray]]
) -> Float[np.ndarray, " V"]:
    """How far inside the border of any cover the place over or beneath each vertex lies [m]."""
    points = np.ascontiguousarray(piece.rest, np.float64)
    normals = SurfaceNormals(points, piece.garment.faces).of_vertices
    deepest = np.zeros(len(points))
    for cover, inside in covers:
        found = cover.contacts(points, mesh.parts, within=_REACH)
        alike = np.einsum("vc,vc->v", normals, found.normal) > _ALIKE
        near = alike & ~found.on_border & (np.abs(found.height) < _REACH)
        there = np.einsum("vk,vk->v", inside[cover.mesh.topology.faces[found.face]], found.weights)
        deepest = np.maximum(deepest, np.where(near, there, 0.0))
    return deepest


def _without(piece: Piece, deep: Bool[np.ndarray, " V"]) -> Piece:
    faces = piece.garment.faces
    gone = np.ones(len(deep), bool)
    gone[faces[~deep[faces].all(axis=1)]] = False  # faces across the line stay, so that none ends short of it
    stay = faces_without(faces, gone)
    if stay.all() or not stay.any():
        return piece
    garment, kept = piece.garment.with_faces(stay)
    skin = replace(piece.skin, **{name: value[kept] for name, value in vars(piece.skin).items()})
    return Piece(garment, skin, piece.rest[kept], 1 - _flat_area(garment) / _flat_area(piece.garment))


def _flat_area(garment: Garment) -> float:
    corner = garment.corner_xy.astype(np.float64)
    return 0.5 * float(np.abs(np.linalg.det(corner[:, 1:] - corner[:, :1])).sum())
