"""Moves that clear contact, vertex by vertex; and which vertices and faces of an obstacle are near a garment.

Parts of the projection. Positions are in metres. NumPy, one frame at a time.
"""

import math

import numpy as np
from jaxtyping import Bool, Float, Int

from isp_assets.geometry.closest import Closest, ClosestQuery, unit_face_normals
from isp_assets.geometry.narrow import narrowness
from isp_assets.geometry.obstacle import Obstacle

AROUND = 0.015
"""Vertices this near [m] at the start make the surface around them a neighbour."""
ASIDE = 0.06
"""Cloth this far [m] outside the bounds of a part still has its closest point there."""
WATCHED = 0.008
"""Vertices this near [m] at the start are looked at again in every round."""
CLEAR = 0.0003
"""How far [m] a triangle that was found on the wrong side is lifted over the other surface."""
_CRAMPED = 0.01  # a vertex this near [m] to a place without room for cloth has no room itself
_FINISH_STEP = 0.002  # largest lift [m] of a crossing triangle in one round
_POKE_STEP = 0.006  # largest lift [m] of a triangle's corner over a vertex in one round
_SAME_SIDE = 0.25  # cosine from which two pieces of surface count as facing the same way
_PARALLEL = 0.8  # cosine from which a triangle's plane shows the way off it
_MOST_RINGS = 8
_COVERING = 2.0  # edges from its open border from which a layer covers what lies beneath it


class Neighbour:
    """What is known of one obstacle: where the garment comes near it."""

    def __init__(
        self, obstacle: Obstacle, own: Bool[np.ndarray, "V 6"], found: Closest, *, edge: float
    ) -> None:
        self.obstacle, self.own = obstacle, own
        """Parts of the obstacle that each vertex must stay above: its own that no outer layer covers."""
        topology = obstacle.mesh.topology
        near = found.height < AROUND
        close = np.zeros(len(obstacle.vertices), bool)
        close[topology.faces[found.face[near]]] = True
        # A garment triangle may span many of the ones beneath: look as far around as it reaches.
        for _ in range(1 + min(math.ceil(edge / obstacle.mean_edge), _MOST_RINGS)):
            close[topology.faces[any_corner(close, topology.faces)]] = True
        self.found: Closest | None = found
        """What the first query found, until vertices move."""
        self.depth = obstacle.margin - found.height
        """How far each vertex is from keeping the margin at the start [m]."""
        self.watched = found.height < WATCHED
        self.other: Bool[np.ndarray, "V 6"] | None = None
        """Parts of it that each vertex may touch without belonging to them; None until first looked at."""
        self.watched_other = np.ones(len(own), bool)
        self.vertices = np.flatnonzero(close)
        self.faces = np.flatnonzero(any_corner(close, topology.faces))
        beneath = any_corner(obstacle.tight, topology.faces)[found.face]
        self.cramped = beneath & (np.abs(found.height) < _CRAMPED)
        self.narrow = narrowness(obstacle, found)
        """How little room each vertex has over it, 0 to 1."""


def open_beneath(
    open_parts: Bool[np.ndarray, "V 6"], obstacle: Obstacle, found: Closest
) -> Bool[np.ndarray, "V 6"]:
    """Parts that vertices may still meet further in, once they were compared with ``obstacle``.

    What is clear of a layer is clear of all that lies beneath it. Near the layer's border a
    vertex may slip off it, and where the layer had no room it may not be clear itself.
    """
    covered = np.isfinite(found.height) & ~found.on_border & ~found.on_cut
    index = np.flatnonzero(covered)
    inner = obstacle.border_rings_at(found)[index] >= _COVERING
    tight = any_corner(obstacle.tight, obstacle.mesh.topology.faces)[found.face[index]]
    index = index[inner & ~tight]
    result = open_parts.copy()
    under = obstacle.parts_at(found.face[index])
    # Where two parts meet, as at an armhole, cloth above one side may lie beneath the other.
    result[index] &= ~(under & (under.sum(1, keepdims=True) == 1))
    return result


