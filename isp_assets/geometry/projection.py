"""The last rung of the ladder: move a garment until it touches nothing beneath it.

Contact is resolved from both sides: garment vertices are lifted off the surfaces
beneath, and the corners of garment triangles are lifted over vertices that poke
through them. Each lift is spread over the neighbourhood, so that no spike stands
out; the last rounds lift without spreading, down to the pairs of triangles that
an exact test still finds crossing. Only vertices that came near something are
looked at again.

Positions are in metres, in one shared space. NumPy, one frame and one garment at a
time; obstacles (`Obstacle`) are the body and the finished inner garments.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from isp_assets.errors import GeometryError
from isp_assets.geometry.closest import Closest, ClosestQuery, unit_face_normals
from isp_assets.geometry.crossing import crossing_pairs
from isp_assets.geometry.obstacle import CollisionMesh, Obstacle, mean_edge
from isp_assets.geometry.spread import keep_larger, spread

BODY_MARGIN = 0.003
"""Clearance to leave over the body [m]."""
LAYER_MARGIN = 0.0025
"""Clearance to leave over an inner garment [m]."""

_CRAMPED = 0.01  # a vertex this near [m] to a place without room for cloth has no room itself
_CRAMPED_MARGIN = 0.0005  # clearance sought there [m]
_AROUND = 0.015  # vertices this near [m] at the start make the surface around them a neighbour
_WATCHED = 0.008  # vertices this near [m] at the start are looked at again in every round
_CLEAR = 0.0003  # how far [m] a crossing triangle is lifted over the plane of the other
_POKE_STEP = 0.006  # largest lift [m] of a triangle's corner in one round
_FINISH_STEP = 0.004  # largest lift [m] of one such correction
_MOST_RINGS = 8
_SPREAD_DECAY = 0.9  # part of its neighbours' lift that a vertex follows
_PARALLEL = 0.8  # cosine from which a triangle's plane shows the way off it
_SAME_SIDE = 0.25  # cosine from which two pieces of surface count as facing the same way


@dataclass(frozen=True)
class ProjectionOptions:
    """How hard to work."""

    rounds: int = 4
    """Rounds of lifting; the last one does not spread."""
    finish: int = 4
    """Rounds of lifting triangles that still cross, at most."""
    spread: int = 8
    """Rings of neighbours that follow a lift."""
    reach: float = 0.06
    """Contact deeper than this [m] is left alone: the way out is not known."""
    foreign_reach: float = 0.015
    """The same for contact with another part of the body."""
    poke_reach: float = 0.015
    """How far a vertex beneath may poke through a triangle [m] and still lift it."""
    longest_move: float = 0.05
    """A vertex that was moved this far [m] is caught between surfaces: it counts as having no room."""
    tolerance: float = 1e-4
    """Lifts below this [m] count as none."""

    def __post_init__(self) -> None:
        if self.rounds < 1 or self.finish < 0 or self.spread < 0:
            raise GeometryError(f"projection needs rounds >= 1, finish >= 0 and spread >= 0, got {self}")


@dataclass(frozen=True, eq=False)
class Projection:
    """A garment clear of what lies beneath it, and what that took."""

    vertices: Float[np.ndarray, "V 3"]
    ran: bool
    """False where nothing touched: ``vertices`` are then the ones that came in."""
    rounds: int
    largest_move: float
    """[m]"""
    tight: Bool[np.ndarray, " V"]
    """Vertices where the surfaces beneath leave no room for cloth."""
    crossings: int
    """Pairs of triangles that still cross, where there is room."""


def project(
    vertices: Float[np.ndarray, "V 3"],
    mesh: CollisionMesh,
    obstacles: Sequence[Obstacle],
    options: ProjectionOptions | None = None,
) -> Projection:
    """Lift a garment clear of all obstacles.

    Args:
        vertices: The garment in this frame [m].
        mesh: The garment's collision data.
        obstacles: What lies beneath: body first, then inner garments.
        options: How hard to work.

    Raises:
        GeometryError: If a position is not finite or the mesh does not fit.
    """
    start = np.ascontiguousarray(vertices, np.float64)
    if not np.isfinite(start).all():
        raise GeometryError("garment positions hold NaN or infinity; check the networks' output")
    work = _Projector(start, mesh, obstacles, options or ProjectionOptions())
    rounds = work.lift()
    crossings = work.finish()
    move = float(np.linalg.norm(work.position - start, axis=1).max(initial=0))
    return Projection(work.position, move > 0, rounds, move, work.tight, crossings)


class _Neighbour:
    """What is known of one obstacle: where the garment comes near it."""

    def __init__(self, obstacle: Obstacle, found: Closest, *, edge: float) -> None:
        self.obstacle = obstacle
        topology = obstacle.mesh.topology
        near = found.height < _AROUND
        close = np.zeros(len(obstacle.vertices), bool)
        close[topology.faces[found.face[near]]] = True
        # A garment triangle may span many of the ones beneath: look as far around as it reaches.
        for _ in range(1 + min(math.ceil(edge / obstacle.mean_edge), _MOST_RINGS)):
            close[topology.faces[_any_corner(close, topology.faces)]] = True
        self.found: Closest | None = found
        """What the first query found, until vertices move."""
        self.watched = found.height < _WATCHED
        self.watched_foreign: Bool[np.ndarray, " V"] | None = None
        self.vertices = np.flatnonzero(close & ~obstacle.tight)
        self.faces = np.flatnonzero(_any_corner(close, topology.faces))
        beneath = _any_corner(obstacle.tight, topology.faces)[found.face]
        self.cramped = beneath & (np.abs(found.height) < _CRAMPED)


class _Projector:
    """One garment in one frame, while it is being lifted."""

    def __init__(
        self,
        position: Float[np.ndarray, "V 3"],
        mesh: CollisionMesh,
        obstacles: Sequence[Obstacle],
        options: ProjectionOptions,
    ) -> None:
        self.start = self.position = position
        self.mesh, self.options = mesh, options
        first = [o.contacts(position, mesh.parts, within=_AROUND) for o in obstacles]
        edge = mean_edge(position, mesh.topology.faces)
        self.near = [_Neighbour(o, found, edge=edge) for o, found in zip(obstacles, first, strict=True)]
        self.tight = np.zeros(len(position), bool)
        for neighbour in self.near:
            self.tight |= neighbour.cramped

    def lift(self) -> int:
        """Lift vertices, and triangles once most vertices are clear; the number of rounds taken."""
        options = self.options
        for done in range(options.rounds):
            last = done == options.rounds - 1
            lift = self._lift_vertices(foreign=not last)
            if done > 0 or not lift.any():
                poke = self._lift_triangles(self.position + lift)
                lift = np.where((lift != 0).any(1, keepdims=True), lift, poke)
            if np.abs(lift).max(initial=0) < options.tolerance:
                return done
            rings = 0 if last else options.spread
            step = spread(lift, self.mesh.neighbour_average, rings=rings, decay=_SPREAD_DECAY)
            self._move(step)
        return options.rounds

    def finish(self) -> int:
        """Lift triangles over the planes of the triangles they still cross; the number left."""
        crossings = 0
        for attempt in range(self.options.finish + 1):
            lift, crossings = np.zeros_like(self.position), 0
            for neighbour in self.near:
                pairs = self._crossings(neighbour)
                crossings += len(pairs)
                if len(pairs) and attempt < self.options.finish:
                    keep_larger(lift, self._part(neighbour.obstacle, pairs))
            if not lift.any():
                break
            self._move(lift)
        return crossings

    def _move(self, step: Float[np.ndarray, "V 3"]) -> None:
        self.position = self.position + step
        total = self.position - self.start
        moved = (step != 0).any(1)
        far = np.einsum("vc,vc->v", total, total) > self.options.longest_move**2
        if far.any():
            self.tight |= far
        for neighbour in self.near:
            neighbour.watched |= moved
            neighbour.found = None

    def _lift_vertices(self, *, foreign: bool) -> Float[np.ndarray, "V 3"]:
        """The largest lift over all obstacles; foreign contact may only use up room above the own margins."""
        own, other = np.zeros_like(self.position), np.zeros_like(self.position)
        room = np.full(len(self.position), np.inf)
        for neighbour in self.near:
            obstacle, index, found = neighbour.obstacle, np.flatnonzero(neighbour.watched), neighbour.found
            if found is None:
                found = obstacle.contacts(self.position[index], self.mesh.parts[index], within=_AROUND)
            else:
                index = np.arange(len(self.position))
            points = self.position[index]
            margin = np.where(self.tight[index], _CRAMPED_MARGIN, obstacle.margin)
            keep_larger(own, _shortest_way(points, found, margin, self.options.reach), index)
            spare = np.where(found.on_border, np.inf, (found.height - obstacle.margin).clip(0))
            room[index] = np.minimum(room[index], spare)
            if foreign:
                self._lift_off_other_parts(neighbour, other)
        size = np.sqrt(np.einsum("vc,vc->v", other, other))
        other *= np.minimum(1, room / np.maximum(size, 1e-9))[:, None]
        return np.where((own != 0).any(1, keepdims=True), own, other)

    def _lift_off_other_parts(self, neighbour: _Neighbour, lift: Float[np.ndarray, "V 3"]) -> None:
        obstacle, watched = neighbour.obstacle, neighbour.watched_foreign
        index = np.arange(len(self.position)) if watched is None else np.flatnonzero(watched)
        points = self.position[index]
        found = obstacle.contacts(points, ~self.mesh.parts[index], within=obstacle.margin)
        if watched is None:
            neighbour.watched_foreign = found.height < _WATCHED
        margin = np.full(len(index), obstacle.margin)
        keep_larger(lift, _shortest_way(points, found, margin, self.options.foreign_reach), index)

    def _lift_triangles(self, position: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3"]:
        """Lift the corners of triangles over obstacle vertices that poke through them."""
        lift = np.zeros_like(position)
        if not any(len(neighbour.vertices) for neighbour in self.near):
            return lift
        query, faces = ClosestQuery(position, self.mesh.topology), self.mesh.topology.faces
        for neighbour in self.near:
            obstacle, index = neighbour.obstacle, neighbour.vertices
            found = query(obstacle.vertices[index])
            gap = obstacle.margin / 2  # vertices keep the whole margin; half of it allows for their chords
            facing = np.einsum("pc,pc->p", obstacle.normals.of_vertices[index], found.normal)
            poking = (found.height > -gap) & (found.height < self.options.poke_reach) & ~found.on_border
            hit = np.flatnonzero(poking & (facing > _SAME_SIDE))
            corner = faces[found.face[hit]]
            own = (self.mesh.parts[corner].any(1) & obstacle.mesh.parts[index[hit]]).any(1)
            free = own & ~self.tight[corner].any(1)
            hit, corner, weights = hit[free], corner[free], found.weights[hit[free]]
            share = weights / np.einsum("pk,pk->p", weights, weights)[:, None]
            size = (found.height[hit] + gap)[:, None] * share
            push = size.clip(0, _POKE_STEP)[..., None] * found.normal[hit][:, None]
            keep_larger(lift, _largest_per_vertex(corner, push, len(position)))
        return lift

    def _crossings(self, neighbour: _Neighbour) -> Int[np.ndarray, "n 2"]:
        """Crossing pairs of faces that share a body part and have room."""
        obstacle, faces, beneath = (
            neighbour.obstacle,
            self.mesh.topology.faces,
            neighbour.obstacle.mesh.topology.faces,
        )
        mine = np.flatnonzero(_any_corner(neighbour.watched, faces))
        pairs = crossing_pairs(self.position, faces[mine], obstacle.vertices, beneath[neighbour.faces])
        pairs = np.stack([mine[pairs[:, 0]], neighbour.faces[pairs[:, 1]]], axis=1)
        above, below = faces[pairs[:, 0]], beneath[pairs[:, 1]]
        own = (self.mesh.parts[above].any(1) & obstacle.mesh.parts[below].any(1)).any(1)
        trapped = self.tight[above].any(1) | obstacle.tight[below].any(1)
        return pairs[own & ~trapped]

    def _part(self, obstacle: Obstacle, pairs: Int[np.ndarray, "n 2"]) -> Float[np.ndarray, "V 3"]:
        """Lift the garment's triangle of each pair over the plane of the other one."""
        faces, beneath = self.mesh.topology.faces[pairs[:, 0]], obstacle.mesh.topology.faces[pairs[:, 1]]
        mine, theirs = unit_face_normals(self.position, faces), obstacle.normals.of_faces[pairs[:, 1]]
        alike = np.einsum("pc,pc->p", mine, theirs)
        # Where the other triangle stands across the garment (a fold), its plane leads nowhere.
        plane = np.where((alike > _PARALLEL)[:, None], theirs, mine)
        top = np.einsum("pkc,pc->pk", obstacle.vertices[beneath], plane).max(1)
        height = np.einsum("pkc,pc->pk", self.position[faces], plane)
        need = (top[:, None] + _CLEAR - height).clip(0, _FINISH_STEP)
        push = need[..., None] * plane[:, None] * (alike > -_SAME_SIDE)[:, None, None]
        return _largest_per_vertex(faces, push, len(self.position))


def _shortest_way(
    points: Float[np.ndarray, "P 3"], found: Closest, margin: Float[np.ndarray, " P"], reach: float
) -> Float[np.ndarray, "P 3"]:
    """The shortest way from each point to the margin over a surface; none for points that are clear."""
    touching = (found.height < margin) & (found.height > -reach) & ~found.on_border
    away = np.where(found.height[:, None] >= 0, points - found.point, found.point - points)
    length = np.abs(found.height)[:, None]
    away = np.where(length > 1e-6, away / np.maximum(length, 1e-6), found.normal)
    return np.where(touching[:, None], (margin - found.height).clip(0, 1)[:, None] * away, 0.0)


def _largest_per_vertex(
    corner: Int[np.ndarray, "n 3"], push: Float[np.ndarray, "n 3 3"], num_vertices: int
) -> Float[np.ndarray, "V 3"]:
    vertex, push = corner.reshape(-1), push.reshape(-1, 3)
    order = np.argsort(np.einsum("vc,vc->v", push, push), kind="stable")
    largest = np.zeros((num_vertices, 3))
    largest[vertex[order]] = push[order]  # the last write to a row wins: the longest push
    return largest


def _any_corner(mask: Bool[np.ndarray, " V"], faces: Int[np.ndarray, "F 3"]) -> Bool[np.ndarray, " F"]:
    return mask[faces[:, 0]] | mask[faces[:, 1]] | mask[faces[:, 2]]