def shortest_way(
    points: Float[np.ndarray, "P 3"],
    found: Closest,
    margin: Float[np.ndarray, " P"],
    reach: Float[np.ndarray, " P"],
) -> Float[np.ndarray, "P 3"]:
    """The shortest way from each point to the margin over a surface; none for points that are clear."""
    touching = (found.height < margin) & (found.height > -reach) & ~found.on_border
    away = np.where(found.height[:, None] >= 0, points - found.point, found.point - points)
    length = np.abs(found.height)[:, None]
    away = np.where(length > 1e-6, away / np.maximum(length, 1e-6), found.normal)
    return np.where(touching[:, None], (margin - found.height).clip(0, 1)[:, None] * away, 0.0)


def towards(points: Float[np.ndarray, "P 3"], found: Closest) -> Float[np.ndarray, "P 3"]:
    """Unit directions to the closest points; zero beneath the surface and on it."""
    above = (found.height > 1e-6) & np.isfinite(found.height)
    length = np.where(above, found.height, 1.0)[:, None]
    return np.where(above[:, None], (found.point - points) / length, 0.0)


def over_vertices(
    garment: ClosestQuery,
    parts: Bool[np.ndarray, "V 6"],
    neighbour: Neighbour,
    *,
    gap: float | None,
    reach: float,
) -> Float[np.ndarray, "V 3"]:
    """Lifts of the corners of the garment's triangles over vertices beneath that poke through them.

    Args:
        garment: The garment, ready for queries.
        parts: The parts that its vertices belong to.
        neighbour: What lies beneath.
        gap: How far to lift over its vertices [m]; by default half of its margins.
        reach: What pokes through further than this [m] is left alone.
    """
    obstacle, index = neighbour.obstacle, neighbour.vertices
    found = garment(obstacle.vertices[index])
    # Vertices keep the whole margin; half of it allows for their chords.
    above = obstacle.margins[index] / 2 if gap is None else np.full(len(index), gap)
    facing = np.einsum("pc,pc->p", obstacle.normals.of_vertices[index], found.normal)
    poking = (found.height > -above) & (found.height < reach) & ~found.on_border
    hit = np.flatnonzero(poking & (facing > _SAME_SIDE))
    corner = garment.topology.faces[found.face[hit]]
    own = (parts[corner].any(1) & obstacle.mesh.parts[index[hit]]).any(1)
    hit, corner, weights = hit[own], corner[own], found.weights[hit[own]]
    share = weights / np.einsum("pk,pk->p", weights, weights)[:, None]
    size = (found.height[hit] + above[hit])[:, None] * share
    push = size.clip(0, _POKE_STEP)[..., None] * found.normal[hit][:, None]
    return _largest_per_vertex(corner, push, len(garment.vertices))


def over_planes(
    position: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    obstacle: Obstacle,
    pairs: Int[np.ndarray, "n 2"],
) -> Float[np.ndarray, "V 3"]:
    """Lifts of the garment's triangle of each crossing pair over the plane of the other one."""
    mine, theirs = faces[pairs[:, 0]], obstacle.mesh.topology.faces[pairs[:, 1]]
    normal, beneath = unit_face_normals(position, mine), obstacle.normals.of_faces[pairs[:, 1]]
    alike = np.einsum("pc,pc->p", normal, beneath)
    # Where the other triangle stands across the garment (a fold), its plane leads nowhere.
    plane = np.where((alike > _PARALLEL)[:, None], beneath, normal)
    top = np.einsum("pkc,pc->pk", obstacle.vertices[theirs], plane).max(1)
    height = np.einsum("pkc,pc->pk", position[mine], plane)
    need = (top[:, None] + CLEAR - height).clip(0, _FINISH_STEP)
    push = need[..., None] * plane[:, None] * (alike > -_SAME_SIDE)[:, None, None]
    return _largest_per_vertex(mine, push, len(position))


def _largest_per_vertex(
    corner: Int[np.ndarray, "n 3"], push: Float[np.ndarray, "n 3 3"], num_vertices: int
) -> Float[np.ndarray, "V 3"]:
    vertex, push = corner.reshape(-1), push.reshape(-1, 3)
    order = np.argsort(np.einsum("vc,vc->v", push, push), kind="stable")
    largest = np.zeros((num_vertices, 3))
    largest[vertex[order]] = push[order]  # the last write to a row wins: the longest push
    return largest


def any_corner(mask: Bool[np.ndarray, " V"], faces: Int[np.ndarray, "F 3"]) -> Bool[np.ndarray, " F"]:
    return mask[faces[:, 0]] | mask[faces[:, 1]] | mask[faces[:, 2]]
